"""Foreign stages behind the Protocols: one that raises, hangs or answers nonsense misses a frame, and nothing else."""

from collections.abc import Callable, Collection, Sequence, Set
from contextlib import suppress
from dataclasses import replace

import numpy as np

from simtrack.contracts import (
    DetectionResult,
    Detector,
    Float64,
    LidarScan,
    Localization,
    Localizer,
    Odometry,
    PoseHypothesis,
    RegionOfInterest,
    Relation,
    RgbdFrame,
    SceneGraphBuilder,
    Status,
    Track,
    Tracker,
    TrackerResult,
)
from simtrack.perception.foreign.answers import (
    wrong_detections,
    wrong_localization,
    wrong_relations,
    wrong_tracks,
)
from simtrack.perception.foreign.watch import Watch
from simtrack.perception.scene_graph.relations import RELATIONS

DEFAULT_LIMIT = 5.0
"""Seconds of the wall clock for a frame."""


class _Guard:
    """What the guards have in common."""

    def __init__(self, stage: str, inner: object, limit: float) -> None:
        self.watch = Watch(stage, limit)
        self._release: Callable[[], object] | None = getattr(inner, "close", None)

    def close(self) -> None:
        """Close the stage, too, if it has a method for that."""
        self.watch.close()
        if self._release is not None:
            with suppress(Exception):  # the results are complete by now
                self._release()


class GuardedTracker(_Guard):
    """A tracker whose failures are missed frames: no object is believed then. Implements `Tracker`."""

    def __init__(self, tracker: Tracker, classes: Collection[str], limit: float = DEFAULT_LIMIT) -> None:
        """`classes`: names of the models; `limit`: seconds a frame."""
        super().__init__("tracker", tracker, limit)
        self._tracker, self._classes = tracker, frozenset(classes)

    def update(
        self,
        frame: RgbdFrame,
        T_map_camera: Float64,
        covariance: Float64,
        hypotheses: Sequence[PoseHypothesis] = (),
    ) -> TrackerResult:
        """See `Tracker.update`; FAILED and without tracks on a frame that is missed."""
        mine, pose, doubt = own(frame), T_map_camera.copy(), covariance.copy()
        found = self.watch.call(
            frame.stamp,
            lambda: self._tracker.update(mine, pose, doubt, tuple(hypotheses)),
            lambda answer: wrong_tracks(answer, frame.stamp, self._classes),
        )
        return found if found is not None else TrackerResult(frame.stamp, (), Status.FAILED)


class GuardedLocalizer(_Guard):
    """A localizer whose failures leave the robot where it was believed before. Implements `Localizer`."""

    def __init__(self, localizer: Localizer, T_map_base: Float64 | None, limit: float = DEFAULT_LIMIT) -> None:
        """`T_map_base`: (4, 4), believed before the first answer; `limit`: seconds a call."""
        super().__init__("localizer", localizer, limit)
        self._localizer = localizer
        T = np.eye(4) if T_map_base is None else T_map_base
        self._last = Localization(0, T, np.eye(6), Status.FAILED)

    def predict(self, odometry: Odometry) -> None:
        """See `Localizer.predict`."""
        self.watch.call(odometry.stamp, lambda: self._localizer.predict(odometry), lambda _: "", new_frame=False)

    def update(self, scan: LidarScan) -> Localization:
        """See `Localizer.update`."""
        found = self.watch.call(
            scan.stamp, lambda: self._localizer.update(scan), lambda answer: wrong_localization(answer, scan.stamp)
        )
        return self._settled(found, scan.stamp)

    def pose_at(self, stamp: int) -> Localization:
        """See `Localizer.pose_at`."""
        found = self.watch.call(
            stamp,
            lambda: self._localizer.pose_at(stamp),
            lambda answer: wrong_localization(answer, stamp, stamp),
            new_frame=False,
        )
        return self._settled(found, stamp)

    def _settled(self, found: Localization | None, stamp: int) -> Localization:
        if found is None:
            return replace(self._last, stamp=stamp, status=Status.FAILED)
        self._last = found
        return found


class GuardedDetector(_Guard):
    """A detector whose failures are images without an answer. Implements `Detector`."""

    def __init__(self, detector: Detector, limit: float = DEFAULT_LIMIT) -> None:
        """`limit`: seconds an image."""
        super().__init__("detector", detector, limit)
        self._detector = detector

    def detect(self, frame: RgbdFrame, regions: Sequence[RegionOfInterest] = ()) -> DetectionResult:
        """See `Detector.detect`; FAILED on an image that is missed."""
        mine = own(frame)
        found = self.watch.call(
            frame.stamp,
            lambda: self._detector.detect(mine, tuple(regions)),
            lambda answer: wrong_detections(answer, frame.stamp),
        )
        return found if found is not None else DetectionResult(frame.stamp, frame.stamp, (), Status.FAILED)


class GuardedSceneGraph(_Guard):
    """A builder of relations whose failures are frames without any. Implements `SceneGraphBuilder`."""

    def __init__(self, builder: SceneGraphBuilder, limit: float = DEFAULT_LIMIT) -> None:
        """`limit`: seconds a frame."""
        super().__init__("scene graph", builder, limit)
        self._builder = builder

    def update(self, stamp: int, tracks: Sequence[Track]) -> Set[Relation]:
        """See `SceneGraphBuilder.update`; nothing on a frame that is missed."""
        found = self.watch.call(
            stamp,
            lambda: self._builder.update(stamp, tuple(tracks)),
            lambda answer: wrong_relations(answer, RELATIONS),
        )
        return frozenset(found) if found is not None else frozenset()


def own(frame: RgbdFrame) -> RgbdFrame:
    """A copy that a stage may write to, and keep after it was given up."""
    rgb = None if frame.rgb is None else frame.rgb.copy()
    return replace(frame, depth=frame.depth.copy(), rgb=rgb, T_base_camera=frame.T_base_camera.copy())
