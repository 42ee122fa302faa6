"""Bringing things to rest on a support: dropped from random poses, or arranged side by side."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from simtrack.contracts import Float64
from simtrack.datasets.recipe import ArrangePlacement, DropPlacement
from simtrack.errors import SimtrackError
from simtrack.geometry.meshes import Mesh
from simtrack.geometry.transforms import (
    inverse,
    quaternion_from_rotation,
    rotation_from_quaternion,
    transform,
)
from simtrack.objects import ObjectModel
from simtrack.simulation.building.parts import StaticWorld
from simtrack.simulation.contacts import support_tree
from simtrack.simulation.placement import Area, is_free, outline

if TYPE_CHECKING:
    import mujoco

TIMESTEP = 0.002
"""Seconds."""
TRIES = 200
"""Draws for the place of one thing."""
RESTARTS = 5
"""New beginnings with all things before an arrangement counts as impossible."""
ROUNDS = 8
"""How often what fell off the support is dropped again."""
FENCED = 0.8
"""Seconds during which invisible walls keep falling things above the support."""
FENCE = 0.05
"""Metres from the area to those walls."""
CHUNK = 50
"""Steps between two looks at whether all is at rest."""
AT_REST = (0.01, 0.15)
"""m/s and rad/s below which a thing counts as at rest."""


class PlacementError(SimtrackError):
    """Things cannot be placed as a recipe says; the message names the thing."""


@dataclass(frozen=True, slots=True, eq=False)
class Body:
    """A thing to be placed."""

    name: str
    """Unique in the scene."""
    model: ObjectModel
    scale: float
    """Of the model."""

    @property
    def extents(self) -> Float64:
        """(3,), side lengths of the scaled box, metres."""
        return self.scale * self.model.extents


@dataclass(frozen=True, slots=True, eq=False)
class Settled:
    """Where things came to rest."""

    poses: Float64
    """(N, 4, 4) T_map_object."""
    support: tuple[tuple[str, str], ...]
    """(carried, carrier)."""


def settle(
    static: StaticWorld,
    bodies: Sequence[Body],
    area: Area,
    placement: DropPlacement | ArrangePlacement,
    rng: np.random.Generator,
) -> Settled:
    """Place bodies above or on an area of a support and let physics bring them to rest.

    Raises:
        PlacementError: there is no room for a body, or it does not stay on the support, however often it is tried.
    """
    if isinstance(placement, DropPlacement):
        poses = _above(bodies, area, placement, range(len(bodies)), 0.0, rng)
    else:
        poses = _side_by_side(bodies, area, placement.separation, rng)
    drop = _Drop(static, bodies, area, isinstance(placement, DropPlacement))
    lost = list(range(len(bodies)))
    for _ in range(ROUNDS):
        drop.put(lost, poses)
        drop.run(placement.settle)
        lost = drop.lost()
        if not lost:
            return Settled(drop.poses(), drop.support())
        if isinstance(placement, DropPlacement):
            poses = _above(bodies, area, placement, lost, drop.top(lost), rng)
    raise PlacementError(
        f"'{bodies[lost[0]].name}' (box {_size(bodies[lost[0]])} m) does not stay on its support, "
        f"tried {ROUNDS} times; allowed: a larger area, fewer or smaller things"
    )


def _size(body: Body) -> str:
    return " x ".join(f"{side:.3f}" for side in body.extents)


# ------------------------------------------------------------------------------------------------------- first poses


def _above(
    bodies: Sequence[Body], area: Area, placement: DropPlacement, which: Sequence[int], top: float, rng
) -> Float64:
    """(N, 4, 4) poses in the air, apart from one another, of the bodies `which`; the others' are the identity.

    `top` is the height of the heap above the face, metres.
    """
    stuck = ""
    for _ in range(RESTARTS):
        poses = np.tile(np.eye(4), (len(bodies), 1, 1))
        taken: list[tuple[Float64, float]] = []
        for k in which:
            body, radius = bodies[k], float(np.linalg.norm(bodies[k].extents)) / 2
            rotation = _rotation(rng.random() < placement.upright, rng)
            low = float(np.abs(rotation[2]) @ body.extents) / 2 + top
            if (at := _free_point(area, low + rng.uniform(*placement.height), radius, taken, rng)) is None:
                stuck = f"'{body.name}' (box {_size(body)} m)"
                break
            taken.append((at, radius))
            poses[k] = area.T_map_face @ transform(rotation, at)
        else:
            return poses
    raise PlacementError(
        f"{stuck} finds no free place to fall from, {RESTARTS} times {TRIES} tries; "
        "allowed: a larger area, fewer or smaller things"
    )


def _free_point(
    area: Area, height: float, radius: float, taken: Sequence[tuple[Float64, float]], rng: np.random.Generator
) -> Float64 | None:
    """(3,), above the face, or a little higher with every few tries: a ball there touches none that is taken."""
    for attempt in range(TRIES):
        at = np.array([rng.uniform(*area.x), rng.uniform(*area.y), height + 0.02 * (attempt // 4)])
        if all(np.linalg.norm(at - other) > radius + reach for other, reach in taken):
            return at
    return None


def _rotation(upright: bool, rng: np.random.Generator) -> Float64:
    """(3, 3), uniform among all rotations, or among those about z."""
    if upright:
        yaw = rng.uniform(-np.pi, np.pi)
        return np.array([[np.cos(yaw), -np.sin(yaw), 0.0], [np.sin(yaw), np.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
    quaternion = rng.standard_normal(4)
    return rotation_from_quaternion(quaternion / np.linalg.norm(quaternion))


def _side_by_side(bodies: Sequence[Body], area: Area, gap: float, rng: np.random.Generator) -> Float64:
    """(N, 4, 4) upright poses on the face that keep a gap; large ones are placed first."""
    order = sorted(range(len(bodies)), key=lambda k: -float(np.prod(bodies[k].extents[:2])))
    stuck = bodies[0]
    for _ in range(RESTARTS):
        poses: dict[int, Float64] = {}
        for k in order:
            stuck, others = bodies[k], [outline(bodies[other].extents, T) for other, T in poses.items()]
            draws = (area.draw(stuck.extents, (-np.pi, np.pi), rng) for _ in range(TRIES))
            free = (T for T in draws if T is not None and is_free(outline(stuck.extents, T), others, gap))
            if (pose := next(free, None)) is None:
                break
            poses[k] = pose
        else:
            return np.stack([poses[k] for k in range(len(bodies))])
    raise PlacementError(
        f"'{stuck.name}' (box {_size(stuck)} m) finds no free place on its support, {RESTARTS} times {TRIES} tries; "
        "allowed: a larger area, a smaller separation, fewer or smaller things"
    )


# ------------------------------------------------------------------------------------------------------------- physics


class _Drop:
    """A MuJoCo model of the bodies and of the static world's collision boxes."""

    def __init__(self, static: StaticWorld, bodies: Sequence[Body], area: Area, fenced: bool) -> None:
        import mujoco

        self._bodies, self._area = bodies, area
        spec = mujoco.MjSpec()
        spec.compiler.degree = False
        spec.compiler.usethread = False  # see `simtrack.datasets.local.thread_limits`
        spec.option.timestep = TIMESTEP
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        spec.option.impratio = 5.0  # resting things do not creep
        self._names = [part.name for part in static.parts] + [body.name for body in bodies]
        for k, part in enumerate(static.parts):
            for j, (T_part_box, extents) in enumerate(part.collision):
                _add_box(spec, f"{k}#{j}", part.T_map_part @ T_part_box, np.asarray(extents, float))
        if fenced:
            _add_fence(spec, area)
        for k, body in enumerate(bodies):
            _add_body(spec, f"{len(static.parts) + k}", body)
        self._model: mujoco.MjModel = spec.compile()
        self._data = mujoco.MjData(self._model)
        first = len(static.parts)
        # Geoms are called after the number of what they belong to.
        geoms = [self._model.geom(k).name.partition("#")[0] for k in range(self._model.ngeom)]
        self._owners = np.array([int(name) if name else -1 for name in geoms], np.int32)
        self._movable = np.arange(len(self._names)) >= first
        self._body_ids = np.array([self._model.body(f"{first + k}").id for k in range(len(bodies))])

    def put(self, which: Sequence[int], poses: Float64) -> None:
        """Put bodies at poses (N, 4, 4), at rest; the others stay as they are."""
        for k in which:
            joint = 7 * k
            self._data.qpos[joint : joint + 3] = poses[k, :3, 3]
            self._data.qpos[joint + 3 : joint + 7] = quaternion_from_rotation(poses[k, :3, :3])
            self._data.qvel[6 * k : 6 * k + 6] = 0.0

    def run(self, seconds: float) -> None:
        """Let things fall until they rest, at most for so many seconds; what still moves then is stopped."""
        import mujoco

        fence = self._owners < 0
        least = FENCED if fence.any() else 0.0
        for chunk in range(max(1, round(seconds / (TIMESTEP * CHUNK)))):
            done = chunk * CHUNK * TIMESTEP
            self._model.geom_contype[fence] = 1 if done < least else 0
            mujoco.mj_step(self._model, self._data, nstep=CHUNK)
            speed = np.abs(self._data.qvel).reshape(-1, 2, 3).max(axis=(0, 2)) if self._model.nv else np.zeros(2)
            if done >= least + 0.2 and (speed < AT_REST).all():
                break
        self._data.qvel[:] = 0.0
        mujoco.mj_forward(self._model, self._data)

    def poses(self) -> Float64:
        """(N, 4, 4) T_map_object."""
        R, t = self._data.xmat[self._body_ids].reshape(-1, 3, 3), self._data.xpos[self._body_ids]
        return np.stack([transform(a, b) for a, b in zip(R, t, strict=True)]) if len(R) else np.empty((0, 4, 4))

    def support(self) -> tuple[tuple[str, str], ...]:
        """(carried, carrier) by name."""
        return support_tree(self._data, self._owners, self._movable, self._names)

    def lost(self) -> list[int]:
        """Bodies whose middle is not above the face, or whose pose is not finite."""
        at = self.poses()[:, :3, 3] - self._area.T_map_face[:3, 3]
        local = at @ self._area.T_map_face[:3, :3]
        inside = (np.abs(local[:, :2]) <= self._area.size / 2).all(axis=1) & (local[:, 2] > 0.0)
        return [int(k) for k in np.flatnonzero(~inside)]  # comparisons with NaN are False

    def top(self, without: Sequence[int]) -> float:
        """Height above the face of the bounding spheres of all bodies but some."""
        kept = [k for k in range(len(self._bodies)) if k not in without]
        T_face_map = inverse(self._area.T_map_face)
        poses = T_face_map @ self.poses()
        return max(
            [0.0, *(poses[k, 2, 3] + float(np.abs(poses[k, 2, :3]) @ self._bodies[k].extents) / 2 for k in kept)]
        )


def _add_box(spec: "mujoco.MjSpec", name: str, T: Float64, extents: Float64) -> None:
    import mujoco

    spec.worldbody.add_geom(
        name=name, type=mujoco.mjtGeom.mjGEOM_BOX, size=extents / 2, pos=T[:3, 3],
        quat=quaternion_from_rotation(T[:3, :3]), contype=1, conaffinity=0, friction=[0.6, 0.005, 0.0001],
    )  # fmt: skip


def _add_fence(spec: "mujoco.MjSpec", area: Area) -> None:
    """Four walls about the area, nameless, that touch nothing until they are switched on."""
    import mujoco

    low, high = np.array([area.x[0], area.y[0]]) - FENCE, np.array([area.x[1], area.y[1]]) + FENCE
    middle, half = (low + high) / 2, (high - low) / 2
    for axis in range(2):
        for side in (-1.0, 1.0):
            at, size = np.array([*middle, 5.0]), np.array([half[0] + 0.2, half[1] + 0.2, 5.0])
            at[axis] += side * (half[axis] + 0.1)
            size[axis] = 0.1
            T = area.T_map_face @ transform(None, at)
            spec.worldbody.add_geom(
                type=mujoco.mjtGeom.mjGEOM_BOX, size=size, pos=T[:3, 3], quat=quaternion_from_rotation(T[:3, :3]),
                contype=0, conaffinity=0, friction=[0.1, 0.0, 0.0],
            )  # fmt: skip


def _add_body(spec: "mujoco.MjSpec", name: str, body: Body) -> None:
    """Add a body that falls freely, made of its model's convex parts; nothing is seen of it."""
    import mujoco

    model, scale = body.model, body.scale
    added = spec.worldbody.add_body(name=name)
    added.add_freejoint()
    added.explicitinertial = True
    added.mass, added.ipos = model.mass * scale**3, model.centre_of_mass * scale
    inertia = model.inertia * scale**5
    added.fullinertia = [*np.diag(inertia), inertia[0, 1], inertia[0, 2], inertia[1, 2]]
    for j, part in enumerate(model.collision):
        added.add_geom(
            name=f"{name}#{j}", type=mujoco.mjtGeom.mjGEOM_MESH, meshname=_asset(spec, part, scale),
            mass=0.0, contype=2, conaffinity=3, condim=6, friction=[model.friction, 0.005, 0.002],
        )  # fmt: skip


def _asset(spec: "mujoco.MjSpec", part: Mesh, scale: float) -> str:
    """Name of the asset of a convex part at a scale, added if it is not there yet."""
    asset = f"{id(part)}@{scale!r}"
    if spec.mesh(asset) is None:
        added = spec.add_mesh(name=asset)
        added.uservert, added.userface = (scale * part.vertices).ravel(), part.faces.ravel()
    return asset
