"""The true world as a scene to cast rays at: for the lidar, the ray renderer and the ground truth's visibility."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from simtrack.contracts import Float32, Float64, Int32
from simtrack.geometry.meshes import concatenate, transformed
from simtrack.raycast import RayHits, RayScene, TriangleMesh
from simtrack.simulation.world import World, body_poses

if TYPE_CHECKING:
    import mujoco

STILL = 1e-9
"""Metres (or matrix elements): what moves less during a lidar turn is at rest."""


class WorldRays:
    """All instances of a world in one `RayScene`; what is fixed in the world is one mesh."""

    def __init__(self, world: World) -> None:
        fixed = [instance for instance in world.instances if instance.body == 0]
        self.moving = tuple(instance for instance in world.instances if instance.body != 0)
        index = {name: k for k, name in enumerate(world.names)}
        self.scene = RayScene()
        colors: list[np.ndarray] = []
        ids: list[np.ndarray] = []
        self._offsets: list[int] = []
        shared: dict[int, TriangleMesh] = {}
        total = 0
        groups = [[instance] for instance in self.moving]
        for number, group in enumerate([fixed, *groups] if fixed else groups):
            mesh = group[0].mesh
            if number == 0 and fixed:
                mesh = concatenate([transformed(part.mesh, part.T_body_mesh) for part in group])
            if id(group[0].mesh) not in shared or group is fixed:
                shared[id(mesh)] = TriangleMesh(mesh.vertices, mesh.faces, group[0].name)
            self.scene.add(shared[id(mesh)], instance=number)
            self._offsets.append(total)
            total += len(mesh.faces)
            ids += [np.full(len(part.mesh.faces), index[part.name], np.int32) for part in group]
            grey = np.full((len(mesh.faces), 3), 200, np.uint8)
            colors.append(grey if mesh.face_colors is None else mesh.face_colors)
        self._first = 1 if fixed else 0
        self._bodies = [instance.body for instance in self.moving]
        self._T_body_mesh = np.array([instance.T_body_mesh for instance in self.moving]).reshape(-1, 4, 4)
        self._placed = np.full((len(self.moving), 4, 4), np.nan)
        """Where what is at rest was put last."""
        self._face_ids = np.concatenate(ids)
        self._face_colors = np.concatenate(colors)
        self._face_albedos = self._face_colors.mean(axis=1, dtype=np.float32) / np.float32(255)
        self._face_offsets = np.array(self._offsets)

    @property
    def fixed(self) -> int | None:
        """The instance of what is fixed in the world, None if nothing is; those of `moving` follow in their order."""
        return 0 if self._first else None

    def face_ids(self, instance: int) -> Int32:
        """(F,), index into `World.names` of what each face of an instance belongs to."""
        first = self._offsets[instance]
        return self._face_ids[first : first + len(self.scene.mesh(instance).faces)]

    def place(self, data: "mujoco.MjData", poses: Float64 | None = None) -> None:
        """Move everything to where it is in `data`; its `poses`, if they are known."""
        wanted = self.poses(data) if poses is None else poses
        self._rest(np.flatnonzero((wanted != self._placed).any(axis=(1, 2))), wanted)

    def _rest(self, chosen: npt.NDArray[np.int64], poses: Float64) -> None:
        """Put some of what moves to rest, by their places in `moving`, at their `poses`, of all that moves."""
        self.scene.set_poses((chosen + self._first).tolist(), poses[chosen])
        self._placed[chosen] = poses[chosen]

    def poses(self, data: "mujoco.MjData") -> Float64:
        """(I, 4, 4) T_map_mesh of what moves, in the order of `moving`."""
        return body_poses(data, self._bodies) @ self._T_body_mesh

    def move(self, keys: Sequence[Float64]) -> None:
        """Let everything move through keys (K of (I, 4, 4), see `poses`) during ray time 0 to 1."""
        tracks = np.stack(keys, axis=1)
        still = np.abs(tracks - tracks[:, :1]).max(axis=(1, 2, 3)) < STILL
        first = tracks[:, 0]
        self._rest(np.flatnonzero(still & (first != self._placed).any(axis=(1, 2))), first)
        numbers = np.arange(self._first, self._first + len(tracks))
        self.scene.set_motions(numbers[~still].tolist(), tracks[~still])
        self._placed[~still] = np.nan

    def ids(self, hits: RayHits) -> Int32:
        """(N,) index into `World.names` of what each ray hit, -1 = nothing."""
        return np.where(hits.hit, self._face_ids[self._faces(hits)], -1).astype(np.int32)

    def colors(self, hits: RayHits) -> Float32:
        """(N, 3) colour of the face that each ray hit, 0 to 1; 0 for a miss."""
        colors = self._face_colors[self._faces(hits)] * np.float32(1 / 255)
        return np.where(hits.hit[:, None], colors, np.float32(0.0))

    def albedos(self, hits: RayHits) -> Float32:
        """(N,) diffuse albedo 0 to 1 of the face that each ray hit: its mean colour, for want of an infrared one."""
        return self._face_albedos[self._faces(hits)]

    def _faces(self, hits: RayHits) -> np.ndarray:
        return np.where(hits.hit, self._face_offsets[hits.instances] + hits.faces, 0)

    def close(self) -> None:
        """Release Embree's structures."""
        self.scene.close()
