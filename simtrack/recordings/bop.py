"""One scene of a BOP data set: images, camera poses, and as labels the poses of the objects whose models lie beside it.

Format: https://github.com/thodan/bop_toolkit, docs/bop_datasets_format.md. Millimetres end here.
"""

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from simtrack.contracts import CameraIntrinsics, Float64, RgbdFrame
from simtrack.errors import FileFormatError
from simtrack.geometry import meshes
from simtrack.geometry.transforms import apply, inverse, transform
from simtrack.objects import ObjectModel, Symmetries, SymmetryAxis
from simtrack.objects.export import MILLIMETRES
from simtrack.objects.model import build_model
from simtrack.recordings.files import numbers, read_bytes, read_depth, read_rgb, rigid
from simtrack.recordings.log import LabelledObject, PosedFrame, SensorLog
from simtrack.recordings.rgbd_folders import PERIOD, CameraOptions

MAX_JSON_BYTES = 2**26
MAX_VISUAL_FACES = 3000
MAX_SIZE = 20.0
"""Metres: a larger model is not in millimetres."""


@dataclass(frozen=True, slots=True)
class _Scene:
    """A scene's folder and its JSON files, checked as far as an entry is used."""

    folder: Path
    cameras: Mapping[int, Mapping[str, Any]]
    poses: Mapping[int, list[Any]]
    visibility: Mapping[int, list[Any]]
    options: CameraOptions
    centres: Mapping[int, Float64]
    """Object id -> (3,), metres, the centre of the model's box in the frame of its file."""


def open_bop(folder: Path, options: CameraOptions) -> SensorLog:
    """A scene folder with ``scene_camera.json``, ``depth/`` and perhaps ``rgb/`` and ``scene_gt.json``.

    Models are looked for in ``models_eval`` and ``models`` beside the split's folder. Images have no stamps: they are
    taken to follow each other at 30 Hz.
    """
    cameras = _by_image(folder / "scene_camera.json", dict)
    poses = _by_image(folder / "scene_gt.json", list) if (folder / "scene_gt.json").is_file() else {}
    infos = folder / "scene_gt_info.json"
    visibility = _by_image(infos, list) if infos.is_file() else {}
    if not cameras:
        raise FileFormatError(folder / "scene_camera.json", "", "names no image")
    used = {_object_id(entry, folder) for entries in poses.values() for entry in entries}
    models, centres = _models(folder.resolve().parent.parent, used)
    scene = _Scene(folder, cameras, poses, visibility, options, centres)
    posed = any("cam_R_w2c" in camera for camera in cameras.values())
    return SensorLog(folder, "BOP scene", "camera", len(cameras), lambda: _frames(scene), models, posed)


def _frames(scene: _Scene) -> Iterator[PosedFrame]:
    path = scene.folder / "scene_camera.json"
    for number, (image, camera) in enumerate(sorted(scene.cameras.items())):
        fx, _, cx, _, fy, cy = _listed(camera, "cam_K", 9, path, image)[:6]
        if scene.options.intrinsics is not None:
            fx, fy, cx, cy = scene.options.intrinsics
        if fx <= 0.0 or fy <= 0.0:
            raise FileFormatError(path, f"{image}.cam_K", "focal lengths must be > 0")
        scale = camera.get("depth_scale", 1.0)
        if isinstance(scale, bool) or not isinstance(scale, (int, float)) or not 0.0 < scale <= 1000.0:
            raise FileFormatError(path, f"{image}.depth_scale", "expected millimetres that 1 stands for, above 0")
        unit = scene.options.depth_unit or scale / MILLIMETRES
        depth = read_depth(scene.folder / "depth" / f"{image:06d}.png", unit)
        rgb = next((read_rgb(file) for file in _colours(scene.folder, image) if file.is_file()), None)
        if rgb is not None and rgb.shape[:2] != depth.shape:
            raise FileFormatError(scene.folder, f"image {image}", "colour and depth differ in size")
        height, width = depth.shape
        T_camera_map = None
        if "cam_R_w2c" in camera:
            T_camera_map = _pose(camera, "cam_R_w2c", "cam_t_w2c", path, image)
        intrinsics = CameraIntrinsics(width, height, fx, fy, cx, cy)
        frame = RgbdFrame(number * PERIOD, depth, rgb, intrinsics, np.eye(4), image)
        yield PosedFrame(frame, None if T_camera_map is None else inverse(T_camera_map), _labels(scene, image))


def _labels(scene: _Scene, image: int) -> tuple[LabelledObject, ...]:
    path, labels = scene.folder / "scene_gt.json", []
    infos = scene.visibility.get(image, [])
    for k, entry in enumerate(scene.poses.get(image, [])):
        number = _object_id(entry, scene.folder)
        if number not in scene.centres:
            continue
        T = _pose(entry, "cam_R_m2c", "cam_t_m2c", path, image) @ transform(translation=scene.centres[number])
        share = infos[k].get("visib_fract") if k < len(infos) and isinstance(infos[k], dict) else None
        visible = float(share) if isinstance(share, (int, float)) else 1.0
        labels.append(LabelledObject(_name(number), T, visible))
    return tuple(labels)


def _name(number: int) -> str:
    return f"obj_{number:06d}"


def _colours(folder: Path, image: int) -> Iterator[Path]:
    for kind in ("rgb", "gray"):
        for suffix in ("png", "jpg"):
            yield folder / kind / f"{image:06d}.{suffix}"


# ----------------------------------------------------------------------------------------------------------------- JSON


def _json(path: Path) -> Any:
    try:
        return json.loads(read_bytes(path, MAX_JSON_BYTES))
    except (ValueError, RecursionError) as error:
        raise FileFormatError(path, "", f"not JSON: {error}") from error


def _by_image(path: Path, kind: type) -> dict[int, Any]:
    """Entries by number of image, each of the stated type."""
    content = _json(path)
    if not isinstance(content, dict):
        raise FileFormatError(path, "", "expected an object with an entry an image")
    for key, entry in content.items():
        if not (key.isascii() and key.isdigit() and len(key) < 10) or not isinstance(entry, kind):
            reason = f"expected the number of an image and {'an object' if kind is dict else 'a list'}"
            raise FileFormatError(path, key[:40], reason)
    return {int(key): entry for key, entry in content.items()}


def _object_id(entry: Any, folder: Path) -> int:
    number = entry.get("obj_id") if isinstance(entry, dict) else None
    if isinstance(number, bool) or not isinstance(number, int) or not 0 <= number < 10**6:
        raise FileFormatError(folder / "scene_gt.json", "obj_id", "expected the number of a model")
    return number


def _listed(entry: Mapping[str, Any], name: str, count: int, path: Path, image: int) -> list[float]:
    values = entry.get(name)
    if not isinstance(values, list):
        raise FileFormatError(path, f"{image}.{name}", f"expected a list of {count} numbers")
    return numbers([str(value) for value in values], count, path, f"{image}.{name}")


def _pose(entry: Mapping[str, Any], rotation: str, translation: str, path: Path, image: int) -> Float64:
    R = np.reshape(_listed(entry, rotation, 9, path, image), (3, 3))
    t = np.array(_listed(entry, translation, 3, path, image)) / MILLIMETRES
    return rigid(transform(R, t)[:3].ravel().tolist(), path, f"{image}.{rotation}")


# --------------------------------------------------------------------------------------------------------------- models


def _models(root: Path, used: set[int]) -> tuple[dict[str, ObjectModel], dict[int, Float64]]:
    """The models of a data set's folder by name, and where the centres of their boxes lie in their files."""
    folder = next((root / name for name in ("models_eval", "models") if (root / name).is_dir()), None)
    models, centres = {}, {}
    if folder is None:
        return models, centres
    infos = _json(folder / "models_info.json") if (folder / "models_info.json").is_file() else {}
    for number in sorted(used):
        path = folder / f"{_name(number)}.ply"
        info = infos.get(str(number), {}) if isinstance(infos, dict) else {}
        model, centre = _model(path, info if isinstance(info, dict) else {}, folder / "models_info.json", number)
        models[model.name], centres[number] = model, centre
    return models, centres


def _model(path: Path, info: Mapping[str, Any], info_path: Path, number: int) -> tuple[ObjectModel, Float64]:
    loaded = meshes.load_mesh(path)
    mesh = meshes.Mesh(loaded.vertices / MILLIMETRES, loaded.faces, loaded.face_colors)
    if not 0.0 < mesh.extents.max() <= MAX_SIZE:
        raise FileFormatError(path, "size", f"{mesh.extents.max():.3g} m; BOP models are in millimetres")
    centre = mesh.bounds.mean(axis=0)
    closed = meshes.is_closed(mesh) and meshes.volume(mesh) > 0.0
    model = build_model(
        name=_name(number),
        semantic_class="artifact",
        mesh=mesh,
        visual=meshes.decimate(mesh, MAX_VISUAL_FACES),
        collision=(),
        mass=0.1,  # not told by the format, and of no use to a tracker
        friction=0.5,
        symmetries=_symmetries(info, centre, info_path, number),
        trackable=True,
        solid=mesh if closed else meshes.convex_hull(mesh.vertices),
    )
    return model, centre


def _symmetries(info: Mapping[str, Any], centre: Float64, path: Path, number: int) -> Symmetries:
    discrete, axes = [np.eye(4)], []
    to_centre = transform(translation=centre)
    for entry in _entries(info, "symmetries_discrete", path, number):
        T = np.reshape(_listed({"matrix": entry}, "matrix", 16, path, number), (4, 4))
        T[:3, 3] /= MILLIMETRES
        discrete.append(inverse(to_centre) @ rigid(T.ravel().tolist(), path, f"{number}.symmetries") @ to_centre)
    for entry in _entries(info, "symmetries_continuous", path, number):
        if not isinstance(entry, dict):
            raise FileFormatError(path, f"{number}.symmetries_continuous", "expected objects with axis and offset")
        axis = np.array(_listed(entry, "axis", 3, path, number))
        offset = np.array(_listed(entry, "offset", 3, path, number)) / MILLIMETRES
        if not np.linalg.norm(axis) > 1e-9:
            raise FileFormatError(path, f"{number}.symmetries_continuous", "an axis needs a direction")
        axes.append(SymmetryAxis(axis / np.linalg.norm(axis), apply(inverse(to_centre), offset[None])[0]))
    return Symmetries(np.stack(discrete), tuple(axes))


def _entries(info: Mapping[str, Any], name: str, path: Path, number: int) -> list[Any]:
    entries = info.get(name, [])
    if not isinstance(entries, list) or len(entries) > 1000:
        raise FileFormatError(path, f"{number}.{name}", "expected a list of at most 1000 symmetries")
    return entries
