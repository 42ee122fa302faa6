"""All labels in plain arrays and JSON, among them those that no other format holds.

One folder a scene. ``000003.json``: camera, robot, poses, boxes, keypoints with visibility, support and relations.
``000003.npz`` (`numpy.load`):

=================  ==================  ==============================================================================
``ids``            (H, W) int16        nearest instance, index into ``names`` of the JSON file; -1 = nothing
``clean_depth``    (H, W) float32      metres along the optical axis without the sensor's errors; 0 = nothing
``normals``        (H, W, 3) int8      unit normals in the camera frame times 127; 0 = nothing
``lidar_points``   (N, 3) float32      metres, lidar frame at each shot's own time; NaN = no return
``lidar_ring``     (N,) uint8          0 = lowest
``lidar_time``     (N,) float32        seconds after the scan's stamp
``lidar_intensity``  (N,) float32      0 to 255
``lidar_instance``   (N,) int32        as in ``ids``
=================  ==================  ==============================================================================

``trajectory.csv`` has a line an image: stamp in nanoseconds, pose of the camera and, if there is one, of the robot's
base in the map, as x, y, z, qw, qx, qy, qz.
"""

import io
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from simtrack.contracts import Float64
from simtrack.datasets.frame import DatasetInfo, InstanceLabel, LabelledFrame, LidarLabels, SceneInfo
from simtrack.datasets.writers.streams import compact, scene_name
from simtrack.geometry.transforms import quaternion_from_rotation
from simtrack.simulation.strict_file import Strict

_POSE = ("x", "y", "z", "qw", "qx", "qy", "qz")
_COLUMNS = "stamp," + ",".join(f"{who}_{what}" for who in ("camera", "base") for what in _POSE)


class LabelsOptions(Strict):
    """What a recipe may say of the writer."""

    normals: bool = True
    clean_depth: bool = True


class LabelsWriter:
    """Writes arrays and JSON; see `simtrack.datasets.writer.DatasetWriter`."""

    name = "labels"

    def __init__(self, options: LabelsOptions) -> None:
        self.options = options

    def begin(self, root: Path, info: DatasetInfo) -> None:
        """Nothing is said for all scenes together."""

    def open_scene(self, staging: Path, info: DatasetInfo, scene: SceneInfo) -> "LabelsSceneWriter":
        """Start a scene."""
        return LabelsSceneWriter(staging / self.name / scene_name(scene.scene), self.options)

    def finish(self, root: Path, info: DatasetInfo, scenes: int) -> None:
        """Nothing is said for all scenes together."""


class LabelsSceneWriter:
    """Writes one scene."""

    def __init__(self, folder: Path, options: LabelsOptions) -> None:
        self._folder, self._options = folder, options
        folder.mkdir(parents=True)
        self._trajectory = (folder / "trajectory.csv").open("w", encoding="ascii", newline="\n")
        self._trajectory.write(_COLUMNS + "\n")

    def write(self, frame: LabelledFrame) -> None:
        """Write a frame."""
        path = self._folder / f"{frame.index:06d}.json"
        path.write_text(compact(describe(frame)) + "\n", encoding="utf-8", newline="\n")
        path.with_suffix(".npz").write_bytes(npz(self._arrays(frame)))
        base = "," * 7 if frame.T_map_base is None else f",{_pose(frame.T_map_base)}"
        self._trajectory.write(f"{frame.stamp},{_pose(frame.T_map_camera)}{base}\n")

    def close(self) -> None:
        """Release the files."""
        self._trajectory.close()

    def _arrays(self, frame: LabelledFrame) -> dict[str, np.ndarray]:
        arrays: dict[str, np.ndarray] = {"ids": frame.ids.astype(np.int16)}
        if self._options.clean_depth:
            arrays["clean_depth"] = frame.clean_depth
        if self._options.normals:
            arrays["normals"] = np.rint(frame.normals * np.float32(127.0)).astype(np.int8)
        return arrays if frame.lidar is None else arrays | _lidar_arrays(frame.lidar)


def describe(frame: LabelledFrame) -> dict[str, Any]:
    """All labels of a frame that are no images, in metres, radians, pixels and nanoseconds."""
    camera = frame.intrinsics
    names = ("width", "height", "fx", "fy", "cx", "cy")
    return {
        "scene": frame.scene,
        "index": frame.index,
        "stamp": frame.stamp,
        "intrinsics": {name: getattr(camera, name) for name in names},
        "T_map_camera": frame.T_map_camera.tolist(),
        "T_map_base": None if frame.T_map_base is None else frame.T_map_base.tolist(),
        "T_map_lidar": None if frame.lidar is None else frame.lidar.T_map_lidar.tolist(),
        "lidar_stamp": None if frame.lidar is None else frame.lidar.scan.stamp,
        "joints": dict(frame.joints),
        "names": frame.names,
        "categories": frame.segment_categories.tolist(),
        "objects": [_describe_object(label) for label in frame.labels],
        "support": [{"carried": carried, "carrier": carrier} for carried, carrier in frame.support],
        "relations": [[r.subject, r.name, r.reference] for r in frame.relations],
    }


def _describe_object(label: InstanceLabel) -> dict[str, Any]:
    return {
        "instance": label.instance,
        "name": label.name,
        "semantic_class": label.semantic_class,
        "category": label.category,
        "T_map_object": label.T_map_object.tolist(),
        "T_camera_object": label.T_camera_object.tolist(),
        "extents": label.extents.tolist(),
        "pixels_all": label.pixels_all,
        "pixels_valid": label.pixels_valid,
        "pixels_visible": label.pixels_visible,
        "visible_fraction": label.visible_fraction,
        "box_amodal": label.box_amodal,
        "box_visible": label.box_visible,
        "keypoints": label.keypoints.tolist(),
        "keypoint_visibility": label.keypoint_visibility.tolist(),
    }


def _lidar_arrays(lidar: LidarLabels) -> dict[str, np.ndarray]:
    scan = lidar.scan
    ranges = np.where(np.isfinite(scan.ranges), scan.ranges, np.float32(np.nan))
    return {
        "lidar_points": ranges[:, None] * scan.directions,
        "lidar_ring": scan.rings,
        "lidar_time": scan.times,
        "lidar_intensity": scan.intensities,
        "lidar_instance": lidar.instances,
    }


def npz(arrays: dict[str, np.ndarray]) -> bytes:
    """The arrays as a compressed ``.npz`` whose bytes depend on them alone."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, array in arrays.items():
            data = io.BytesIO()
            np.lib.format.write_array(data, np.ascontiguousarray(array), version=(1, 0), allow_pickle=False)
            member = zipfile.ZipInfo(f"{name}.npy")
            member.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(member, data.getvalue())
    return buffer.getvalue()


def _pose(T: Float64) -> str:
    numbers = (*T[:3, 3].tolist(), *quaternion_from_rotation(T[:3, :3]).tolist())
    return ",".join(f"{value:.9f}" for value in numbers)
