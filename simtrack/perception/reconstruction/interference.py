"""Where entities of a scene are in each other, by MuJoCo's collision detection between their convex pieces."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from simtrack.contracts import Float64
from simtrack.errors import MeshError
from simtrack.geometry.meshes import convex_hull
from simtrack.perception.reconstruction.solids import Solid


@dataclass(frozen=True, slots=True, eq=False)
class Contact:
    """Two entities in each other."""

    first: str
    second: str
    depth: float
    """Metres."""
    normal: Float64
    """(3,), unit, from the first to the second."""


class Interference:
    """The pieces of all entities as one collision scene; entities are moved by translations."""

    def __init__(self, solids: Mapping[str, Solid]) -> None:
        import mujoco

        spec = mujoco.MjSpec()
        self._names = list(solids)
        for number, solid in enumerate(solids.values()):
            body = spec.worldbody.add_body(name=str(number))
            body.add_freejoint()
            body.explicitinertial = True
            body.mass, body.inertia = 1.0, [1.0, 1.0, 1.0]
            for k, piece in enumerate(solid.pieces):
                try:
                    hull = convex_hull(piece)
                except MeshError:  # too thin to be in anything
                    continue
                mesh = spec.add_mesh(name=f"{number}/{k}")
                mesh.uservert, mesh.userface = hull.vertices.ravel(), hull.faces.ravel()
                mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
                body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=mesh.name, mass=0.0)
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)
        self._owner = self._model.geom_bodyid - 1

    def contacts(self, shifts: Mapping[str, Float64]) -> list[Contact]:
        """All contacts with positive depth after the entities were shifted by (3,) each."""
        import mujoco

        for number, name in enumerate(self._names):
            self._data.qpos[7 * number : 7 * number + 3] = shifts[name]
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_comPos(self._model, self._data)
        mujoco.mj_collision(self._model, self._data)
        found = self._data.contact
        pairs = self._owner[np.asarray(found.geom)].reshape(-1, 2)
        return [
            Contact(self._names[a], self._names[b], -float(depth), np.array(frame[:3]))
            for (a, b), depth, frame in zip(pairs.tolist(), found.dist, found.frame, strict=True)
            if depth < 0.0
        ]
