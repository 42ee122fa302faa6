"""How the keypoint network learns: samples, loss, and what is told of it on held-out scenes."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from simtrack.contracts import Float32, Float64
from simtrack.geometry.transforms import transform
from simtrack.objects import ObjectModel
from simtrack.perception.detection.bins import BINS, decoded, position_of
from simtrack.perception.detection.views import WINDOW, Window, conditions, shown_window, warped, window_about
from simtrack.simulation.oracles.detector import canonical_view
from simtrack.training.networks import KeypointNetwork
from simtrack.training.shards import BACKGROUND, PATCH, Shards

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
SOFTNESS = 1.3
"""Standard deviation of the labels' distributions, bins."""
POINT_WEIGHT, PRESENT_WEIGHT = 2.0, 0.3


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


class KeypointTask:
    """Training of `KeypointNetwork`; see `simtrack.training.loop.Task`."""

    name = "keypoints"
    batch_size = 48
    learning_rate = 1.5e-3

    def __init__(self, models: tuple[ObjectModel, ...], train: Shards, held_out: Shards, validated: int = 600) -> None:
        self.models, self._train, self._held_out = models, train, held_out
        classes = held_out.column("class_index")
        clear = np.flatnonzero((classes != BACKGROUND) & (held_out.column("visible") > 0.5))
        self._validated = clear[:: max(1, len(clear) // validated)]
        counts = np.bincount(train.column("class_index")[train.column("class_index") >= 0], minlength=len(models))
        self.missing = tuple(models[i].name for i in np.flatnonzero(counts == 0))

    def network(self) -> KeypointNetwork:
        """A new one."""
        return KeypointNetwork(len(self.models), BINS)

    def batch(self, rng: np.random.Generator) -> tuple[Tensor, ...]:
        """Random samples."""
        picks = rng.integers(0, len(self._train), self.batch_size)
        return self._tensors([self.sample(self._train[int(i)], rng) for i in picks])

    def loss(self, network: KeypointNetwork, batch: tuple[Tensor, ...]) -> Tensor:
        """Cross entropy of the coordinates, L1 of the object points, and of what is there at all."""
        shown, told, keypoints, points, present = batch
        logits, there, answered = network.taught(shown, told)
        place = position_of(keypoints)
        bins = torch.arange(BINS)
        target = torch.exp(-0.5 * ((bins - place[..., None]) / SOFTNESS) ** 2)
        inside = (place > -0.5) & (place < BINS - 0.5) & (present[:, None, None] > 0)
        target = target / target.sum(-1, keepdim=True).clamp(min=1e-6)
        entropy = -(target * functional.log_softmax(logits, -1)).sum(-1)
        loss = (entropy * inside).sum() / inside.sum().clamp(min=1)
        known = points[:, 3:]
        loss = loss + POINT_WEIGHT * (
            functional.smooth_l1_loss(answered[:, :3], points[:, :3], reduction="none", beta=0.1) * known
        ).sum() / known.sum().clamp(min=1)
        mask = functional.binary_cross_entropy_with_logits(answered[:, 3:], known)
        return loss + 0.3 * mask + PRESENT_WEIGHT * functional.binary_cross_entropy_with_logits(there, present)

    def validate(self, network: KeypointNetwork) -> dict[str, float]:
        """Median keypoint error as a share of the object's projected size, and shares of windows rightly believed."""
        rng = np.random.default_rng(0)
        errors: list[float] = []
        believed: list[bool] = []
        for first in range(0, len(self._validated), 64):
            records = [self._held_out[int(i)] for i in self._validated[first : first + 64]]
            samples = [self.sample(record, rng, plain=True) for record in records]
            shown, told, *_ = self._tensors(samples)
            logits, there = network(shown, told)
            places, _ = decoded(logits.numpy())
            believed += (there > 0).tolist()
            for record, sample, place in zip(records, samples, places, strict=True):
                error = np.linalg.norm(place - sample.keypoints, axis=1) * window_about(record["box"], WINDOW).side
                size = record["intrinsics"][0] * self.models[record["class_index"]].diameter
                errors += (error / (size / record["T_camera_object"][2, 3])).tolist()
        spread = np.percentile(errors, [50, 75, 90])
        return {"median error, % of size": 100 * spread[0], "p75": 100 * spread[1], "p90": 100 * spread[2],
                "believed": float(np.mean(believed))}  # fmt: skip

    def sample(self, record: Any, rng: np.random.Generator, *, plain: bool = False) -> Sample:
        """Show a stored window; `plain`: as it is, not shifted, turned or coloured."""
        size = KeypointNetwork.size
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
            others = [k for k in range(len(self.models)) if k != index]
            index, present = int(rng.choice(others)) if others else 0, not others and index != BACKGROUND
        model, fx = self.models[index], float(record["intrinsics"][0])
        hidden = not plain and rng.random() < WITHOUT_DEPTH
        shown, metric = shown_window(rgb, np.zeros_like(depth) if hidden else depth, window.side / fx)
        told = conditions(index, len(self.models), metric, model.diameter)
        if not present:
            empty = np.zeros((4, CELLS, CELLS), np.float32)
            return Sample(shown, told, np.zeros((9, 2), np.float32), empty, False)
        T = _canonical(record["T_camera_object"], model, turn)
        keypoints = _in_window(_projected(model.keypoints, T, record["intrinsics"]), pixels, size)
        return Sample(shown, told, keypoints, _object_points(depth, mask, pixels, T, model, record["intrinsics"]), True)

    @staticmethod
    def _tensors(samples: list[Sample]) -> tuple[Tensor, ...]:
        columns = [np.stack([getattr(s, name) for s in samples]) for name in ("shown", "told", "keypoints", "points")]
        present = np.array([s.present for s in samples], np.float32)
        shown, *rest = [torch.from_numpy(np.ascontiguousarray(column, np.float32)) for column in columns]
        return shown.contiguous(memory_format=torch.channels_last), *rest, torch.from_numpy(present)


def _canonical(T_camera_object: Float64, model: ObjectModel, turn: float) -> Float64:
    """The pose, among those that look alike, that is learned where the image was turned by `turn` radians."""
    if model.symmetries.trivial:
        return T_camera_object
    c, s = np.cos(turn), np.sin(turn)
    upright = transform(np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]))
    return upright.T @ canonical_view(upright @ T_camera_object, model)


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
    return np.column_stack([inverse, -inverse @ a[:, 2]])


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
