"""Samples of the keypoint network: stored windows shifted, turned and coloured, and what is to be said of them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from simtrack.contracts import Float32, Float64
from simtrack.geometry.transforms import transform
from simtrack.objects import ObjectModel
from simtrack.perception.detection.views import WINDOW, Window, conditions, shown_window, warped, window_about
from simtrack.simulation.oracles.detector import canonical_view
from simtrack.training.shards import BACKGROUND, PATCH

SIZE = 64
"""Pixels a side of what the network is shown."""
TURN = np.deg2rad(20.0)
"""Windows are turned by up to this, radians,"""
SHIFT = 0.08
"""shifted by up to this share of their side,"""
ZOOM = 0.15
"""and scaled by up to this (as a logarithm)."""
WITHOUT_DEPTH = 0.1
"""Share of samples without any depth."""
OTHER_CLASS = 0.12
"""Share of samples in which an object of a class is asked for that is not there."""
CELLS = 16
"""Object points are learned in this many cells a side."""


@dataclass(frozen=True, slots=True)
class Sample:
    """One window, and what is to be said of it."""

    shown: Float32
    """(5, S, S)."""
    told: Float32
    """(classes + 2,)."""
    keypoints: Float32
    """(9, 2), in shares of the window's side, 0 to 1 inside."""
    points: Float32
    """(4, 16, 16): object points in shares of the half extents, and 1 where they are known."""
    present: bool


def sample(record: Any, models: Sequence[ObjectModel], rng: np.random.Generator, *, plain: bool = False) -> Sample:
    """Show a stored window.

    Args:
        record: one of `simtrack.training.shards.CROPS`.
        models: of the classes.
        rng: of everything random.
        plain: as it is, not shifted, scaled, turned or coloured.
    """
    size = SIZE
    window = window_about(record["box"], WINDOW)
    turn = 0.0
    if not plain:
        turn = float(rng.uniform(-TURN, TURN))
        du, dv = rng.uniform(-SHIFT, SHIFT, 2) * window.side
        window = Window(window.u + du, window.v + dv, window.side * float(np.exp(rng.uniform(-ZOOM, ZOOM))))
    pixels = _turned(window, size, turn)
    patch = Window(*record["window"]).pixels_of(PATCH)
    from_patch = _compose(_inverse(patch), pixels)
    rgb = warped(record["rgb"], from_patch, size, smooth=True)
    depth = warped(record["depth"].astype(np.float32), from_patch, size, smooth=False)
    mask = warped(record["mask"], from_patch, size, smooth=False) > 0
    if not plain:
        rgb = _recoloured(rgb, rng)
    index, present = int(record["class_index"]), True
    if index == BACKGROUND or (not plain and rng.random() < OTHER_CLASS):
        others = [k for k in range(len(models)) if k != index]
        index, present = int(rng.choice(others)) if others else 0, not others and index != BACKGROUND
    model, fx = models[index], float(record["intrinsics"][0])
    hidden = not plain and rng.random() < WITHOUT_DEPTH
    shown, metric = shown_window(rgb, np.zeros_like(depth) if hidden else depth, window.side / fx)
    told = conditions(index, len(models), metric, model.diameter)
    if not present:
        empty = np.zeros((4, CELLS, CELLS), np.float32)
        return Sample(shown, told, np.zeros((9, 2), np.float32), empty, False)
    T = _canonical(record["T_camera_object"], model, turn)
    keypoints = _in_window(_projected(model.keypoints, T, record["intrinsics"]), pixels, size)
    return Sample(shown, told, keypoints, _object_points(depth, mask, pixels, T, model, record["intrinsics"]), True)


def _canonical(T_camera_object: Float64, model: ObjectModel, turn: float) -> Float64:
    """The pose, among those that look alike, that is learned where the image was turned by `turn` radians."""
    if model.symmetries.trivial:
        return T_camera_object
    c, s = np.cos(turn), np.sin(turn)
    upright = transform(np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]))
    return np.asarray(upright.T @ canonical_view(upright @ T_camera_object, model), np.float64)


def _turned(window: Window, size: int, turn: float) -> Float64:
    """(2, 3): as `Window.pixels_of`, of a window that is turned by an angle about its middle."""
    c, s = np.cos(turn), np.sin(turn)
    pixels = window.pixels_of(size)
    middle = np.array([window.u, window.v])
    R = np.array([[c, -s], [s, c]])
    return np.column_stack([R @ pixels[:, :2], R @ (pixels[:, 2] - middle) + middle])


def _compose(a: Float64, b: Float64) -> Float64:
    return np.column_stack([a[:, :2] @ b[:, :2], a[:, :2] @ b[:, 2] + a[:, 2]])


def _inverse(a: Float64) -> Float64:
    inverse = np.linalg.inv(a[:, :2])
    return np.asarray(np.column_stack([inverse, -inverse @ a[:, 2]]), np.float64)


def _projected(points: Float64, T: Float64, intrinsics: Float64) -> Float64:
    fx, fy, cx, cy = intrinsics
    p = points @ T[:3, :3].T + T[:3, 3]
    z = np.maximum(p[:, 2], 0.02)
    return np.stack([fx * p[:, 0] / z + cx, fy * p[:, 1] / z + cy], axis=1)


def _in_window(image: Float64, pixels: Float64, size: int) -> Float32:
    inverse = _inverse(pixels)
    return ((image @ inverse[:, :2].T + inverse[:, 2] + 0.5) / size).astype(np.float32)


def _object_points(
    depth: Float32, mask: np.ndarray, pixels: Float64, T: Float64, model: ObjectModel, intrinsics: Float64
) -> Float32:
    """(4, 16, 16), as `Sample.points`, from the depth readings in the cells' middles."""
    step = len(depth) // CELLS
    places = np.arange(CELLS) * step + step // 2
    i, j = np.meshgrid(places, places)
    z = depth[j, i].astype(float)
    fx, fy, cx, cy = intrinsics
    u = pixels[0, 0] * i + pixels[0, 1] * j + pixels[0, 2]
    v = pixels[1, 0] * i + pixels[1, 1] * j + pixels[1, 2]
    camera = np.stack([(u - cx) / fx * z, (v - cy) / fy * z, z], axis=-1) - T[:3, 3]
    points = camera @ T[:3, :3] / (0.5 * model.extents)
    known = mask[j, i] & (z > 0.0) & (np.abs(points) < 1.3).all(axis=-1)
    return np.concatenate([np.where(known[None], points.transpose(2, 0, 1), 0.0), known[None]]).astype(np.float32)


def _recoloured(rgb: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Other light, another white balance, coarser pixels, noise."""
    import cv2

    size = len(rgb)
    if rng.random() < 0.3:
        small = int(size * rng.uniform(0.35, 0.9))
        rgb = np.asarray(cv2.resize(cv2.resize(rgb, (small, small), interpolation=cv2.INTER_AREA), (size, size)))
    gains = np.exp(rng.normal(0.0, 0.22)) * np.exp(rng.normal(0.0, 0.06, 3))
    levels = (np.arange(256.0)[:, None] * (gains / 255.0)).clip(0.0, 1.0) ** np.exp(rng.normal(0.0, 0.15))
    table = (255.0 * levels).astype(np.uint8)
    rgb = np.asarray(cv2.LUT(rgb, np.ascontiguousarray(table[None])))
    if rng.random() < 0.4:
        noise = rng.standard_normal(rgb.shape, np.float32) * np.float32(rng.uniform(1.0, 8.0))
        rgb = (rgb + noise).clip(0.0, 255.0).astype(np.uint8)
    return rgb
