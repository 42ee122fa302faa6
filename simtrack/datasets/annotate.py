"""Labels of one view of a scene, all from the true meshes at pixel centres: exact, and consistent with one another.

The ids of an image come from one cast of rays, so visible masks are disjoint by construction. An amodal mask is what
the same rays would meet of the instance alone; which they are, the projections of its faces tell faster than rays do.
What is seen is part of the silhouette, whatever rounding does at edges.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from simtrack.contracts import CameraIntrinsics, Float32, Float64, Int32
from simtrack.datasets.content import Placed
from simtrack.datasets.frame import InstanceLabel
from simtrack.errors import InvalidValueError
from simtrack.geometry.transforms import inverse
from simtrack.raycast import RayBundle, RayHits, RayScene

NEAR = 0.03
"""Metres along the optical axis; nearer surfaces are not in the image (that of MuJoCo's renderer here too)."""
ON_SURFACE = 0.002
"""Metres: a keypoint that lies less than this behind another thing's surface lies on it, as corners on a table do."""
BEHIND_SURFACE = 0.05
"""Metres along the ray: how far behind a surface, however flat the view on it, a keypoint can be said to lie on it."""
_STEP = 1e-4
"""Metres by which a ray passes on through the keypoint's own object."""


class Owners:
    """Which id in images the instances of a ray scene have, whole or face by face."""

    def __init__(self, whole: Mapping[int, int], by_face: Mapping[int, Int32] | None = None) -> None:
        """Build the table.

        Args:
            whole: ray instance -> id, of things that have one.
            by_face: ray instance -> (F,) id of every face, of meshes made of several things, such as a building.
        """
        parts = dict(by_face or {})
        count = max([-1, *whole, *parts]) + 1
        self.first = np.zeros(count, np.int64)
        """(R,), by ray instance, where its ids begin in `ids`."""
        self.by_face = np.zeros(count, np.bool_)
        """(R,), whether it has one for each face."""
        chunks: list[Int32] = [np.full(1, -1, np.int32)]  # the id of what has none
        length = 1
        for number in (*whole, *parts):
            chunk = np.atleast_1d(np.asarray(parts.get(number, whole.get(number)), np.int32))
            self.first[number], self.by_face[number] = length, number in parts
            chunks.append(chunk)
            length += len(chunk)
        self.ids = np.concatenate(chunks)
        """(K,), all ids, one after the other."""

    def of(self, hits: RayHits) -> Int32:
        """(N,) id of what each ray met, -1 = nothing."""
        hit = hits.hit
        instances = np.where(hit, hits.instances, 0)
        where = self.first[instances] + np.where(self.by_face[instances], hits.faces, 0)
        return np.where(hit, self.ids[np.where(hit, where, 0)], -1).astype(np.int32)


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """What a camera sees of a ray scene."""

    ids: Int32
    """(H, W), id of the nearest thing by `Owners`, -1 = nothing."""
    depth: Float32
    """(H, W), metres along the optical axis, 0 = nothing within range."""
    normals: Float32
    """(H, W, 3), unit, camera frame, towards the camera; 0 where nothing is."""
    hits: RayHits
    """Of the rays, row by row; overwritten by the next `Annotator.look`."""


class Annotator:
    """Labels views of scenes for one camera."""

    def __init__(self, intrinsics: CameraIntrinsics, far: float = np.inf) -> None:
        """Create an annotator.

        Args:
            intrinsics: of the camera.
            far: metres along the optical axis beyond which clean depth shows nothing (ids and masks do).
        """
        self._intrinsics, self._far = intrinsics, float(far)
        self._camera = (intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy)
        self._bundle: RayBundle | None = None
        self._hits: RayHits | None = None

    def look(self, rays: RayScene, owners: Owners, T_map_camera: Float64) -> View:
        """Ids, depth and normals of a view (4, 4), exact to float32 at every pixel centre."""
        from simtrack.datasets import label_kernels as kernels

        if self._bundle is None:
            self._bundle = RayBundle.from_camera(self._intrinsics)
        self._hits = hits = rays.cast(self._bundle, T_map_camera, min_distance=NEAR, out=self._hits)
        height, width = self._intrinsics.height, self._intrinsics.width
        out = (
            np.empty((height, width), np.int32),
            np.empty((height, width), np.float32),
            np.empty((height, width, 3), np.float32),
        )
        fields = hits.distances, hits.normals, hits.faces, hits.instances
        table = owners.first, owners.by_face, owners.ids
        R_camera_map = np.ascontiguousarray(np.asarray(T_map_camera)[:3, :3].T)
        kernels.to_images(*fields, *table, R_camera_map, self._camera, np.float32(self._far), out)
        return View(*out, hits)

    def annotate(
        self, things: Sequence[Placed], rays: RayScene, T_map_camera: Float64, ids: Int32, depth: Float32
    ) -> tuple[InstanceLabel, ...]:
        """Labels of all things, by ascending instance.

        Args:
            things: where they stand.
            rays: the scene, in which they stand there.
            T_map_camera: (4, 4).
            ids: (H, W), the image's, from `look`.
            depth: (H, W), metres, as it is written: with the sensor's errors, 0 = no reading.

        Raises:
            InvalidValueError: an image of another size than the camera's.
        """
        from simtrack.datasets import label_kernels as kernels

        shape = (self._intrinsics.height, self._intrinsics.width)
        for name, image in (("ids", ids), ("depth", depth)):
            if image.shape != shape:
                raise InvalidValueError(name, image.shape, f"shape {shape}, as the intrinsics say")
        things = sorted(things, key=lambda thing: thing.instance)
        pixels, boxes = kernels.visible_parts(ids, max((thing.instance for thing in things), default=-1) + 1)
        T_camera_map = inverse(np.asarray(T_map_camera, float))
        points = self._keypoints(things, rays, np.asarray(T_map_camera, float))
        labels: list[InstanceLabel] = []
        for thing, (keypoints, visibility) in zip(things, points, strict=True):
            seen = tuple(boxes[thing.instance].tolist())
            mask = np.zeros(shape, np.bool_)
            surface = thing.mesh.vertices, thing.mesh.faces, thing.mesh.topology.closed
            pose = T_camera_map @ thing.T_map_mesh
            total, valid, box = kernels.silhouette(
                *surface, pose, self._camera, NEAR, seen, ids, thing.instance, depth, mask
            )
            labels.append(
                InstanceLabel(
                    instance=thing.instance,
                    name=thing.name,
                    semantic_class=thing.semantic_class,
                    category=thing.category,
                    T_map_object=np.array(thing.T_map_object, float),
                    T_camera_object=T_camera_map @ thing.T_map_object,
                    extents=np.array(thing.extents, float),
                    amodal=mask,
                    pixels_all=total,
                    pixels_valid=valid,
                    pixels_visible=int(pixels[thing.instance]),
                    box_amodal=box if total else None,
                    box_visible=seen if pixels[thing.instance] else None,
                    keypoints=keypoints,
                    keypoint_visibility=visibility,
                )
            )
        return tuple(labels)

    # -------------------------------------------------------------------------------------------------------- keypoints

    def _keypoints(
        self, things: Sequence[Placed], rays: RayScene, T_map_camera: Float64
    ) -> list[tuple[Float64, Int32]]:
        """Pixels (K, 2) and visibility (K,) of the keypoints of each thing."""
        counts = [len(thing.keypoints) for thing in things]
        ends = np.cumsum(counts)[:-1]
        points = [thing.keypoints @ thing.T_map_object[:3, :3].T + thing.T_map_object[:3, 3] for thing in things]
        in_map = np.concatenate(points) if points else np.empty((0, 3))
        camera = self._intrinsics
        local = (in_map - T_map_camera[:3, 3]) @ T_map_camera[:3, :3]
        ahead = local[:, 2] > NEAR
        z = np.where(ahead, local[:, 2], 1.0)
        u, v = camera.fx * local[:, 0] / z + camera.cx, camera.fy * local[:, 1] / z + camera.cy
        pixels = np.where(ahead[:, None], np.stack([u, v], axis=1), -1.0)
        inside = ahead & (u >= -0.5) & (u < camera.width - 0.5) & (v >= -0.5) & (v < camera.height - 0.5)
        visibility = inside.astype(np.int32)
        owners = np.repeat([thing.ray_instance for thing in things], counts)
        at = np.flatnonzero(inside)
        if len(at):
            visibility[at] += _in_sight(rays, T_map_camera[:3, 3], in_map[at], NEAR / z[at], owners[at])
        return list(zip(np.split(pixels, ends), np.split(visibility, ends), strict=True)) if counts else []


def _in_sight(rays: RayScene, eye: Float64, points: Float64, start: Float64, owners: np.ndarray) -> np.ndarray:
    """(N,), whether nothing but its own object lies between the eye and each point.

    Rays start at the share `start` (N,) of the way and pass through their own instance in `owners` (N,).
    """
    ways = points - eye
    lengths = np.linalg.norm(ways, axis=1)
    share = start.copy()
    clear = np.ones(len(points), np.bool_)
    active = np.arange(len(points))
    while len(active):
        way = ways[active]
        hits = rays.cast_rays(eye + share[active, None] * way, way)
        met = share[active] + hits.distances
        own = hits.instances == owners[active]
        short = np.where(hits.hit, (1.0 - met) * lengths[active], 0.0)
        cosine = np.abs(np.einsum("ij,ij->i", hits.normals, way)) / lengths[active]
        blocked = ~own & (short > 0.0) & ((short * cosine > ON_SURFACE) | (short > BEHIND_SURFACE))
        clear[active[blocked]] = False
        onward = own & (short > 0.0)
        share[active[onward]] = met[onward] + _STEP / lengths[active[onward]]
        active = active[onward]
    return clear
