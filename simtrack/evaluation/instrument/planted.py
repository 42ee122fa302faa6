"""Trackers with a planted mistake, to see that the instrument puts it down to the tracker.

simtrack's own tracker behind an interface that errs as interfaces do: ``simtrack attribute --tracker
simtrack.evaluation.instrument.planted:TransposedTracker``.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from simtrack.contracts import Float64, PoseHypothesis, RgbdFrame, Track, TrackerResult
from simtrack.geometry.transforms import inverse, quaternion_from_rotation, rotation_from_quaternion
from simtrack.objects import ObjectModel
from simtrack.perception.tracking.tracker import ObjectTracker


class _PlantedTracker:
    """simtrack's tracker, whose answers are changed on their way."""

    def __init__(self, models: Mapping[str, ObjectModel], rotation: Callable[[Float64], Float64]) -> None:
        """`rotation`: (3, 3) of a track in the map -> what is answered instead."""
        self._tracker, self._rotation = ObjectTracker(models), rotation

    def update(
        self, frame: RgbdFrame, T_map_camera: Float64, covariance: Float64, hypotheses: Sequence[PoseHypothesis] = ()
    ) -> TrackerResult:
        """See `Tracker.update`."""
        found = self._tracker.update(frame, T_map_camera, covariance, hypotheses)
        return replace(found, tracks=tuple(self._changed(track, T_map_camera) for track in found.tracks))

    def _changed(self, track: Track, T_map_camera: Float64) -> Track:
        T = track.T_map_object.copy()
        T[:3, :3] = self._rotation(T[:3, :3])
        return replace(track, T_map_object=T, T_camera_object=inverse(T_map_camera) @ T)

    def close(self) -> None:
        """Release the scenes' memory."""
        self._tracker.close()


class TransposedTracker(_PlantedTracker):
    """Matrices are written row by row and read column by column."""

    def __init__(self, models: Mapping[str, ObjectModel]) -> None:
        super().__init__(models, np.transpose)


class SwappedQuaternionTracker(_PlantedTracker):
    """Quaternions are written ``w x y z`` and read ``x y z w``."""

    def __init__(self, models: Mapping[str, ObjectModel]) -> None:
        super().__init__(models, _misread)


def _misread(R: Float64) -> Float64:
    w, x, y, z = quaternion_from_rotation(R)
    return rotation_from_quaternion(np.array([z, w, x, y]))


class LateTracker:
    """Every answer is that of the image before, in the map as in the camera."""

    def __init__(self, models: Mapping[str, ObjectModel]) -> None:
        self._tracker, self._before = ObjectTracker(models), tuple[Track, ...]()

    def update(
        self, frame: RgbdFrame, T_map_camera: Float64, covariance: Float64, hypotheses: Sequence[PoseHypothesis] = ()
    ) -> TrackerResult:
        """See `Tracker.update`."""
        found = self._tracker.update(frame, T_map_camera, covariance, hypotheses)
        late, self._before = self._before, found.tracks
        return replace(found, tracks=tuple(replace(track, stamp=frame.stamp) for track in late))

    def close(self) -> None:
        """Release the scenes' memory."""
        self._tracker.close()
