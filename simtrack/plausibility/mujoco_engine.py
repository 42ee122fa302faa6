"""MuJoCo: the tree's MJCF with free bodies at world level."""

from collections.abc import Collection, Mapping
from pathlib import Path

import numpy as np

from simtrack.contracts import Float64
from simtrack.errors import SimtrackError
from simtrack.geometry.transforms import quaternion_from_rotation, transform
from simtrack.perception.reconstruction.body_tree import BodyTree
from simtrack.perception.reconstruction.files import write_meshes
from simtrack.perception.reconstruction.mjcf import COLLIDES, write_mjcf
from simtrack.plausibility.boxes import near_pairs
from simtrack.plausibility.engine import Proximity


class EngineError(SimtrackError):
    """The engine refused the scene."""


class MujocoEngine:
    """A tree loaded into MuJoCo."""

    name = "mujoco"
    margin = 0.0

    def __init__(self, tree: BodyTree, folder: Path) -> None:
        """Load a tree; its files are written to `folder`."""
        import mujoco

        self.tree = tree
        self.version = mujoco.__version__
        self._mujoco = mujoco
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / "scene.xml"
        write_mjcf(tree, write_meshes(tree, folder), path)
        try:
            self._model = mujoco.MjModel.from_xml_path(str(path))
        except ValueError as error:
            raise EngineError(f"MuJoCo cannot load the scene: {error}") from error
        self._data = mujoco.MjData(self._model)
        colliding = np.flatnonzero(self._model.geom_group == int(COLLIDES))
        self._geoms = [int(geom) for geom in colliding]
        self._names = [self._model.body(int(self._model.geom_bodyid[geom])).name for geom in self._geoms]
        self.reset()

    def reset(self) -> None:
        """Put everything where the description has it, at rest."""
        self.place({})

    def place(self, positions: Mapping[str, float]) -> None:
        """Reset, then move joints (rad or m) and all that hangs on them, also freely, without simulating."""
        model, data = self._model, self._data
        self._mujoco.mj_resetData(model, data)
        poses = self.tree.forward(positions)
        for component in self.tree.components:
            if not component.static:
                address = int(model.joint(f"{component.name}/free").qposadr[0])
                T = poses[component.name]
                data.qpos[address : address + 7] = [*T[:3, 3], *quaternion_from_rotation(T[:3, :3])]
        for name, position in positions.items():
            data.joint(name).qpos[0] = position
        self._mujoco.mj_forward(model, data)

    def step(self, duration: float) -> None:
        """Simulate for so many seconds."""
        self._mujoco.mj_step(self._model, self._data, max(1, round(duration / self._model.opt.timestep)))

    def poses(self) -> dict[str, Float64]:
        """Body name -> (4, 4) T_scene_body."""
        self._mujoco.mj_kinematics(self._model, self._data)
        states = ((body.name, self._data.body(body.name)) for body in self.tree.bodies)
        return {name: transform(state.xmat.reshape(3, 3).copy(), state.xpos.copy()) for name, state in states}

    def proximities(self, limit: float, bodies: Collection[str] | None = None) -> list[Proximity]:
        """Pairs of bodies nearer than `limit` metres, one of them in `bodies` (all if None), nearest point each."""
        if len(self._geoms) < 2:
            return []
        model, data = self._model, self._data
        self._mujoco.mj_kinematics(model, data)
        rotations = data.geom_xmat[self._geoms].reshape(-1, 3, 3)
        local = model.geom_aabb[self._geoms]
        centres = data.geom_xpos[self._geoms] + np.einsum("nij,nj->ni", rotations, local[:, :3])
        half = np.einsum("nij,nj->ni", np.abs(rotations), local[:, 3:])
        chosen = np.array([bodies is None or name in bodies for name in self._names])
        nearest: dict[tuple[str, str], Proximity] = {}
        ends = np.zeros(6)
        for i, j in near_pairs(centres - half, centres + half, limit, chosen):
            a, b = self._names[i], self._names[j]
            if a == b:
                continue
            distance = self._mujoco.mj_geomDistance(model, data, self._geoms[i], self._geoms[j], limit, ends)
            pair = (a, b) if a < b else (b, a)
            if distance < limit and (pair not in nearest or distance < nearest[pair].distance):
                up = float(ends[2] - ends[5]) / distance if abs(distance) > 1e-9 else 0.0
                nearest[pair] = Proximity(a, b, float(distance), up)
        return list(nearest.values())

    def picture(self, path: Path) -> bool:
        """No picture: MuJoCo's renderer needs OpenGL."""
        return False

    def close(self) -> None:
        """Nothing to give back."""
