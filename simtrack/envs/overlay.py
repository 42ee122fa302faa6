"""What is believed, drawn over a picture: boxes of the believed objects, the believed robot, and a line of figures."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from simtrack.contracts import Belief, CameraIntrinsics, Float64, TrackStatus, Uint8
from simtrack.geometry.transforms import apply, inverse
from simtrack.objects import ObjectModel
from simtrack.objects.model import BOX_EDGES, box_keypoints

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

COLORS: Mapping[TrackStatus, tuple[int, int, int]] = {
    TrackStatus.CONFIRMED: (60, 200, 90),
    TrackStatus.OCCLUDED: (240, 170, 30),
    TrackStatus.OUT_OF_VIEW: (80, 150, 240),
    TrackStatus.TENTATIVE: (170, 170, 170),
    TrackStatus.LOST: (230, 60, 60),
}
"""RGB of the box of a track."""
ROBOT = (250, 220, 60)
"""RGB of the robot's outline where it believes to be."""
ROBOT_BOX = np.array([0.54, 0.54, 0.3])
"""Side lengths of the box that stands for the base, metres."""
NEAREST = 0.05
"""Metres before the camera at which lines are cut off."""


def draw_belief(
    picture: Uint8,
    intrinsics: CameraIntrinsics,
    T_map_camera: Float64,
    belief: Belief,
    models: Mapping[str, ObjectModel],
) -> Uint8:
    """(H, W, 3), a copy of a picture with the box of every track and of the robot where they are believed to be."""
    out, T_camera_map = picture.copy(), inverse(T_map_camera)
    for track in belief.tracks:
        corners = models[track.class_name].keypoints[:8]
        _box(out, intrinsics, apply(T_camera_map @ track.T_map_object, corners), COLORS[track.status])
    base = box_keypoints(ROBOT_BOX)[:8] + np.array([0.0, 0.0, ROBOT_BOX[2] / 2])
    _box(out, intrinsics, apply(T_camera_map @ belief.localization.T_map_base, base), ROBOT)
    return out


def write_lines(picture: Uint8, lines: Sequence[str]) -> None:
    """Write lines of text onto a darkened strip at the top of a picture (H, W, 3), in place."""
    import cv2

    picture[: 16 * len(lines) + 8] //= 3
    for k, line in enumerate(lines):
        at = (8, 17 + 16 * k)
        cv2.putText(picture, line, at, cv2.FONT_HERSHEY_SIMPLEX, 0.4, (255, 255, 255), 1, cv2.LINE_AA)


def _box(out: Uint8, intrinsics: CameraIntrinsics, corners: Float64, color: tuple[int, int, int]) -> None:
    import cv2

    for first, second in BOX_EDGES:
        ends = _before(corners[first], corners[second])
        if ends is not None:
            start, stop = (_pixel(end, intrinsics) for end in ends)
            cv2.line(out, start, stop, color, 1, cv2.LINE_AA)


def _before(a: "ArrayLike", b: "ArrayLike") -> tuple[Float64, Float64] | None:
    """The part of a line that lies before the camera."""
    start, stop = np.asarray(a, dtype=float), np.asarray(b, dtype=float)
    if max(start[2], stop[2]) <= NEAREST:
        return None
    if start[2] < NEAREST:
        start = stop + (start - stop) * (stop[2] - NEAREST) / (stop[2] - start[2])
    elif stop[2] < NEAREST:
        stop = start + (stop - start) * (start[2] - NEAREST) / (start[2] - stop[2])
    return start, stop


def _pixel(point: Float64, K: CameraIntrinsics) -> tuple[int, int]:
    u, v = K.fx * point[0] / point[2] + K.cx, K.fy * point[1] / point[2] + K.cy
    return round(float(np.clip(u, -1e4, 1e4))), round(float(np.clip(v, -1e4, 1e4)))
