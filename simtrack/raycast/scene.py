"""A scene of mesh instances: cast rays at it, ask what is occluded and what lies nearest."""

import weakref
from collections.abc import Sequence
from dataclasses import dataclass, field
from threading import RLock
from types import TracebackType

import numpy as np
import numpy.typing as npt

from simtrack.contracts import Bool, Float32, Float64, Int32
from simtrack.errors import InvalidValueError, RaycastError
from simtrack.raycast import embree as rtc
from simtrack.raycast import fallback, instancing, kernels
from simtrack.raycast.bundle import RayBundle
from simtrack.raycast.hits import ClosestPoints, RayHits
from simtrack.raycast.mesh import TriangleMesh

MAX_INSTANCE = 1 << 21
"""Instance ids are below this: tables are indexed by them."""


@dataclass(slots=True, eq=False)
class Instance:
    """A mesh in the scene."""

    mesh: TriangleMesh
    keys: Float64
    """(K, 4, 4), T_map_mesh at equidistant times 0..1; K = 1 at rest."""
    enabled: bool = True
    geometry: int = field(default=0)
    """Address of the RTCGeometry, 0 in the fallback."""


class RayScene:
    """Instances of triangle meshes under one hierarchy.

    Moving an instance costs microseconds plus `commit`; meshes are shared, never copied. Casting is thread-safe and
    releases the interpreter lock; changing the scene while another thread casts is not allowed (changes are serialised
    among themselves). The threads used are ``numba.get_num_threads()``; results do not depend on their number.
    """

    def __init__(self, use_fallback: bool | None = None) -> None:
        """Create an empty scene.

        Args:
            use_fallback: True casts with `embreex`'s single rays (same results, slower); None does
                so where the library cannot be reached or the environment sets ``SIMTRACK_RAYCAST=fallback``.

        Raises:
            RaycastError: `use_fallback` is False and the library cannot be used.
        """
        self.fallback = (rtc.fallback_forced() or not rtc.available()) if use_fallback is None else use_fallback
        self._instances: dict[int, Instance] = {}
        self._lock = RLock()
        self._dirty = True
        self._top = 0
        self._closed = False
        self._keeper = instancing.TableKeeper()
        self._table = self._keeper.update(self._instances)
        if not self.fallback:
            api = rtc.embree().api
            self._top = api.rtcNewScene(rtc.embree().device)
            api.rtcSetSceneFlags(self._top, rtc.RTC_SCENE_FLAG_DYNAMIC)
            rtc.embree().check("rtcNewScene")
            self._release = weakref.finalize(self, api.rtcReleaseScene, self._top)

    # ------------------------------------------------------------------------------------------------ what is in it

    @property
    def instances(self) -> tuple[int, ...]:
        """Ids of all instances, ascending."""
        return tuple(sorted(self._instances))

    def mesh(self, instance: int) -> TriangleMesh:
        """The mesh of an instance."""
        return self._get(instance).mesh

    def pose(self, instance: int) -> Float64:
        """(4, 4) T_map_mesh of an instance (of its first motion key)."""
        return self._get(instance).keys[0].copy()

    def add(self, mesh: TriangleMesh, T_map_mesh: npt.ArrayLike | None = None, instance: int | None = None) -> int:
        """Place an instance of `mesh`.

        Args:
            mesh: the mesh, shared.
            T_map_mesh: (4, 4) affine transform, identity if None; may scale, shear and mirror, not collapse.
            instance: the id that results carry; the smallest free one if None. Ids outlive the removal of others.

        Returns:
            The id.

        Raises:
            InvalidValueError: the id is taken or out of range, or the transform is not an invertible affine one.
        """
        with self._lock:
            if instance is None:
                instance = next(i for i in range(MAX_INSTANCE + 1) if i not in self._instances)
            self.add_many([mesh], np.eye(4)[None] if T_map_mesh is None else T_map_mesh, [instance])
        return instance

    def add_many(self, meshes: Sequence[TriangleMesh], T_map_mesh: npt.ArrayLike, instances: Sequence[int]) -> None:
        """Place several instances at once, see `add`; `T_map_mesh` (N, 4, 4). If one is refused, none is placed."""
        if not len(instances):
            return
        keys = _checked_transforms(T_map_mesh, "T_map_mesh")
        if not len(meshes) == len(keys) == len(instances):
            shape = len(meshes), keys.shape, len(instances)
            raise InvalidValueError("meshes, T_map_mesh, instances", shape, "as many of each")
        with self._lock:
            self._open()
            new = set(instances)
            for number in instances:
                if number in self._instances or not 0 <= number < MAX_INSTANCE or len(new) < len(instances):
                    allowed = f"0..{MAX_INSTANCE - 1}, each once, and not one of {self.instances}"
                    raise InvalidValueError("instance", number, allowed)
            entries = [Instance(mesh, keys[k : k + 1]) for k, mesh in enumerate(meshes)]
            if not self.fallback:
                scenes = np.array([mesh.scene_handle for mesh in meshes], np.int64)
                numbers, geometries = np.array(instances, np.int64), np.zeros(len(entries), np.int64)
                arguments = scenes, numbers, instancing.columns(keys), geometries
                instancing.place(rtc.embree().device, self._top, *arguments)
                rtc.embree().check("rtcAttachGeometryByID")
                for entry, geometry in zip(entries, geometries.tolist(), strict=True):
                    entry.geometry = geometry
            self._instances.update(zip(instances, entries, strict=True))
            self._keeper.changed(instances)
            self._dirty = True

    def remove(self, instance: int) -> None:
        """Take an instance out; its id becomes free, the others keep theirs."""
        self.remove_many([instance])

    def remove_many(self, instances: Sequence[int]) -> None:
        """Take several instances out at once, see `remove`."""
        chosen = list(dict.fromkeys(instances))
        with self._lock:
            for instance in chosen:
                self._get(instance)
            if not self.fallback:
                instancing.detach(self._top, np.array(chosen, np.int64))
                rtc.embree().check("rtcDetachGeometry")
            for instance in chosen:
                del self._instances[instance]
            self._dirty = True

    def set_pose(self, instance: int, T_map_mesh: npt.ArrayLike) -> None:
        """Move an instance to the (4, 4) affine transform `T_map_mesh` and end any motion of it."""
        self._set_keys(instance, _checked_transforms(T_map_mesh, "T_map_mesh"))

    def set_poses(self, instances: Sequence[int], T_map_mesh: npt.ArrayLike) -> None:
        """Move several instances at once, see `set_pose`; `T_map_mesh` (N, 4, 4)."""
        if not len(instances):
            return
        keys = _checked_transforms(T_map_mesh, "T_map_mesh")
        if len(keys) != len(instances):
            raise InvalidValueError("T_map_mesh", keys.shape, f"({len(instances)}, 4, 4)")
        with self._lock:
            entries = [self._get(instance) for instance in instances]
            for k, entry in enumerate(entries):
                entry.keys = keys[k : k + 1]
            if not self.fallback:
                geometries = np.array([entry.geometry for entry in entries], np.int64)
                instancing.move(geometries, instancing.columns(keys))
                rtc.embree().check("rtcSetGeometryTransform")
            self._keeper.changed(instances)
            self._dirty = True

    def set_motion(self, instance: int, T_keys: npt.ArrayLike) -> None:
        """Let an instance move during ray time 0..1.

        Args:
            instance: its id.
            T_keys: (K, 4, 4) T_map_mesh at K = 1..129 equidistant times from 0 to 1; between them the matrices are
                interpolated linearly, element by element (so keys of a rotating body must be close to one another).
        """
        keys = _checked_transforms(T_keys, "T_keys")
        if not 1 <= len(keys) <= rtc.RTC_MAX_TIME_STEP_COUNT:
            raise InvalidValueError("T_keys", keys.shape, f"1..{rtc.RTC_MAX_TIME_STEP_COUNT} keys")
        self._set_keys(instance, keys)

    def set_enabled(self, instance: int, enabled: bool) -> None:
        """Show an instance to rays and queries, or hide it."""
        with self._lock:
            entry = self._get(instance)
            if entry.enabled == enabled:
                return
            entry.enabled = enabled
            if entry.geometry:
                api = rtc.embree().api
                (api.rtcEnableGeometry if enabled else api.rtcDisableGeometry)(entry.geometry)
                api.rtcCommitGeometry(entry.geometry)
            self._dirty = True

    def commit(self) -> None:
        """Make changes effective; casting does it by itself where needed.

        Raises:
            RaycastError: Embree could not build the scene.
        """
        with self._lock:
            self._open()
            if not self._dirty:
                return
            if not self.fallback:
                rtc.embree().api.rtcCommitScene(self._top)
                rtc.embree().check("rtcCommitScene")
                self._table = self._keeper.update(self._instances)
            self._dirty = False

    # ------------------------------------------------------------------------------------------------------ queries

    def cast(
        self,
        bundle: RayBundle,
        T_map_sensor: npt.ArrayLike,
        max_distance: float = np.inf,
        *,
        min_distance: float = 0.0,
        time: float = 0.0,
        coherent: bool = True,
        out: RayHits | None = None,
    ) -> RayHits:
        """Cast a bundle from one sensor pose.

        Args:
            bundle: the rays.
            T_map_sensor: (4, 4).
            max_distance: farthest hit, in multiples of the directions' length.
            min_distance: nearest hit, likewise.
            time: of moving instances, 0..1.
            coherent: whether neighbouring rays meet the same few triangles, as a whole image's do; False is faster
                for rays some pixels apart on finely meshed things. The results are the same.
            out: results to overwrite and return (from `RayHits.empty`); saves the allocation.
        """
        T = _checked_transforms(T_map_sensor, "T_map_sensor")[0]
        self.commit()
        hits = RayHits.reuse(out, len(bundle))
        rotation, origin = T[:3, :3].astype(np.float32), T[:3, 3].astype(np.float32)
        limits = np.float32(min_distance), np.float32(max_distance)
        if self.fallback:
            rays = bundle.directions @ rotation.T
            times = np.full(len(bundle), time)
            fallback.cast(self._instances, np.broadcast_to(origin, rays.shape), rays, times, *limits, hits)
        elif len(bundle):
            rays = kernels.Bundle(bundle.packed, bundle.order, rotation, origin, np.float32(time), coherent)
            lanes = (0,) * bundle.packed.shape[2]
            output = kernels.Output(hits.distances, hits.normals, hits.faces, hits.instances)
            arguments = (lanes, self._top, rays, *limits, self._table, output)
            kernels.run(len(bundle), kernels.cast_bundle, kernels.cast_bundle_parallel, *arguments)
        return hits

    def cast_rays(
        self,
        origins: npt.ArrayLike,
        directions: npt.ArrayLike,
        times: npt.ArrayLike | None = None,
        max_distance: float = np.inf,
        *,
        min_distance: float = 0.0,
        packing: RayBundle | None = None,
        out: RayHits | None = None,
    ) -> RayHits:
        """Cast rays that each have their own origin and time.

        Args:
            origins: (N, 3), map frame, metres.
            directions: (N, 3), map frame, any length. A ray that is not finite or has no direction misses.
            times: (N,), 0..1, for moving instances; 0 if None.
            max_distance: farthest hit, in multiples of the direction's length.
            min_distance: nearest hit, likewise.
            packing: a bundle of N rays whose packet order is used, e.g. a lidar's ring by ring: faster than the
                caller's order where that puts neighbours far apart.
            out: results to overwrite and return.
        """
        rays = _checked_rays(origins, directions, times, packing)
        self.commit()
        hits = RayHits.reuse(out, len(rays[0]))
        limits = np.float32(min_distance), np.float32(max_distance)
        if self.fallback:
            fallback.cast(self._instances, *rays[:3], *limits, hits)
        elif len(rays[0]):
            lanes = (0,) * rtc.embree().packet_width
            output = kernels.Output(hits.distances, hits.normals, hits.faces, hits.instances)
            arguments = (lanes, self._top, kernels.Rays(*rays), *limits, packing is not None, self._table, output)
            kernels.run(len(rays[0]), kernels.cast_rays, kernels.cast_rays_parallel, *arguments)
        return hits

    def occluded(
        self,
        origins: npt.ArrayLike,
        directions: npt.ArrayLike,
        distances: npt.ArrayLike,
        times: npt.ArrayLike | None = None,
        *,
        min_distance: float = 0.0,
    ) -> Bool:
        """(N,), whether anything lies on the ray between `min_distance` and its (N,) distance (see `cast_rays`)."""
        rays = _checked_rays(origins, directions, times, None)
        limit = np.ascontiguousarray(np.broadcast_to(np.asarray(distances, np.float32), (len(rays[0]),)))
        self.commit()
        if self.fallback:
            hits = RayHits.empty(len(limit))
            fallback.cast(self._instances, *rays[:3], np.float32(min_distance), np.float32(np.inf), hits)
            return hits.distances < limit
        blocked = np.zeros(len(limit), np.bool_)
        if len(limit):
            lanes = (0,) * rtc.embree().packet_width
            kernels.occluded(lanes, self._top, kernels.Rays(*rays), np.float32(min_distance), limit, blocked)
        return blocked

    def closest_points(self, points: npt.ArrayLike, max_distance: float = np.inf) -> ClosestPoints:
        """Nearest surface points of the enabled instances; moving ones stand at their first key.

        Args:
            points: (N, 3), map frame, metres; one that is not finite finds nothing.
            max_distance: metres; what is farther counts as nothing.

        Raises:
            InvalidValueError: wrong shape, or a negative distance.
        """
        queries = np.ascontiguousarray(points, np.float32)
        if queries.ndim != 2 or queries.shape[1] != 3:
            raise InvalidValueError("points", queries.shape, "(N, 3)")
        if not max_distance >= 0:
            raise InvalidValueError("max_distance", max_distance, ">= 0")
        self.commit()
        count = len(queries)
        found = ClosestPoints.empty(count)
        if self.fallback:
            fallback.closest(self._instances, queries, max_distance, found)
        elif count:
            from simtrack.raycast import closest

            output = (found.points, found.distances, found.instances, found.faces)
            arguments = (self._top, closest.CALLBACK, queries, np.float32(max_distance), self._geometry(), output)
            kernels.run(count, closest.closest, closest.closest_parallel, *arguments)
        return found

    # -------------------------------------------------------------------------------------------------- life and end

    def close(self) -> None:
        """Release the scene; using it afterwards raises RaycastError."""
        with self._lock:
            if not self._closed and not self.fallback:
                self._release()
            self._closed = True
            self._instances.clear()

    def __enter__(self) -> "RayScene":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    # ------------------------------------------------------------------------------------------------------ internals

    def _open(self) -> None:
        if self._closed:
            raise RaycastError("the ray scene is closed")

    def _get(self, instance: int) -> Instance:
        self._open()
        entry = self._instances.get(instance)
        if entry is None:
            raise InvalidValueError("instance", instance, f"one of {self.instances}")
        return entry

    def _set_keys(self, instance: int, keys: Float64) -> None:
        with self._lock:
            entry = self._get(instance)
            entry.keys = keys
            if entry.geometry:
                _write_keys(entry)
            self._keeper.changed([instance])
            self._dirty = True

    def _geometry(self) -> object:
        """Addresses of the instances' buffers and their poses, for point queries."""
        from simtrack.raycast import closest

        size = max(self._instances, default=-1) + 1
        buffers, poses = np.zeros((size, 2), np.int64), np.zeros((size, 3, 4))
        for number, entry in self._instances.items():
            buffers[number] = entry.mesh.vertices.ctypes.data, entry.mesh.faces.ctypes.data
            poses[number] = entry.keys[0, :3]
        return closest.Geometry(buffers, poses)


def _write_keys(entry: Instance) -> None:
    api = rtc.embree().api
    api.rtcSetGeometryTimeStepCount(entry.geometry, len(entry.keys))
    for step, key in enumerate(entry.keys):
        columns = np.ascontiguousarray(key[:3].T, np.float32)
        layout = rtc.RTC_FORMAT_FLOAT3X4_COLUMN_MAJOR
        api.rtcSetGeometryTransform(entry.geometry, step, layout, columns.ctypes.data)
    api.rtcCommitGeometry(entry.geometry)
    rtc.embree().check("rtcSetGeometryTransform")


def _checked_transforms(T: npt.ArrayLike, name: str) -> Float64:
    """(K, 4, 4) copy of one or several affine transforms."""
    keys = np.array(T, dtype=np.float64)
    if keys.ndim == 2:
        keys = keys[None]
    allowed = "finite invertible affine 4x4 with last row 0 0 0 1"
    if keys.ndim != 3 or keys.shape[1:] != (4, 4) or not len(keys):
        raise InvalidValueError(name, keys.shape, allowed)
    if not np.isfinite(keys).all() or (keys[:, 3] != (0.0, 0.0, 0.0, 1.0)).any():
        raise InvalidValueError(name, keys.tolist(), allowed)
    if (np.abs(np.linalg.det(keys[:, :3, :3])) < 1e-18).any():
        raise InvalidValueError(name, keys.tolist(), allowed)
    return keys


def _checked_rays(
    origins: npt.ArrayLike, directions: npt.ArrayLike, times: npt.ArrayLike | None, packing: RayBundle | None
) -> tuple[Float32, Float32, Float32, Int32]:
    starts, rays = np.ascontiguousarray(origins, np.float32), np.ascontiguousarray(directions, np.float32)
    if rays.ndim != 2 or rays.shape[1] != 3 or starts.shape != rays.shape:
        raise InvalidValueError("origins, directions", (starts.shape, rays.shape), "two arrays (N, 3)")
    count = len(rays)
    moments = np.empty(0, np.float32) if times is None else np.ascontiguousarray(times, np.float32)
    if times is not None and moments.shape != (count,):
        raise InvalidValueError("times", moments.shape, f"({count},)")
    if packing is not None:
        if len(packing) != count:
            raise InvalidValueError("packing", len(packing), f"a bundle of {count} rays")
        return starts, rays, moments, packing.order
    width = rtc.embree().packet_width if rtc.available() else 1
    order = np.minimum(np.arange(-(-count // width) * width, dtype=np.int32), np.int32(max(count - 1, 0)))
    return starts, rays, moments, order
