"""What is wrong with the answers of foreign stages; a short way to make a right one.

Each check returns what is wrong in a few words, an empty string if nothing is.
"""

from collections.abc import Collection, Set

import numpy as np

from simtrack.contracts import (
    Detection,
    DetectionResult,
    Float64,
    Localization,
    Relation,
    RgbdFrame,
    Status,
    Track,
    TrackerResult,
    TrackStatus,
)
from simtrack.geometry.transforms import is_rigid

RIGID = 1e-4
"""Largest deviation of a rotation matrix from an orthonormal one, so that float32 will do."""
FAR = 100.0
"""Metres from the camera at which no object is seen: whoever puts one there means millimetres."""


def track_at(
    frame: RgbdFrame,
    T_map_camera: Float64,
    number: int,
    class_name: str,
    T_camera_object: Float64,
    *,
    status: TrackStatus = TrackStatus.CONFIRMED,
    translation_sigma: float = 0.005,
    rotation_sigma: float = 0.05,
    score: float = 0.9,
) -> Track:
    """A track of an object at rest that is seen at a pose, with what a simple tracker does not know filled in.

    Args:
        frame: the image that the pose was found in.
        T_map_camera: (4, 4), as the tracker was told it.
        number: id of the track, from 1, the same as long as it is the same object.
        class_name: name of its model.
        T_camera_object: (4, 4).
        status: believed are confirmed, occluded and out-of-view ones.
        translation_sigma: standard deviation, metres, of each coordinate in the map.
        rotation_sigma: likewise, radians.
        score: 0 to 1.

    """
    T_camera_object = np.asarray(T_camera_object, dtype=float)
    return Track(
        id=number, class_name=class_name, status=status, stamp=frame.stamp,
        T_map_object=T_map_camera @ T_camera_object,
        covariance=np.diag([translation_sigma**2] * 3 + [rotation_sigma**2] * 3),
        T_camera_object=T_camera_object, velocity=np.zeros(6), last_seen=frame.stamp, visible_fraction=1.0,
        moving=False, residual=0.0, score=score,
    )  # fmt: skip


def wrong_tracks(result: object, stamp: int, classes: Collection[str]) -> str:
    """Of a tracker's answer to an image."""
    if not isinstance(result, TrackerResult):
        return f"update returned {_kind(result)}, not a TrackerResult"
    if result.stamp != stamp:
        return f"the stamp is {result.stamp}, that of the frame is {stamp}"
    if not isinstance(result.status, Status):
        return f"the status is {_kind(result.status)}, not a Status"
    seen: set[int] = set()
    for track in result.tracks:
        if reason := _wrong_track(track, stamp, classes):
            return reason
        if track.id in seen:
            return f"two tracks have the id {track.id}"
        seen.add(track.id)
    return ""


def _wrong_track(track: object, stamp: int, classes: Collection[str]) -> str:
    if not isinstance(track, Track):
        return f"tracks hold {_kind(track)}, not a Track"
    name = f"track {track.id!r}"
    if not isinstance(track.id, int) or track.id < 1:
        return f"{name}: an id is an integer from 1"
    if track.class_name not in classes:
        return f"{name}: no model is called {track.class_name!r}; known: {', '.join(sorted(classes))}"
    if not isinstance(track.status, TrackStatus):
        return f"{name}: the status is {_kind(track.status)}, not a TrackStatus"
    if track.stamp != stamp:
        return f"{name}: the stamp is {track.stamp}, that of the frame is {stamp}"
    for field in ("T_map_object", "T_camera_object"):
        if reason := _wrong_pose(getattr(track, field)):
            return f"{name}: {field} {reason}"
    if (distance := float(np.linalg.norm(track.T_camera_object[:3, 3]))) > FAR:
        return f"{name}: T_camera_object lies {distance:.0f} m away; metres are asked for: are these millimetres?"
    if reason := _wrong_covariance(track.covariance):
        return f"{name}: {reason}"
    if np.shape(track.velocity) != (6,) or not np.isfinite(track.velocity).all():
        return f"{name}: the velocity is not (6,) finite numbers"
    if not np.isfinite([track.visible_fraction, track.residual, track.score]).all():
        return f"{name}: visible_fraction, residual or score is not finite"
    return ""


def wrong_localization(found: object, earliest: int, latest: int | None = None) -> str:
    """Of a localizer's answer, whose stamp has to lie from `earliest` to `latest`."""
    if not isinstance(found, Localization):
        return f"returned {_kind(found)}, not a Localization"
    if found.stamp < earliest or (latest is not None and found.stamp > latest):
        return f"the stamp is {found.stamp}, that of the data is {earliest}"
    if not isinstance(found.status, Status):
        return f"the status is {_kind(found.status)}, not a Status"
    if reason := _wrong_pose(found.T_map_base):
        return f"T_map_base {reason}"
    return _wrong_covariance(found.covariance)


def wrong_detections(result: object, stamp: int) -> str:
    """Of a detector's answer to an image."""
    if not isinstance(result, DetectionResult):
        return f"detect returned {_kind(result)}, not a DetectionResult"
    if result.stamp != stamp:
        return f"the stamp is {result.stamp}, that of the frame is {stamp}"
    if result.available < stamp:
        return f"available = {result.available} lies before the image's stamp {stamp}"
    if result.next_image is not None and result.next_image < stamp:
        return f"next_image = {result.next_image} lies before the image's stamp {stamp}"
    for number, detection in enumerate(result.detections):
        if not isinstance(detection, Detection):
            return f"detections hold {_kind(detection)}, not a Detection"
        for field, shape in (("keypoints", (9, 2)), ("keypoint_sigma", (9,)), ("box", (4,))):
            value = getattr(detection, field)
            if np.shape(value) != shape or not np.isfinite(value).all():
                return f"detection {number}: {field} is not {shape} finite numbers"
        if not (detection.keypoint_sigma > 0.0).all() or not 0.0 <= detection.score <= 1.0:
            return f"detection {number}: keypoint_sigma has to be positive, score 0 to 1"
    return ""


def wrong_relations(found: object, names: Collection[str]) -> str:
    """Of a scene graph builder's answer, whose relations have one of `names`."""
    if not isinstance(found, Set):
        return f"update returned {_kind(found)}, not a set of Relation"
    for relation in found:
        if not isinstance(relation, Relation):
            return f"the relations hold {_kind(relation)}, not a Relation"
        if relation.name not in names:
            return f"no relation is called {relation.name!r}; known: {', '.join(sorted(names))}"
        if not isinstance(relation.subject, str) or not isinstance(relation.reference, str):
            return f"{relation.name}: subject and reference are names of entities"
    return ""


def _wrong_pose(T: object) -> str:
    if not isinstance(T, np.ndarray) or T.shape != (4, 4):
        return "is not a (4, 4) array"
    if not np.isfinite(T).all():
        return "is not finite"
    return "" if is_rigid(T, RIGID) else "is no rigid transform"


def _wrong_covariance(covariance: object) -> str:
    if not isinstance(covariance, np.ndarray) or covariance.shape != (6, 6) or not np.isfinite(covariance).all():
        return "the covariance is not (6, 6) finite numbers"
    values = np.linalg.eigvalsh(0.5 * (covariance + covariance.T))
    return "" if values[0] >= -1e-9 * max(values[-1], 1e-12) else "the covariance is not positive semidefinite"


def _kind(value: object) -> str:
    return f"a {type(value).__name__}"
