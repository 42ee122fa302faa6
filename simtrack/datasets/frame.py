"""What a generated frame is: images, scans, and every label, in the conventions of the project.

Writers convert units and file conventions; nothing here is in millimetres, and no box carries a format's own rules.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from simtrack.contracts import (
    Bool,
    CameraIntrinsics,
    Float32,
    Float64,
    Int32,
    LidarScan,
    Odometry,
    Relation,
    StaticMap,
    Uint8,
)
from simtrack.geometry.kinematics import KinematicTree
from simtrack.objects import ObjectModel


@dataclass(frozen=True, slots=True, eq=False)
class Category:
    """A class of labelled objects: all instances of one model."""

    id: int
    """1, 2, ... in the recipe's order of targets; BOP's obj_id, and COCO's category_id."""
    model: ObjectModel
    """Its mesh is what frames show, in the object frame (origin in the middle of the box, z up), metres."""


@dataclass(frozen=True, slots=True)
class StuffCategory:
    """A class of what is no labelled instance: walls, furniture, distractors."""

    id: int
    """Above all ids of `Category`."""
    name: str
    """Semantic class."""
    thing: bool
    """Whether its instances are told apart in panoptic labels (distractors are), or are one segment (walls are)."""


@dataclass(frozen=True, slots=True, eq=False)
class DatasetInfo:
    """What all frames of a data set have in common."""

    name: str
    description: str
    seed: int
    recipe: str
    """The recipe as YAML, canonical: what a folder was made from."""
    intrinsics: CameraIntrinsics
    categories: tuple[Category, ...]
    stuff: tuple[StuffCategory, ...]
    split: str = "train"
    """train, val or test."""
    val_share: float = 0.1
    """Share of scenes that formats with a split of their own (YOLO, COCO) put into val: see `is_val`."""

    def is_val(self, scene: int) -> bool:
        """Whether a scene belongs to the validation share: every k-th one, whatever their number."""
        return self.val_share > 0.0 and int((scene + 1) * self.val_share) > int(scene * self.val_share)


@dataclass(frozen=True, slots=True, eq=False)
class InstanceLabel:
    """One instance in one frame. Targets have all fields; distractors have no category and no keypoints."""

    instance: int
    """Its value in `LabelledFrame.ids`."""
    name: str
    """Unique in the scene."""
    semantic_class: str
    category: int | None
    """`Category.id`; None for a distractor."""
    T_map_object: Float64
    """(4, 4)."""
    T_camera_object: Float64
    """(4, 4)."""
    extents: Float64
    """(3,), side lengths of the box about the object frame's origin, metres."""
    amodal: Bool
    """(H, W), silhouette inside the image as if nothing else were there."""
    pixels_all: int
    """Pixels of the silhouette on a canvas of three times the image's width and height with the image in the middle."""
    pixels_valid: int
    """Pixels of the silhouette inside the image where the written depth is a reading."""
    pixels_visible: int
    """Pixels of the visible part: ``ids == instance``."""
    box_amodal: tuple[int, int, int, int] | None
    """(u0, v0, u1, v1), first and last pixel of the whole silhouette on the canvas, in image coordinates (they may be
    negative); None without a pixel."""
    box_visible: tuple[int, int, int, int] | None
    """(u0, v0, u1, v1), first and last pixel of the visible part; None without a pixel."""
    keypoints: Float64
    """(K, 2), pixels, of the category's keypoints, inside the image or not; (0, 2) for a distractor."""
    keypoint_visibility: Int32
    """(K,): 0 outside the image or behind the camera, 1 inside and hidden, 2 seen. A keypoint on the box hull counts as
    seen if nothing but the object itself lies between it and the camera."""

    @property
    def visible_fraction(self) -> float:
        """Share of the whole silhouette that is visible, 0 to 1; the part outside the image is not."""
        return self.pixels_visible / self.pixels_all if self.pixels_all else 0.0


@dataclass(frozen=True, slots=True, eq=False)
class LidarLabels:
    """A lidar scan and what its shots met."""

    scan: LidarScan
    T_map_lidar: Float64
    """(4, 4), at the scan's stamp."""
    instances: Int32
    """(N,), as in `LabelledFrame.ids`, by shot; -1 = nothing."""


@dataclass(frozen=True, slots=True, eq=False)
class LabelledFrame:
    """One image with all of its labels."""

    scene: int
    index: int
    """In the scene, from 0."""
    stamp: int
    """Nanoseconds since the scene's beginning."""
    intrinsics: CameraIntrinsics
    T_map_camera: Float64
    """(4, 4)."""
    rgb: Uint8
    """(H, W, 3)."""
    depth: Float32
    """(H, W), metres along the optical axis, as the sensor measures it; 0 = no reading."""
    clean_depth: Float32
    """(H, W), without the sensor's errors; 0 = nothing within range."""
    normals: Float32
    """(H, W, 3), unit, camera frame, towards the camera; 0 where nothing is."""
    ids: Int32
    """(H, W), nearest instance by exact ray casting, index into `names`; -1 = nothing."""
    names: tuple[str, ...]
    """Of everything in the scene, by id."""
    segment_categories: Int32
    """(len(names),), id of the `Category` or `StuffCategory` of each id."""
    labels: tuple[InstanceLabel, ...]
    """Targets and distractors, by ascending instance; all of the scene's, seen or not."""
    lidar: LidarLabels | None = None
    odometry: Odometry | None = None
    T_map_base: Float64 | None = None
    """(4, 4), of the robot that carries the camera, if there is one."""
    joints: Mapping[str, float] = field(default_factory=dict)
    """Positions of the robot's joints, radians or metres."""
    support: tuple[tuple[str, str], ...] = ()
    """(carried, carrier), direct contacts from above, from physics."""
    relations: tuple[Relation, ...] = ()

    @property
    def key(self) -> str:
        """``000012_000003``: scene and image."""
        return f"{self.scene:06d}_{self.index:06d}"

    def targets(self) -> tuple[InstanceLabel, ...]:
        """The labels that have a category."""
        return tuple(label for label in self.labels if label.category is not None)


@dataclass(frozen=True, slots=True, eq=False)
class SceneInfo:
    """What all frames of a scene have in common; handed to writers before the first frame."""

    scene: int
    frames: int
    static_map: StaticMap | None = None
    """The estimator's map, where a robot drives."""
    robot: KinematicTree | None = None
    """The robot's body, if there is one; `LabelledFrame.joints` moves it."""


def no_labels() -> np.ndarray:
    """(0, 2) keypoints, of what has none."""
    return np.empty((0, 2))
