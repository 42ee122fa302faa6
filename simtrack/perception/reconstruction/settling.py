"""Settling: what is free comes to rest on what is there. Beyond the reconstruction paper.

Snapping moves models along z and on the level, so that Eq. 1 holds for what stands upright on a face. What leans, what
lies on a pile and what stands on an uneven model touches at points that no single plane explains: such bodies settle
in a strongly damped simulation of the exported shapes in MuJoCo. Whoever is at rest already stays exactly where
snapping put it. The motion is bounded: a body that would topple or go far is held where it was seen, and reported.
Joints of articulated models keep their position. The judge of a scene is another engine, see `simtrack.plausibility`.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from simtrack.contracts import Float64
from simtrack.errors import InvalidValueError
from simtrack.geometry.transforms import apply, inverse, quaternion_from_rotation, transform
from simtrack.perception.reconstruction.body_tree import Body, BodyTree, Component, Shape

if TYPE_CHECKING:
    import mujoco

TIMESTEP = 0.002
STIFF = (2.0 * TIMESTEP, 1.0)
"""Time constant in seconds and damping ratio of contacts: bodies rest less than 0.1 mm deep in each other."""
PHASES = ((400, 0.8), (800, 0.98))
"""Steps, and the share of its velocity that a body keeps in a step: first it cannot jump out of what it is in, then it
falls over if it stands on an edge."""
STILL = 2e-4
"""m/s and rad/s below which nothing moves any more."""
LEAST = 50
"""Steps of a phase before stillness counts."""


@dataclass(frozen=True, slots=True)
class SettlingConfig:
    """Bounds of settling."""

    shift: float = 0.05
    """Metres that a centre of mass may move."""
    turn: float = float(np.radians(20.0))
    """Radians that a body may turn away from its pose."""
    rest: float = 0.001
    """Metres of motion of any of its points up to which a body is at rest where it is, and stays exactly there."""
    depth: float = 0.003
    """Metres that a body may be in another at rest."""
    friction: float = 0.8
    """Share of the friction that is counted on."""
    rounds: int = 4
    """Of holding what went too far and settling the others again; 0: nothing settles."""

    def __post_init__(self) -> None:
        for name in ("shift", "turn", "rest", "depth"):
            if not 0.0 < getattr(self, name) < np.inf:
                raise InvalidValueError(f"SettlingConfig.{name}", getattr(self, name), "positive and finite")
        if not 0.0 < self.friction <= 1.0:
            raise InvalidValueError("SettlingConfig.friction", self.friction, "a share in (0, 1]")
        if self.rounds < 0:
            raise InvalidValueError("SettlingConfig.rounds", self.rounds, "0 or more")


@dataclass(frozen=True, slots=True)
class Motion:
    """How far a body went."""

    shift: float
    """Metres, of its centre of mass."""
    turn: float
    """Radians, about any axis."""


@dataclass(frozen=True, slots=True, eq=False)
class Settled:
    """Where a scene comes to rest."""

    poses: Mapping[str, Float64]
    """Root body of each free component -> (4, 4) T_scene_body; as given for what did not move, or was held."""
    held: Mapping[str, Motion]
    """Bodies that would have gone too far, and how far."""
    stuck: Mapping[str, float]
    """Free components that are deeper than `SettlingConfig.depth` in another at rest, and how deep, metres."""


def settle(tree: BodyTree, config: SettlingConfig | None = None) -> Settled:
    """Let the free components of a tree come to rest; the others, and all joints, stay."""
    config = config or SettlingConfig()
    start = {part.name: np.asarray(part.T_scene_root, float) for part in tree.components if not part.static}
    held: dict[str, Motion] = {}
    depths: dict[str, float] = {}
    poses = dict(start)
    for _ in range(config.rounds):
        if len(held) == len(start):
            break
        found, depths = _simulated(tree, held, config)
        motions = {name: _motion(tree.by_name[name], start[name], T) for name, T in found.items()}
        far = {n: m for n, m in motions.items() if not (m.shift <= config.shift and m.turn <= config.turn)}
        poses = {**start, **{name: T for name, T in found.items() if name not in far}}
        held |= far
        if not far:
            break
    parts = {part.name: part for part in tree.components}
    kept = {name: T if _moved(parts[name], start[name], T) > config.rest else start[name] for name, T in poses.items()}
    return Settled(kept, held, {name: depths[name] for name in start if depths.get(name, 0.0) > config.depth})


def _simulated(
    tree: BodyTree, held: Collection[str], config: SettlingConfig
) -> tuple[dict[str, Float64], dict[str, float]]:
    """Free components that are not held -> (4, 4) T_scene_root at rest; all -> metres that they are in others."""
    import mujoco

    spec = mujoco.MjSpec()
    spec.option.timestep = TIMESTEP
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 10.0
    local = tree.forward()
    free = [part for part in tree.components if not part.static and part.name not in held]
    loose = {part.name for part in free}
    for part in tree.components:
        _add_component(spec, part, local, config, loose=part.name in loose)
    model = spec.compile()
    data = mujoco.MjData(model)
    for steps, kept in PHASES:
        for step in range(steps):
            mujoco.mj_step(model, data)
            data.qvel *= kept
            if step >= LEAST and np.abs(data.qvel).max(initial=0.0) < STILL:
                break
    mujoco.mj_fwdPosition(model, data)
    depths: dict[str, float] = {}
    for contact in data.contact:
        for geom in contact.geom:
            name = model.body(int(model.body_rootid[model.geom_bodyid[geom]])).name
            depths[name] = max(depths.get(name, 0.0), -float(contact.dist))
    states = {part.name: data.body(part.name) for part in free}
    poses = {name: transform(state.xmat.reshape(3, 3).copy(), state.xpos.copy()) for name, state in states.items()}
    return poses, depths


def _add_component(
    spec: "mujoco.MjSpec", part: Component, poses: Mapping[str, Float64], config: SettlingConfig, *, loose: bool
) -> None:
    """One body for the root and one for each other body of the component, all rigidly in one."""
    root = None
    for body in part.bodies:
        T_scene_body = poses[body.name]
        if root is None:
            made = root = spec.worldbody.add_body(name=body.name, **_pose(T_scene_body))
            if loose:
                made.add_freejoint()
        else:
            made = root.add_body(name=body.name, **_pose(inverse(part.T_scene_root) @ T_scene_body))
        if body.mass > 0.0:
            moments, T_body_principal = body.principal_inertia()
            made.explicitinertial = True
            made.mass, made.inertia = body.mass, moments
            made.ipos, made.iquat = T_body_principal[:3, 3], quaternion_from_rotation(T_body_principal[:3, :3])
        for k, shape in enumerate(body.collision):
            _add_shape(spec, made, f"{body.name}/{k}", shape, config.friction * body.friction)


def _add_shape(spec: "mujoco.MjSpec", body: Any, name: str, shape: Shape, friction: float) -> None:
    import mujoco

    kinds = mujoco.mjtGeom
    geom = body.add_geom(mass=0.0, **_pose(shape.pose))
    geom.friction[0] = friction
    geom.solref[:] = STIFF
    if shape.mesh is not None:
        mesh = spec.add_mesh(name=name)
        mesh.uservert, mesh.userface = shape.mesh.vertices.ravel(), shape.mesh.faces.ravel()
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
        geom.type, geom.meshname = kinds.mjGEOM_MESH, name
    elif shape.kind == "cylinder":
        geom.type, geom.size[:2] = kinds.mjGEOM_CYLINDER, (shape.size[0], 0.5 * shape.size[1])
    elif shape.kind == "sphere":
        geom.type, geom.size[0] = kinds.mjGEOM_SPHERE, shape.size[0]
    else:
        geom.type, geom.size[:] = kinds.mjGEOM_BOX, 0.5 * np.array(shape.size)


def _pose(T: Float64) -> dict[str, Any]:
    return {"pos": T[:3, 3], "quat": quaternion_from_rotation(T[:3, :3])}


def _motion(body: Body, T_start: Float64, T_end: Float64) -> Motion:
    assert body.centre_of_mass is not None
    centre = body.centre_of_mass[None]
    shift = float(np.linalg.norm(apply(T_end, centre) - apply(T_start, centre)))
    cosine = 0.5 * (np.trace(T_start[:3, :3].T @ T_end[:3, :3]) - 1.0)
    return Motion(shift, float(np.arccos(np.clip(cosine, -1.0, 1.0))))


def _moved(part: Component, T_start: Float64, T_end: Float64) -> float:
    """Largest distance that a corner of the root's shapes went, metres."""
    corners = [shape.corners() for shape in part.bodies[0].collision]
    points = np.concatenate(corners) if corners else np.zeros((1, 3))
    return float(np.linalg.norm(apply(T_end, points) - apply(T_start, points), axis=1).max())
