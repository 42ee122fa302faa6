"""The perception stack as one function of a frame: localize, track, segment what is unknown, relate.

Every stage is handed in or built from its defaults; none can see ground truth. A stage that fails on a frame says so in
the belief's status and keeps its state.

Tracking is done on the newest image, by the calling thread; what an image need not wait for is done beside the frames,
each in a thread of its own, and taken up a fixed time of the sensor's clock later (`simtrack.perception.beside`):

- *a scan's pose correction*: begun when the scan arrives, with the odometry so far and the tracks of the last image;
  taken up `correction_time` after the scan's last shot; until then odometry leads on from the correction before it.
  Where that one left doubts (after the start, while lost), nothing is better than to wait: it is taken up at once. A
  live robot does not wait (`StackConfig.live`); it lets scans go by while it is at work on one.
- *segmenting a scan*: begun when its correction is taken up, with the poses of its shots; taken up `segmentation_time`
  after that.
- *segmenting an image*, one that the detector would take: begun with its pose and its tracks; taken up
  `segmentation_time` after its stamp. Then the detector gets the image, with the regions that nothing explains.
- *registering a new object*: see `simtrack.perception.tracking.claims`.
- *poses of detections*: begun with the detector's answer, taken up when that is due.

Which image that is follows from stamps alone: beliefs are the same with one thread and two, fed live and replayed.
"""

import time
import weakref
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from contextlib import contextmanager
from typing import TypeVar

import numpy as np

from simtrack.contracts import (
    NANOSECONDS,
    Belief,
    Bool,
    DetectionResult,
    Detector,
    Float64,
    JointEstimate,
    JointState,
    LidarScan,
    Localization,
    Localizer,
    Odometry,
    PoseHypothesis,
    Presegmentation,
    Relation,
    RgbdFrame,
    SceneGraphBuilder,
    SensorFrame,
    StaticMap,
    Status,
    Tracker,
    TrackerResult,
)
from simtrack.geometry.kinematics import KinematicTree
from simtrack.geometry.transforms import is_rigid, with_lever
from simtrack.objects import ObjectModel
from simtrack.perception.believed_scene import MAP, BelievedScene
from simtrack.perception.beside import Beside, worker
from simtrack.perception.detection.runner import DetectorRunner
from simtrack.perception.localization import MeshLocalizer
from simtrack.perception.localization.measurement import scan_end
from simtrack.perception.presegmenter import Presegmenter
from simtrack.perception.scene_graph import SceneGraph
from simtrack.perception.self_filter import SelfFilter
from simtrack.perception.stack_config import StackConfig
from simtrack.perception.tracking.articulation import ArticulationTracker
from simtrack.perception.tracking.presegmentation import shot_stamps
from simtrack.perception.tracking.tracker import ObjectTracker

T = TypeVar("T")


class PerceptionStack:
    """Turns sensor frames into beliefs.

    ::

        stack = PerceptionStack(static_map, models, robot, detector, T_map_base=start)
        for frame in feed:
            belief = stack.process(frame)  # a Belief for every RGB-D frame, None for the others
    """

    def __init__(
        self,
        static_map: StaticMap,
        models: Mapping[str, ObjectModel],
        robot: KinematicTree,
        detector: Detector,
        *,
        T_map_base: Float64 | None = None,
        config: StackConfig | None = None,
        localizer: Localizer | None = None,
        tracker: Tracker | None = None,
        scene_graph: SceneGraphBuilder | None = None,
    ) -> None:
        """Build the stack.

        Args:
            static_map: the surveyed map.
            models: class name -> model of every object that can be tracked.
            robot: the robot's own body, to tell it from the world.
            detector: finds objects in images.
            T_map_base: (4, 4) start pose as the operator states it; None if unknown (global search).
            config: settings.
            localizer: replaces MICP-L.
            tracker: replaces the ray-tracing tracker.
            scene_graph: replaces the scene graph's relations in beliefs; `graph` goes on beside it.

        """
        self.config = config or StackConfig()
        self._believed = BelievedScene(static_map, models)
        self._body = SelfFilter(robot)
        c = self.config
        self._presegmenter = Presegmenter(
            self._believed.twin(),
            SelfFilter(robot),
            c.presegmentation,
            c.segmentation_time,
            c.segmentation_time,
            c.wait,
            c.threads,
        )
        self._correction_thread = worker("localization", c.wait, c.threads)
        self._correction = Beside[Localization](self._correction_thread, c.correction_time, c.wait)
        self.localizer = localizer or self._mesh_localizer(static_map, T_map_base)
        self.tracker = tracker or ObjectTracker(models, self.config.tracker)
        self.articulation = (
            ArticulationTracker(static_map, self.config.articulation) if static_map.articulations else None
        )
        self.graph = SceneGraph(static_map, models, self.config.scene_graph)
        self._relations = scene_graph
        self.detections = DetectorRunner(detector, models, self.config.runner, c.threads)
        self.on_detection: Callable[[DetectionResult], None] | None = None
        """Called with every answer of the detector as it is given (recorders listen here)."""
        self._joints: deque[JointState] = deque(maxlen=64)
        self._scan: LidarScan | None = None
        """Whose correction is at work."""
        self._sure = False
        """Whether the last scan left no doubt about the pose."""
        self._segmented: RgbdFrame | None = None
        """Which image is at work."""
        self._lidar: Presegmentation | None = None
        self._scans = 0
        self._last_scan: int | None = None
        self._fresh_scan = False
        self._scan_joints: dict[str, float] = {}
        self._own_shots: tuple[LidarScan, Bool] | None = None
        self._belief: Belief | None = None
        self._status: dict[str, Status] = {}
        self._seconds: dict[str, float] = {}

    def close(self) -> None:
        """Release the scenes' memory, and end the threads that work beside the frames."""
        self._correction.drop()
        self._correction_thread.shutdown()
        self._believed.close()
        self._presegmenter.close()
        if self.articulation is not None:
            self.articulation.close()
        self.detections.close()
        if isinstance(self.tracker, ObjectTracker):
            self.tracker.close()

    def wants_image(self, stamp: int) -> bool:
        """Whether the colour of an image with this stamp would be looked at."""
        return self.detections.due(stamp) and not self._presegmenter.image.busy

    def process(self, frame: SensorFrame) -> Belief | None:
        """Take one frame, in the order of arrival; returns what is believed after an RGB-D frame."""
        match frame:
            case Odometry():
                self._guard("odometry", lambda: self.localizer.predict(frame), None)
            case JointState():
                if np.isfinite(frame.positions).all() and len(frame.positions) == len(frame.names):
                    self._joints.append(frame)
            case LidarScan():
                self._take_scan(frame)
            case RgbdFrame():
                return self._take_image(frame)
        return None

    # ----------------------------------------------------------------------------------------------------------- stages

    def _mesh_localizer(self, static_map: StaticMap, T_map_base: Float64 | None) -> MeshLocalizer:
        """MICP-L in the believed scene: what stands before the map is seen, not taken for the map."""
        scene = self._believed.scene
        own = weakref.proxy(self)  # the localizer must not hold the stack, or its memory waits for the collector
        localizer = MeshLocalizer(
            static_map,
            self.config.localizer,
            scene,
            map_instance=MAP,
            lidar_mask=lambda scan: own._own_lidar_shots(scan),
            depth_mask=lambda frame: own._own_pixels(frame),
        )
        if T_map_base is not None:
            localizer.initialise(0, T_map_base)
        return localizer

    def _take_scan(self, scan: LidarScan) -> None:
        """Correct the pose with a scan: beside the frames, unless the localizer is one that cannot."""
        end = scan_end(scan)
        if not isinstance(self.localizer, MeshLocalizer):
            self._scan_joints = self._joint_positions(scan.stamp)
            with self._timed("localization"):
                localization = self._guard("localization", lambda: self.localizer.update(scan), None)
            self._located(scan, localization, end)
            return
        if self._correction.keeps_waiting:
            return  # a live robot lets this scan go by
        if self._scan is not None:
            self._settle_scan(self._scan, end)
        self._believe()
        self._own_shots, self._scan_joints = None, self._joint_positions(scan.stamp)
        self._scan = scan
        self._correction.begin(end, self.localizer.begin(scan))
        if not self._sure and self.config.wait:
            self._settle_scan(scan, end)

    def _settle_scan(self, scan: LidarScan, now: int) -> None:
        """Take up the correction with a scan, at a stamp."""
        self._scan = None
        localization = self._guard("localization", self._corrected, None)
        self._spent("localization", self._correction.seconds)
        self._located(scan, localization, now)

    def _corrected(self) -> Localization:
        assert isinstance(self.localizer, MeshLocalizer)
        found = self._correction.settle()
        self.localizer.adopt()
        return found

    def _located(self, scan: LidarScan, localization: Localization | None, now: int) -> None:
        """Note how a scan fared; begin to segment it if it is its turn."""
        if localization is not None:
            self._status["localization"] = localization.status
        self._sure = localization is not None and localization.status is Status.OK
        if localization is None or localization.status in (Status.STALE, Status.NO_DATA, Status.FAILED):
            return
        self._last_scan, self._fresh_scan = scan.stamp, True
        self._scans += 1
        if self._scans % self.config.lidar_presegmentation_every == 0 and not self._presegmenter.scan.busy:
            poses = {stamp: self.localizer.pose_at(stamp).T_map_base for stamp in shot_stamps(scan)}
            tracks = self._belief.tracks if self._belief is not None else ()
            joints = self._belief.joints if self._belief is not None else ()
            self._presegmenter.begin_scan(now, scan, poses, tracks, self._own_lidar_shots(scan), joints)

    def _take_image(self, frame: RgbdFrame) -> Belief:
        if self._belief is not None and frame.stamp <= self._belief.stamp:
            self._status["frame"] = Status.STALE
            return self._repeat()
        if not _usable(frame):
            self._status["frame"] = Status.FAILED
            return self._repeat() if self._belief is not None else self._nothing(frame.stamp)
        self._status["frame"] = Status.OK if np.any(frame.depth > 0.0) else Status.NO_DATA

        wanted = self.wants_image(frame.stamp)
        if self._scan is not None and self._correction.due(frame.stamp):
            self._settle_scan(self._scan, frame.stamp)
        with self._timed("localization"):
            localization = self._locate(frame)
        T_map_camera = localization.T_map_base @ frame.T_base_camera
        covariance = _camera_covariance(localization, T_map_camera)

        with self._timed("detection"):
            hypotheses = self._guard("detection", lambda: self.detections.collect(frame.stamp), [])
        with self._timed("tracking"):
            tracked = self._track(frame, T_map_camera, covariance, hypotheses)
        with self._timed("articulation"):
            joints = self._articulated(frame, T_map_camera, covariance)
        camera = self._settle_segmentation(frame.stamp)
        if wanted:
            self._segmented = frame
            own = self._joint_positions(frame.stamp)
            self._presegmenter.begin_image(frame, T_map_camera, tracked.tracks, own, joints)
        with self._timed("scene_graph"):
            relations = self._guard("scene_graph", lambda: self._relate(frame.stamp, tracked), frozenset())

        self._belief = Belief(
            stamp=frame.stamp,
            localization=localization,
            T_map_camera=T_map_camera,
            tracks=tracked.tracks,
            camera=camera,
            lidar=self._lidar,
            relations=relations,
            joints=joints,
            status=dict(self._status),
            stage_seconds=dict(self._seconds),
        )
        self._seconds.clear()
        return self._belief

    def _locate(self, frame: RgbdFrame) -> Localization:
        """Pose at an image's stamp.

        Where the lidar has been silent, or left directions open, the image itself helps: then the first image after
        each scan, so that the next scan is not older than what is known already.
        """
        if self._last_scan is None:
            self._last_scan = frame.stamp
        silent = frame.stamp - self._last_scan > self.config.lidar_silence * NANOSECONDS
        if isinstance(self.localizer, MeshLocalizer) and self._scan is None and (silent or self._fresh_scan):
            self._fresh_scan = False
            localizer = self.localizer
            self._believe()
            found = self._guard("localization", lambda: localizer.update_depth(frame), None)
            if found is not None:
                self._status["localization"] = found.status
                return found
        return self.localizer.pose_at(frame.stamp)

    def _track(
        self, frame: RgbdFrame, T_map_camera: Float64, covariance: Float64, hypotheses: Sequence[PoseHypothesis]
    ) -> TrackerResult:
        kept = self._belief.tracks if self._belief is not None else ()
        fallback = TrackerResult(frame.stamp, kept, Status.FAILED)
        result = self._guard(
            "tracking", lambda: self.tracker.update(frame, T_map_camera, covariance, hypotheses), fallback
        )
        self._status["tracking"] = result.status
        return result

    def _articulated(self, frame: RgbdFrame, T_map_camera: Float64, covariance: Float64) -> tuple[JointEstimate, ...]:
        tracker = self.articulation
        if tracker is None:
            return ()
        kept = self._belief.joints if self._belief is not None else tracker.estimates(frame.stamp)

        def work() -> tuple[JointEstimate, ...]:
            return tracker.update(frame, T_map_camera, covariance, self._own_pixels(frame))

        return self._guard("articulation", work, kept)

    def _believe(self) -> None:
        """Bring the scene of localization to what is believed now."""
        if self._belief is not None:
            self._believed.update(self._belief.tracks, self._belief.joints)
        else:
            self._believed.update(())

    def _settle_segmentation(self, now: int) -> Presegmentation | None:
        """Take up what has been segmented; the detector gets the image, with what nothing explains in it."""
        scan, image = self._presegmenter.scan, self._presegmenter.image
        if scan.due(now):
            self._lidar = self._guard("presegmentation", scan.settle, self._lidar)
            self._spent("presegmentation", scan.seconds)
        if self._segmented is None or not image.due(now):
            return None
        frame, self._segmented = self._segmented, None
        camera = self._guard("presegmentation", image.settle, None)
        self._spent("presegmentation", image.seconds)
        with self._timed("detection"):
            self._detect(frame, camera)
        return camera

    def _detect(self, frame: RgbdFrame, camera: Presegmentation | None) -> None:
        result = self.detections.submit(frame, camera.regions if camera is not None else ())
        self._status["detection"] = self.detections.status
        if result is not None and self.on_detection is not None:
            self.on_detection(result)

    def _relate(self, stamp: int, tracked: TrackerResult) -> Set[Relation]:
        relations = self.graph.update(stamp, tracked.tracks)
        return relations if self._relations is None else self._relations.update(stamp, tracked.tracks)

    # ---------------------------------------------------------------------------------------------------------- support

    def _own_pixels(self, frame: RgbdFrame) -> np.ndarray:
        return self._body.camera_mask(frame, self._joint_positions(frame.stamp))

    def _own_lidar_shots(self, scan: LidarScan) -> Bool:
        if self._own_shots is None or self._own_shots[0] is not scan:
            self._own_shots = scan, self._body.lidar_mask(scan, self._scan_joints)
        return self._own_shots[1]

    def _joint_positions(self, stamp: int) -> dict[str, float]:
        """Encoder readings nearest in time to a stamp."""
        if not self._joints:
            return {}
        nearest = min(self._joints, key=lambda j: abs(j.stamp - stamp))
        return dict(zip(nearest.names, nearest.positions.tolist(), strict=True))

    def _guard(self, stage: str, work: Callable[[], T], fallback: T) -> T:
        """Run a stage; what it raises on a frame's data becomes a status."""
        try:
            result = work()
        except (ArithmeticError, ValueError, IndexError, np.linalg.LinAlgError):
            self._status[stage] = Status.FAILED
            return fallback
        self._status[stage] = Status.OK
        return result

    @contextmanager
    def _timed(self, stage: str) -> Iterator[None]:
        start = time.perf_counter()
        try:
            yield
        finally:
            self._spent(stage, time.perf_counter() - start)

    def _spent(self, stage: str, seconds: float) -> None:
        self._seconds[stage] = self._seconds.get(stage, 0.0) + seconds

    def _repeat(self) -> Belief:
        """The last belief again, with the present statuses."""
        assert self._belief is not None
        b = self._belief
        return Belief(
            b.stamp, b.localization, b.T_map_camera, b.tracks, None, b.lidar, b.relations, dict(self._status), {},
            b.joints,
        )  # fmt: skip

    def _nothing(self, stamp: int) -> Belief:
        """A belief before any usable image."""
        localization = self.localizer.pose_at(stamp)
        return Belief(
            stamp, localization, localization.T_map_base, (), None, self._lidar, frozenset(), dict(self._status), {}
        )


def _usable(frame: RgbdFrame) -> bool:
    """Whether a frame's arrays have the shapes that its intrinsics promise, and its pose is one."""
    K = frame.intrinsics
    focal = np.isfinite([K.fx, K.fy, K.cx, K.cy]).all() and K.fx > 0.0 and K.fy > 0.0
    return frame.depth.shape == (K.height, K.width) and bool(focal) and is_rigid(frame.T_base_camera, 1e-4)


def _camera_covariance(localization: Localization, T_map_camera: Float64) -> Float64:
    """(6, 6) covariance of the camera's pose in the map: that of the base with the lever arm between them."""
    return with_lever(localization.covariance, T_map_camera[:3, 3] - localization.T_map_base[:3, 3])
