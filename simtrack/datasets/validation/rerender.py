"""Shows models at the stated poses and compares that with the images: silhouettes, depth, colour edges."""

from dataclasses import dataclass, field

import numpy as np

from simtrack.contracts import Bool, Float32, Float64, Int32
from simtrack.datasets.validation.bop_images import BopImage, Pose
from simtrack.datasets.validation.findings import Report
from simtrack.datasets.validation.masks import box, edge_free
from simtrack.datasets.validation.models import Models
from simtrack.raycast import RayBundle, RayScene, TriangleMesh
from simtrack.sensors.depth_noise import DepthNoiseConfig

REACH = 2
"""Pixels: how far images are shifted against the models to see where they fit best."""
EDGE = 3
"""Pixels from an edge of mask or depth within which depth is not compared: sensors read neighbours there."""
CREASE = 0.003
"""1/m: second difference of depth over depth squared that makes an edge."""
EXACT_DEPTH = 0.001
"""Metres: depth without noise."""
FOREIGN_DEPTH = 0.015
"""Metres: BOP's own tolerance of visibility, for the median of a depth image of which nothing else is known."""
NOISE_SIGMAS = 5.0
"""Standard deviations beyond which hardly a reading lies ..."""
NOISE_SHARE = 0.02
"""... which is no more than this share of them."""
NOISE_BIAS = 1.0
"""Standard deviations of the median."""
MIN_READINGS = 30
"""Fewer readings of an instance say nothing of their distribution."""
NEAR = 1e-3


@dataclass(slots=True, eq=False)
class Rerenderer:
    """Compares images with their models, and keeps what only many images together tell."""

    exact: bool
    """Silhouettes are the models', to the pixel; otherwise to a pixel's width."""
    noise: DepthNoiseConfig | None = None
    """Of the depth, if it is known."""
    images: int = 0
    instances: int = 0
    residuals: list[Float32] = field(default_factory=list)
    """Metres, depth less that of the model, off edges."""
    _contrast: Float64 = field(default_factory=lambda: np.zeros((2 * REACH + 1, 2 * REACH + 1)))
    _meshes: dict[int, TriangleMesh] = field(default_factory=dict)

    def check(self, report: Report, image: BopImage, models: Models) -> None:
        """Compare one image."""
        shape = image.shape
        known = [k for k, pose in enumerate(image.poses) if pose.obj_id in models.meshes]
        if shape is None or not known:
            return
        self.images += 1
        view = _View(shape, image.K)
        poses = [image.poses[k] for k in known]
        meshes = [self._mesh(models, pose) for pose in poses]
        for k, pose, mesh in zip(known, poses, meshes, strict=True):
            self.instances += 1
            self._check_silhouette(report, image, k, view.silhouette(mesh, pose))
        owner, depth, cosines = view.nearest(meshes, poses)
        for place, k in enumerate(known):
            self._check_visible(report, image, k, owner == place, depth)
            self._check_depth(report, image, k, depth, cosines)
        self._add_contrast(image)

    @property
    def colour_offset(self) -> tuple[int, int] | None:
        """(u, v) pixels by which colour edges lie off the masks' edges, over all images; None without any."""
        if not self._contrast.any():
            return None
        v, u = np.unravel_index(int(np.argmax(self._contrast)), self._contrast.shape)
        return int(u) - REACH, int(v) - REACH

    def _mesh(self, models: Models, pose: Pose) -> TriangleMesh:
        if pose.obj_id not in self._meshes:
            mesh = models.meshes[pose.obj_id]
            self._meshes[pose.obj_id] = TriangleMesh(mesh.vertices, mesh.faces, f"model {pose.obj_id}")
        return self._meshes[pose.obj_id]

    # -------------------------------------------------------------------------------------------------------- compare

    def _check_silhouette(self, report: Report, image: BopImage, k: int, shown: "_Silhouette") -> None:
        mask = image.masks[k]
        inside = shown.inside()
        tolerance = self._tolerance(inside)
        if mask is not None and mask.shape == inside.shape:
            differing = int(np.count_nonzero(mask ^ inside))
            if differing > tolerance:
                u, v = best_shift(inside, mask)
                found = f"{differing} pixels other than the model at the stated pose (it fits best shifted by {u}, {v})"
                path, place = image.about["mask"]
                report.add(path, f"{place}{k:06d}".strip(), found, f"at most {tolerance}, at offset 0, 0")
        if image.infos is None or k >= len(image.infos):
            return
        path, place = image.about["gt_info"]
        info, area = image.infos[k], int(np.count_nonzero(shown.mask))
        report.near(path, f"{place}.{k}.px_count_all", info.px_count_all, area, self._tolerance(shown.mask))
        extent = shown.box()
        if info.px_count_visib and extent is not None:
            expected = [extent[0], extent[1], extent[2] - extent[0], extent[3] - extent[1]]
            off = max(abs(a - b) for a, b in zip(info.bbox_obj, expected, strict=True))
            limit = 1 if self.exact else 3
            report.holds(off <= limit, path, f"{place}.{k}.bbox_obj", list(info.bbox_obj), expected)

    def _check_visible(self, report: Report, image: BopImage, k: int, nearest: Bool, depth: Float32) -> None:
        """Nothing is seen where the model is not, or where another one is nearer."""
        seen = image.visible[k]
        if seen is None or seen.shape != nearest.shape:
            return
        wrong, tolerance = int(np.count_nonzero(seen & ~nearest)), self._tolerance(nearest)
        path, place = image.about["mask_visib"]
        report.holds(
            wrong <= tolerance, path, f"{place}{k:06d}".strip(),
            f"{wrong} pixels where the models show nothing or another instance", f"at most {tolerance}",
        )  # fmt: skip

    def _check_depth(self, report: Report, image: BopImage, k: int, depth: Float32, cosines: Float32) -> None:
        seen, measured = image.visible[k], image.depth
        if seen is None or measured is None or seen.shape != measured.shape or measured.shape != depth.shape:
            return
        off = self.noise is not None and is_off(self.noise)
        chosen = edge_free(seen & ~creases(depth), 1 if off else EDGE) & (measured > 0) & (depth > 0)
        residuals, z, cosine = measured[chosen] - depth[chosen], depth[chosen], cosines[chosen]
        self.residuals.append(residuals)
        if len(residuals) < (1 if off else MIN_READINGS):
            return
        step = image.camera.depth_scale / 1000.0
        path, _ = image.about["depth"]
        name = f"instance {k}"
        if self.noise is None:
            middle = float(np.median(np.abs(residuals)))
            report.holds(
                middle <= FOREIGN_DEPTH, path, name, f"depth {1e3 * middle:.1f} mm off the model (median)",
                f"at most {1e3 * FOREIGN_DEPTH:g} mm",
            )  # fmt: skip
        elif off:
            largest = float(np.abs(residuals).max())
            report.holds(
                largest <= EXACT_DEPTH, path, name, f"depth up to {1e3 * largest:.2f} mm off the model",
                f"at most {1e3 * EXACT_DEPTH:g} mm without noise",
            )  # fmt: skip
        else:
            sigma = self.noise.sigma(z, np.arccos(np.clip(cosine, 0.0, 1.0))) + step
            bias, beyond = float(np.median(residuals / sigma)), float(np.mean(np.abs(residuals) > NOISE_SIGMAS * sigma))
            report.holds(
                abs(bias) <= NOISE_BIAS and beyond <= NOISE_SHARE, path, name,
                f"median {bias:.2f} standard deviations off the model, {100 * beyond:.1f} % beyond {NOISE_SIGMAS:g}",
                f"the recipe's noise: median within {NOISE_BIAS:g}, at most {100 * NOISE_SHARE:g} % beyond",
            )  # fmt: skip

    def _add_contrast(self, image: BopImage) -> None:
        """How strongly colours change across the masks' edges, when the masks are shifted."""
        masks = [mask for mask in image.visible if mask is not None]
        if image.rgb is None or not masks or masks[0].shape != image.rgb.shape[:2]:
            return
        colours = image.rgb.astype(np.float32)
        for axis in (0, 1):
            change = np.abs(np.diff(colours, axis=axis)).sum(axis=2)
            edges = np.any([np.diff(mask.astype(np.int8), axis=axis) != 0 for mask in masks], axis=0)
            edges[:REACH] = edges[-REACH:] = edges[:, :REACH] = edges[:, -REACH:] = False
            places = np.argwhere(edges)
            for v in range(-REACH, REACH + 1):
                for u in range(-REACH, REACH + 1):
                    self._contrast[v + REACH, u + REACH] += float(change[places[:, 0] + v, places[:, 1] + u].sum())

    def _tolerance(self, mask: Bool) -> int:
        """Pixels that may differ: those whose centres an edge meets, to rounding, or half of all at the edge."""
        outline = int(np.count_nonzero(mask & ~edge_free(mask, 1)))
        return max(3, outline // 50) if self.exact else max(10, outline)


def is_off(noise: DepthNoiseConfig) -> bool:
    """Whether readings are exact where there are any."""
    return float(noise.sigma(1.0)) == 0.0 and noise.lateral == "none" and noise.disparity_step == 0.0


def creases(depth: Float32) -> Bool:
    """(H, W), where an (H, W) depth image bends or steps."""
    out = np.zeros(depth.shape, np.bool_)
    bent = np.abs(depth[:, 2:] - 2 * depth[:, 1:-1] + depth[:, :-2])
    out[:, 1:-1] = bent > CREASE * depth[:, 1:-1] ** 2
    bent = np.abs(depth[2:] - 2 * depth[1:-1] + depth[:-2])
    out[1:-1] |= bent > CREASE * depth[1:-1] ** 2
    return out


def best_shift(model: Bool, mask: Bool) -> tuple[int, int]:
    """(u, v) pixels by which the model has to be shifted to fit the mask best, the smallest if several do."""
    shifts = [(u, v) for v in range(-REACH, REACH + 1) for u in range(-REACH, REACH + 1)]
    return min(
        sorted(shifts, key=lambda shift: abs(shift[0]) + abs(shift[1])),
        key=lambda shift: np.count_nonzero(np.roll(model, (shift[1], shift[0]), axis=(0, 1)) ^ mask),
    )


# ---------------------------------------------------------------------------------------------------------- ray casting


@dataclass(frozen=True, slots=True, eq=False)
class _Silhouette:
    """What a model shows on a canvas of three times the image's size around it."""

    mask: Bool
    """(h, w), a window of the canvas."""
    at: tuple[int, int]
    """(u, v) of the window's first pixel in the image's coordinates."""
    shape: tuple[int, int]
    """(H, W) of the image."""

    def inside(self) -> Bool:
        """(H, W), the part inside the image."""
        height, width = self.shape
        out = np.zeros(self.shape, np.bool_)
        (u, v), (h, w) = self.at, self.mask.shape
        u0, v0, u1, v1 = max(u, 0), max(v, 0), min(u + w, width), min(v + h, height)
        if u0 < u1 and v0 < v1:
            out[v0:v1, u0:u1] = self.mask[v0 - v : v1 - v, u0 - u : u1 - u]
        return out

    def box(self) -> tuple[int, int, int, int] | None:
        """(u0, v0, u1, v1), first and last pixel."""
        found = box(self.mask)
        if found is None:
            return None
        (u, v), (u0, v0, u1, v1) = self.at, found
        return u0 + u, v0 + v, u1 + u, v1 + v


@dataclass(frozen=True, slots=True, eq=False)
class _View:
    """A camera at the origin of the camera frame."""

    shape: tuple[int, int]
    K: Float64

    def silhouette(self, mesh: TriangleMesh, pose: Pose) -> _Silhouette:
        """What a model shows if nothing else is there."""
        u0, v0, u1, v1 = self._window(mesh, pose.T_camera_object)
        if u0 > u1 or v0 > v1:
            return _Silhouette(np.zeros((0, 0), np.bool_), (u0, v0), self.shape)
        with RayScene() as scene:
            scene.add(mesh, pose.T_camera_object)
            hits = scene.cast(RayBundle.from_directions(self._rays(u0, v0, u1, v1)), np.eye(4), min_distance=NEAR)
        return _Silhouette(hits.hit.reshape(v1 - v0 + 1, u1 - u0 + 1), (u0, v0), self.shape)

    def nearest(self, meshes: list[TriangleMesh], poses: list[Pose]) -> tuple[Int32, Float32, Float32]:
        """(H, W) each: place of the nearest model in the lists (-1 none), its depth in metres, cosine of incidence."""
        height, width = self.shape
        rays = self._rays(0, 0, width - 1, height - 1)
        with RayScene() as scene:
            for k, (mesh, pose) in enumerate(zip(meshes, poses, strict=True)):
                scene.add(mesh, pose.T_camera_object, instance=k)
            hits = scene.cast(RayBundle.from_directions(rays), np.eye(4), min_distance=NEAR)
        directions = rays / np.linalg.norm(rays, axis=1, keepdims=True)
        cosines = np.abs(np.einsum("ij,ij->i", directions, hits.normals))
        depth = np.where(hits.hit, hits.distances, 0.0).astype(np.float32)
        return hits.instances.reshape(self.shape), depth.reshape(self.shape), cosines.reshape(self.shape)

    def _rays(self, u0: int, v0: int, u1: int, v1: int) -> Float32:
        """(N, 3) directions with z = 1 through pixel centres, row by row."""
        u, v = np.meshgrid(np.arange(u0, u1 + 1), np.arange(v0, v1 + 1))
        pixels = np.stack([u.ravel(), v.ravel(), np.ones(u.size)])
        return np.ascontiguousarray((np.linalg.inv(self.K) @ pixels).T, np.float32)

    def _window(self, mesh: TriangleMesh, T_camera_object: Float64) -> tuple[int, int, int, int]:
        """First and last pixel of the canvas that the model can be met at."""
        height, width = self.shape
        canvas = (-width, -height, 2 * width - 1, 2 * height - 1)
        points = mesh.vertices @ T_camera_object[:3, :3].T + T_camera_object[:3, 3]
        if points[:, 2].max() <= NEAR:
            return 0, 0, -1, -1
        if points[:, 2].min() <= NEAR:
            return canvas
        pixels = points @ self.K.T
        pixels = pixels[:, :2] / pixels[:, 2:]
        low, high = np.floor(pixels.min(0)) - 1, np.ceil(pixels.max(0)) + 1
        low, high = np.maximum(low, canvas[:2]), np.minimum(high, canvas[2:])
        return int(low[0]), int(low[1]), int(high[0]), int(high[1])
