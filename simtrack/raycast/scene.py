"""A scene of mesh instances: cast rays at it, ask what is occluded and what lies nearest."""

from collections.abc import Sequence
from threading import RLock
from types import TracebackType

import numpy as np
import numpy.typing as npt

from simtrack.contracts import Bool, Float32, Float64
from simtrack.errors import InvalidValueError, RaycastError
from simtrack.raycast import embree as rtc
from simtrack.raycast import fallback, kernels
from simtrack.raycast.bundle import RayBundle, checked_rays
from simtrack.raycast.hierarchy import Hierarchy
from simtrack.raycast.hits import ClosestPoints, RayHits, SelectedHits
from simtrack.raycast.mesh import TriangleMesh
from simtrack.raycast.table import InstanceTable, checked_pose, checked_poses

MAX_INSTANCE = 1 << 21
"""Instance ids are below this: tables are indexed by them."""


class RayScene:
    """Instances of triangle meshes under one hierarchy.

    Moving an instance costs microseconds plus `commit`; meshes are shared, never copied. Casting is thread-safe and
    releases the interpreter lock; changing the scene while another thread casts is not allowed (changes are serialised
    among themselves). The threads used are ``numba.get_num_threads()``; results do not depend on their number.

    An instance that is much larger than all others, such as a static map, is the ground: rays are traced in its mesh
    directly, and through the hierarchy of instances only where one of the others may be met.
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
        self._meshes: dict[int, TriangleMesh] = {}
        self._motions: dict[int, Float64] = {}
        self._table = InstanceTable()
        self._lock = RLock()
        self._dirty, self._motions_changed, self._closed = True, False, False
        self._first_free = 0
        self._hierarchy = None if self.fallback else Hierarchy(self._meshes, self._motions, self._table)

    # ------------------------------------------------------------------------------------------------ what is in it

    @property
    def instances(self) -> tuple[int, ...]:
        """Ids of all instances, ascending."""
        return tuple(sorted(self._meshes))

    def mesh(self, instance: int) -> TriangleMesh:
        """The mesh of an instance."""
        return self._meshes[self._known(instance)]

    def pose(self, instance: int) -> Float64:
        """(4, 4) T_map_mesh of an instance (of its first motion key)."""
        return self._table.poses[self._known(instance)].copy()

    def enabled(self, instance: int) -> bool:
        """Whether an instance is shown to rays and queries."""
        return bool(self._table.enabled[self._known(instance)])

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
            RaycastError: Embree could not build the mesh's hierarchy.
        """
        with self._lock:
            if instance is None:
                while self._first_free in self._meshes:
                    self._first_free += 1
                instance = self._first_free
            self.add_many([mesh], np.eye(4) if T_map_mesh is None else T_map_mesh, [instance])
        return instance

    def add_many(self, meshes: Sequence[TriangleMesh], T_map_mesh: npt.ArrayLike, instances: Sequence[int]) -> None:
        """Place several instances at once, see `add`; `T_map_mesh` (N, 4, 4). If one is refused, none is placed."""
        if not len(instances):
            return
        poses = checked_poses(T_map_mesh, "T_map_mesh")
        if not len(meshes) == len(poses) == len(instances):
            shape = len(meshes), poses.shape, len(instances)
            raise InvalidValueError("meshes, T_map_mesh, instances", shape, "as many of each")
        with self._lock:
            self._open()
            new = set(instances)
            for number in instances:
                if number in self._meshes or not 0 <= number < MAX_INSTANCE or len(new) < len(instances):
                    allowed = f"0..{MAX_INSTANCE - 1}, each once, and not one of {self.instances}"
                    raise InvalidValueError("instance", number, allowed)
            if self._hierarchy:
                for mesh in meshes:
                    _ = mesh.scene_handle  # raises, if it cannot be built, before anything has changed
            numbers = np.array(instances, np.int64)
            self._table.add(numbers, meshes, poses)
            self._meshes.update(zip(instances, meshes, strict=True))
            if self._hierarchy:
                self._hierarchy.attach(numbers)
            self._dirty = True

    def remove(self, instance: int) -> None:
        """Take an instance out; its id becomes free, the others keep theirs."""
        self.remove_many([instance])

    def remove_many(self, instances: Sequence[int]) -> None:
        """Take several instances out at once, see `remove`. If one is unknown, none is taken out."""
        with self._lock:
            numbers = np.array([self._known(instance) for instance in dict.fromkeys(instances)], np.int64)
            if self._hierarchy:
                self._hierarchy.detach(numbers)
            self._table.remove(numbers)
            for number in numbers.tolist():
                self._motions_changed |= self._motions.pop(number, None) is not None
                del self._meshes[number]
                self._first_free = min(self._first_free, number)
            self._dirty = True

    def set_pose(self, instance: int, T_map_mesh: npt.ArrayLike) -> None:
        """Move an instance to the (4, 4) affine transform `T_map_mesh` and end any motion of it."""
        self.set_poses((instance,), T_map_mesh)

    def set_poses(self, instances: Sequence[int], T_map_mesh: npt.ArrayLike) -> None:
        """Move several instances at once, see `set_pose`; `T_map_mesh` (N, 4, 4). If one is unknown, none is moved."""
        if not len(instances):
            return
        poses = checked_poses(T_map_mesh, "T_map_mesh", len(instances))
        with self._lock:
            numbers = self._all_known(instances)
            if self._motions:
                for instance in instances:
                    self._motions_changed |= self._motions.pop(instance, None) is not None
            self._table.place(numbers, poses)
            if self._hierarchy:
                self._hierarchy.move(numbers)
            self._dirty = True

    def set_motion(self, instance: int, T_keys: npt.ArrayLike) -> None:
        """Let an instance move during ray time 0..1.

        Args:
            instance: its id.
            T_keys: (K, 4, 4) T_map_mesh at K = 1..129 equidistant times from 0 to 1; between them the matrices are
                interpolated linearly, element by element (so keys of a rotating body must be close to one another).
        """
        self.set_motions((instance,), checked_poses(T_keys, "T_keys")[None])

    def set_motions(self, instances: Sequence[int], T_keys: Float64) -> None:
        """Let several instances move at once, see `set_motion`; `T_keys` (N, K, 4, 4).

        If one is unknown, none is set off.
        """
        if not len(instances):
            return
        if T_keys.ndim != 4 or len(T_keys) != len(instances):
            raise InvalidValueError("T_keys", T_keys.shape, f"({len(instances)}, K, 4, 4)")
        count = T_keys.shape[1]
        if not 1 <= count <= rtc.RTC_MAX_TIME_STEP_COUNT:
            raise InvalidValueError("T_keys", T_keys.shape, f"1..{rtc.RTC_MAX_TIME_STEP_COUNT} keys")
        keys = checked_poses(T_keys.reshape(-1, *T_keys.shape[2:]), "T_keys").reshape(len(instances), count, 4, 4)
        with self._lock:
            self.set_poses(instances, keys[:, 0])
            if count > 1:
                numbers = np.array(instances, np.int64)
                self._motions.update(zip(numbers.tolist(), keys, strict=True))
                self._table.set_off(numbers)
                self._motions_changed = True
                if self._hierarchy:
                    self._hierarchy.set_off(numbers, keys)

    def set_enabled(self, instance: int, enabled: bool) -> None:
        """Show an instance to rays and queries, or hide it."""
        with self._lock:
            number = self._known(instance)
            if self._table.enabled[number] != enabled:
                self._table.enable(number, enabled)
                if self._hierarchy:
                    self._hierarchy.show(number)
                self._dirty = True

    def commit(self) -> None:
        """Make changes effective; casting does it by itself where needed.

        Raises:
            RaycastError: Embree could not build the scene.
        """
        if not self._dirty and not self._closed:
            return
        with self._lock:
            self._open()
            if not self._dirty:  # another thread was first
                return
            if self._motions_changed:
                self._table.set_motions(self._motions)
            if self._hierarchy:
                self._hierarchy.commit()
            self._dirty = self._motions_changed = False

    # ------------------------------------------------------------------------------------------------------ queries

    def cast(
        self,
        bundle: RayBundle,
        T_map_sensor: npt.ArrayLike,
        max_distance: float = np.inf,
        *,
        min_distance: float = 0.0,
        time: float = 0.0,
        coherent: bool | None = None,
        out: RayHits | None = None,
        changed: Sequence[int] | None = None,
    ) -> RayHits:
        """Cast a bundle from one sensor pose.

        Args:
            bundle: the rays.
            T_map_sensor: (4, 4).
            max_distance: farthest hit, in multiples of the directions' length.
            min_distance: nearest hit, likewise.
            time: of moving instances, 0..1.
            coherent: whether neighbouring rays meet the same few triangles, as a whole image's do; False is faster
                for rays some pixels apart on finely meshed things. None decides ray by ray, from the size of what they
                may meet and its number of faces. The results are the same.
            out: results to overwrite and return (from `RayHits.empty`); saves the allocation.
            changed: ids of the instances that were moved, shown or hidden since `out` was filled by this call with
                otherwise the same arguments: only rays on which they can make a difference are traced. The results
                are the same. None if `out` holds nothing.
        """
        T = checked_pose(T_map_sensor, "T_map_sensor")
        self.commit()
        if changed is not None and out is None:
            raise InvalidValueError("out", None, "the hits before the change, where `changed` is given")
        hits = RayHits.reuse(out, len(bundle))
        if self._hierarchy is None:
            rays = bundle.directions @ T[:3, :3].astype(np.float32).T
            origins = np.broadcast_to(T[:3, 3].astype(np.float32), rays.shape)
            limits = np.float32(min_distance), np.float32(max_distance)
            fallback.cast(self._posed(), origins, rays, np.full(len(bundle), time), *limits, hits)
        elif len(bundle):
            lanes, output = (0,) * bundle.packed.shape[2], (hits.distances, hits.normals, hits.faces, hits.instances)
            rays = bundle.packed, bundle.order, bundle.cones, T, float(time), float(min_distance), float(max_distance)
            together, flags = -1 if coherent is None else int(coherent), self._flags(changed)
            arguments = (lanes, *self._hierarchy.world, *rays, together, flags, *output)
            kernels.run(len(bundle), kernels.cast_bundle, kernels.cast_bundle_parallel, *arguments)
        return hits

    def cast_at(
        self,
        bundle: RayBundle,
        T_map_sensor: npt.ArrayLike,
        instances: Sequence[int],
        max_distance: float = np.inf,
        *,
        min_distance: float = 0.0,
        time: float = 0.0,
        coherent: bool | None = None,
    ) -> SelectedHits:
        """Cast a bundle and keep the nearest hits that are on certain instances.

        The same as `cast` and a choice among its hits, but only rays that the instances' bounding spheres let meet one
        are traced. Everything else in the scene occludes.

        Args:
            bundle: see `cast`, as for the other arguments.
            T_map_sensor: see there.
            instances: ids; those that are hidden are met by nothing.
            max_distance: see there.
            min_distance: see there.
            time: see there.
            coherent: see there.
        """
        if self._hierarchy is None:
            hits = self.cast(bundle, T_map_sensor, max_distance, min_distance=min_distance, time=time)
            rays = np.flatnonzero(np.isin(hits.instances, list(map(self._known, instances)))).astype(np.int32)
            kept = RayHits(hits.distances[rays], hits.normals[rays], hits.faces[rays], hits.instances[rays])
            return SelectedHits(rays, kept)
        from simtrack.raycast.selective import cast_selected, cast_selected_parallel

        T = checked_pose(T_map_sensor, "T_map_sensor")
        self.commit()
        wanted = self._flags(instances)
        wanted[:-1] &= self._table.enabled
        room, rays = RayHits.empty(len(bundle.order)), np.empty(len(bundle.order), np.int32)
        count = 0
        if wanted.any():
            lanes, output = (0,) * bundle.packed.shape[2], (room.distances, room.normals, room.faces, room.instances)
            aim = bundle.packed, bundle.order, bundle.cones, T, float(time), float(min_distance), float(max_distance)
            arguments = (lanes, *self._hierarchy.world, wanted, *aim, -1 if coherent is None else int(coherent))
            count = kernels.run(len(bundle), cast_selected, cast_selected_parallel, *arguments, rays, *output)
        hits = RayHits(room.distances[:count], room.normals[:count], room.faces[:count], room.instances[:count])
        return SelectedHits(rays[:count], hits)

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
        rays = checked_rays(origins, directions, times, packing)
        self.commit()
        hits = RayHits.reuse(out, len(rays[0]))
        if self._hierarchy is None:
            fallback.cast(self._posed(), *rays[:3], np.float32(min_distance), np.float32(max_distance), hits)
        elif len(rays[0]):
            lanes, output = (0,) * rtc.embree().packet_width, (hits.distances, hits.normals, hits.faces, hits.instances)
            arguments = (*rays, float(min_distance), float(max_distance), packing is not None, *output)
            kernels.run(
                len(rays[0]), kernels.cast_rays, kernels.cast_rays_parallel, lanes, *self._hierarchy.world, *arguments
            )
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
        rays = checked_rays(origins, directions, times, None)
        limit = np.ascontiguousarray(np.broadcast_to(np.asarray(distances, np.float32), (len(rays[0]),)))
        self.commit()
        if self._hierarchy is None:
            hits = RayHits.empty(len(limit))
            fallback.cast(self._posed(), *rays[:3], np.float32(min_distance), np.float32(np.inf), hits)
            return hits.distances < limit
        blocked = np.zeros(len(limit), np.bool_)
        if len(limit):
            lanes = (0,) * rtc.embree().packet_width
            others, ground, _, T_ground_map = self._hierarchy.world[:4]
            arguments = (lanes, others, ground, T_ground_map, *rays, float(min_distance), limit, blocked)
            kernels.run(len(limit), kernels.occluded, kernels.occluded_parallel, *arguments)
        return blocked

    def closest_points(
        self, points: npt.ArrayLike, max_distance: float = np.inf, *, signed: bool = False
    ) -> ClosestPoints:
        """Nearest surface points of the enabled instances; moving ones stand at their first key.

        Args:
            points: (N, 3), map frame, metres; one that is not finite finds nothing.
            max_distance: metres; what is farther counts as nothing.
            signed: distances are negative for points inside the instance whose surface is nearest, if its mesh is
                closed (`TriangleMesh.topology`); positive outside of it, and near a mesh that has no inside.

        Raises:
            InvalidValueError: wrong shape, or a negative distance.
        """
        queries = np.require(points, np.float32, ["C", "W"])
        if queries.ndim != 2 or queries.shape[1] != 3:
            raise InvalidValueError("points", queries.shape, "(N, 3)")
        if not max_distance >= 0:
            raise InvalidValueError("max_distance", max_distance, ">= 0")
        self.commit()
        count = len(queries)
        found = ClosestPoints.empty(count)
        if self._hierarchy is None:
            fallback.closest(self._posed(), queries, max_distance, found)
        elif count:
            from simtrack.raycast import closest

            output = (found.points, found.distances, found.instances, found.faces)
            arguments = (closest.CALLBACK, queries, float(max_distance), self._table.buffers, self._table.poses)
            kernels.run(
                16 * count, closest.closest, closest.closest_parallel, *self._hierarchy.world[:4], *arguments, *output
            )
        if signed:
            self._give_signs(queries, found)
        return found

    # -------------------------------------------------------------------------------------------------- life and end

    def close(self) -> None:
        """Release the scene; using it afterwards raises RaycastError."""
        with self._lock:
            if self._hierarchy:
                self._hierarchy.release()
            self._closed = True
            self._meshes.clear()

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

    def _known(self, instance: int) -> int:
        self._open()
        if instance not in self._meshes:
            raise InvalidValueError("instance", instance, f"one of {self.instances}")
        return instance

    def _all_known(self, instances: Sequence[int]) -> npt.NDArray[np.int64]:
        self._open()
        if not self._meshes.keys() >= set(instances):
            for instance in instances:
                self._known(instance)
        return np.array(instances, np.int64)

    def _flags(self, instances: Sequence[int] | None) -> Bool:
        """True for the given ids, and False at the end, where the number of a miss points; nothing for None."""
        flags = np.zeros(0 if instances is None else len(self._table.enabled) + 1, np.bool_)
        if instances is not None:
            flags[[self._known(instance) for instance in instances]] = True
        return flags

    def _give_signs(self, points: Float32, found: ClosestPoints) -> None:
        from simtrack.raycast.topology import give_signs

        for number in np.unique(found.instances[found.instances >= 0]).tolist():
            mesh, chosen = self._meshes[number], np.flatnonzero(found.instances == number)
            around = mesh.topology
            if around.closed:
                shape = mesh.vertices, mesh.faces, around.corners, around.across, around.ring_start, around.ring
                give_signs(points, *shape, self._table.poses[number], chosen, found.faces, found.distances)

    def _posed(self) -> dict[int, fallback.Instance]:
        poses, enabled = self._table.poses, self._table.enabled
        return {
            number: fallback.Instance(
                mesh, self._motions.get(number, poses[number : number + 1]), bool(enabled[number])
            )
            for number, mesh in self._meshes.items()
        }
