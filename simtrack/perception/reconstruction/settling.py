"""Settling: what is free comes to rest on what is there. Beyond the reconstruction paper.

Snapping moves models along z and on the level, so that Eq. 1 holds for what stands upright on a face. What leans, what
lies on a pile and what stands on an uneven model touches at points that no single plane explains: such bodies settle
in a strongly damped simulation of the exported shapes in MuJoCo. Whoever is at rest already stays exactly where
snapping put it. The motion is bounded: a body that would topple or go far is held where it was seen, and reported.

Rest must not hang on a millimetre or on one engine's way of counting contacts: the scene at rest is tilted a little to
each side, and what moves then is reported as wobbly. Joints of articulated models keep their position. The judge of a
scene is another engine, see `simtrack.plausibility`.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from hashlib import blake2b
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from simtrack.contracts import Float64
from simtrack.errors import InvalidValueError
from simtrack.geometry.transforms import apply, inverse, quaternion_from_rotation, transform
from simtrack.perception.reconstruction.body_tree import Body, BodyTree, Shape, collision_points

if TYPE_CHECKING:
    import mujoco

TIMESTEP = 0.002
STIFF = (2.0 * TIMESTEP, 1.0)
"""Time constant in seconds and damping ratio of contacts: bodies rest less than 0.1 mm deep in each other."""
PHASES = ((400, 0.8), (800, 0.98))
"""Steps, and the share of its velocity that a body keeps in a step: first it cannot jump out of what it is in, then it
falls over if it stands on an edge."""
TILTING = (300, 0.995)
"""The same while the scene is tilted to one side: half a second, in which what stands on an edge falls visibly."""
SIDES = ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))
"""Directions in which the scene is tilted; first it is not."""
GRAVITY = 9.81
STILL = 2e-4
"""m/s and rad/s below which nothing moves any more."""
LEAST = 50
"""Steps of a phase before stillness counts."""


@dataclass(frozen=True, slots=True)
class SettlingConfig:
    """Bounds of settling."""

    shift: float = 0.05
    """Metres that a centre of mass may move."""
    turn: float = float(np.radians(12.0))
    """Radians that a body may turn away from its pose."""
    rest: float = 0.001
    """Metres of motion of any of its points up to which a body is at rest where it is, and stays exactly there."""
    depth: float = 0.003
    """Metres that a body may be in another at rest."""
    friction: float = 0.8
    """Share of the friction that is counted on."""
    rounds: int = 4
    """Of holding what went too far and settling the others again; 0: nothing settles."""
    tilt: float = float(np.radians(4.0))
    """Radians by which the scene at rest is tilted to each side; 0: it is not."""
    wobble: float = 0.02
    """Metres of motion of any of its points from which a body that is tilted so is wobbly."""

    def __post_init__(self) -> None:
        for name in ("shift", "turn", "rest", "depth", "wobble"):
            if not 0.0 < getattr(self, name) < np.inf:
                raise InvalidValueError(f"SettlingConfig.{name}", getattr(self, name), "positive and finite")
        if not 0.0 < self.friction <= 1.0:
            raise InvalidValueError("SettlingConfig.friction", self.friction, "a share in (0, 1]")
        if self.rounds < 0:
            raise InvalidValueError("SettlingConfig.rounds", self.rounds, "0 or more")
        if not 0.0 <= self.tilt < 0.5:
            raise InvalidValueError("SettlingConfig.tilt", self.tilt, "radians from 0 to 0.5")


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
    wobbly: Mapping[str, float] = field(default_factory=dict)
    """Free components that rest, but move by more than `SettlingConfig.wobble` when tilted, and how far, metres."""

    @property
    def restless(self) -> dict[str, float]:
        """Free components whose place is none to rest, and how bad it is, metres."""
        far = {name: motion.shift for name, motion in self.held.items()}
        return {**self.wobbly, **self.stuck, **far}

    def trouble(self, body: str) -> str:
        """What keeps a restless component from resting."""
        if body in self.held:
            motion = self.held[body]
            return f"would go {1e3 * motion.shift:.0f} mm and turn by {np.degrees(motion.turn):.0f} degrees"
        if body in self.stuck:
            return f"is {1e3 * self.stuck[body]:.1f} mm deep in another at rest"
        return f"moves by {1e3 * self.wobbly[body]:.0f} mm when the scene is tilted a little"


def settle(tree: BodyTree, config: SettlingConfig | None = None, known: "Known | None" = None) -> Settled:
    """Let the free components of a tree come to rest; the others, and all joints, stay.

    Components that are so far apart that they cannot meet settle one group after the other.

    Args:
        tree: the scene.
        config: bounds.
        known: groups that settled before; those that are as they were then are not simulated again. New ones are added.
    """
    config = config or SettlingConfig()
    known = {} if known is None else known
    scenery, groups = _grouped(tree, config)
    found: list[Settled] = []
    for group in groups:
        near = scenery.near(group, config)
        key = _digest([*group, *near], config)
        if key not in known:
            known[key] = _settled(group, near, config)
        found.append(known[key])
    return Settled(
        poses={name: T for part in found for name, T in part.poses.items()},
        held={name: motion for part in found for name, motion in part.held.items()},
        stuck={name: depth for part in found for name, depth in part.stuck.items()},
        wobbly={name: far for part in found for name, far in part.wobbly.items()},
    )


Known: TypeAlias = dict[bytes, Settled]
"""What settled before: digest of a group of components and of what is near it -> where it comes to rest."""


@dataclass(frozen=True, slots=True, eq=False)
class _Rigid:
    """Shapes that move as one, in the scene."""

    name: str
    T_scene_root: Float64
    bodies: tuple[tuple[Body, Float64], ...]
    """With T_scene_body (4, 4)."""
    corners: Float64
    """(N, 3) of all shapes, scene."""

    @staticmethod
    def of(name: str, T_scene_root: Float64, bodies: Sequence[Body], poses: Mapping[str, Float64]) -> "_Rigid":
        """Bodies at T_scene_body (4, 4)."""
        placed = tuple((body, poses[body.name]) for body in bodies)
        return _Rigid(name, T_scene_root, placed, collision_points(bodies, poses))


class _Scenery:
    """What does not move, shape by shape."""

    def __init__(self, bodies: Sequence[Body], poses: Mapping[str, Float64]) -> None:
        self._parts = [
            _Rigid.of(f"{body.name}/{k}", np.eye(4), (replace(body, collision=(shape,)),), poses)
            for body in bodies
            for k, shape in enumerate(body.collision)
        ]
        self._low = np.array([part.corners.min(axis=0) for part in self._parts]).reshape(-1, 3)
        self._high = np.array([part.corners.max(axis=0) for part in self._parts]).reshape(-1, 3)

    def near(self, group: Sequence[_Rigid], config: SettlingConfig) -> list[_Rigid]:
        """What a group could meet."""
        corners = np.concatenate([part.corners for part in group])
        low, high = corners.min(axis=0) - 2.0 * config.shift, corners.max(axis=0) + 2.0 * config.shift
        close = (np.maximum(self._low - high, low - self._high) <= 0.0).all(axis=1)
        return [self._parts[k] for k in np.flatnonzero(close)]


def _grouped(tree: BodyTree, config: SettlingConfig) -> tuple[_Scenery, list[list[_Rigid]]]:
    """What does not move, and the free components in groups that are too far apart to meet."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    poses = tree.forward()
    scenery = _Scenery([body for part in tree.components if part.static for body in part.bodies], poses)
    free = [
        _Rigid.of(part.name, np.asarray(part.T_scene_root, float), part.bodies, poses)
        for part in tree.components
        if not part.static
    ]
    spans = [part.corners if len(part.corners) else part.T_scene_root[None, :3, 3] for part in free]
    low = np.array([span.min(axis=0) for span in spans]).reshape(-1, 3) - config.shift
    high = np.array([span.max(axis=0) for span in spans]).reshape(-1, 3) + config.shift
    apart = np.maximum(low[:, None] - high[None], low[None] - high[:, None]).max(axis=2, initial=-np.inf)
    _, labels = connected_components(coo_array(apart <= 0.0), directed=False)
    return scenery, [[free[k] for k in np.flatnonzero(labels == label)] for label in np.unique(labels)]


def _digest(parts: Sequence[_Rigid], config: SettlingConfig) -> bytes:
    """Of all that decides where things come to rest."""
    found = blake2b(repr(config).encode(), digest_size=16)
    for part in parts:
        found.update(f"{part.name} {len(part.corners)}".encode())
        found.update(np.ascontiguousarray(part.corners).tobytes() + part.T_scene_root.tobytes())
        for body, T in part.bodies:
            assert body.centre_of_mass is not None and body.inertia is not None
            found.update(
                np.array([body.mass, body.friction, *body.centre_of_mass, *body.inertia.ravel(), *T.ravel()]).tobytes()
            )
    return found.digest()


def _settled(group: Sequence[_Rigid], near: Sequence[_Rigid], config: SettlingConfig) -> Settled:
    """One group at rest."""
    parts = {part.name: part for part in group}
    start = {name: part.T_scene_root for name, part in parts.items()}
    held: dict[str, Motion] = {}
    depths: dict[str, float] = {}
    wobbly: dict[str, float] = {}
    poses = dict(start)
    for _ in range(config.rounds):
        if len(held) == len(start):
            break
        simulation = _Simulation(group, near, held, config)
        simulation.rest()
        found, depths = simulation.poses(), simulation.depths()
        motions = {name: _motion(parts[name].bodies[0][0], start[name], T) for name, T in found.items()}
        far = {n: m for n, m in motions.items() if not (m.shift <= config.shift and m.turn <= config.turn)}
        poses = {**start, **{name: T for name, T in found.items() if name not in far}}
        held |= far
        if not far:
            wobbly = simulation.wobbling()
            break
    kept = {name: T if _moved(parts[name], start[name], T) > config.rest else start[name] for name, T in poses.items()}
    stuck = {name: depths[name] for name in start if depths.get(name, 0.0) > config.depth}
    return Settled(kept, held, stuck, wobbly)


class _Simulation:
    """A group of components and what is near it in MuJoCo, every component rigid; those that are held are fixed."""

    def __init__(
        self, group: Sequence[_Rigid], near: Sequence[_Rigid], held: Collection[str], config: SettlingConfig
    ) -> None:
        import mujoco

        spec = mujoco.MjSpec()
        spec.option.timestep = TIMESTEP
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        spec.option.impratio = 10.0
        self._free = {part.name: part for part in group if part.name not in held}
        for part in (*group, *near):
            _add(spec, part, config, loose=part.name in self._free)
        self._config = config
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)

    def rest(self) -> None:
        """Simulate until nothing moves, or long enough."""
        for steps, kept in PHASES:
            self._step(steps, kept)

    def _step(self, steps: int, kept: float) -> None:
        import mujoco

        for step in range(steps):
            mujoco.mj_step(self._model, self._data)
            self._data.qvel *= kept
            if step >= LEAST and np.abs(self._data.qvel).max(initial=0.0) < STILL:
                break
        mujoco.mj_fwdPosition(self._model, self._data)

    def poses(self) -> dict[str, Float64]:
        """Free components -> (4, 4) T_scene_root."""
        states = {name: self._data.body(name) for name in self._free}
        return {name: transform(state.xmat.reshape(3, 3).copy(), state.xpos.copy()) for name, state in states.items()}

    def depths(self) -> dict[str, float]:
        """Components -> metres that they are in others; those that touch nothing are missing."""
        found: dict[str, float] = {}
        for contact in self._data.contact:
            for geom in contact.geom:
                name = self._model.body(int(self._model.body_rootid[self._model.geom_bodyid[geom]])).name
                found[name] = max(found.get(name, 0.0), -float(contact.dist))
        return found

    def wobbling(self) -> dict[str, float]:
        """Free components that move too far when the scene is tilted, and how far, metres."""
        if self._config.tilt == 0.0:
            return {}
        resting, state = self.poses(), self._data.qpos.copy()
        gone = dict.fromkeys(self._free, 0.0)
        for side in SIDES:
            across = np.sin(self._config.tilt) * np.array(side)
            self._model.opt.gravity[:] = GRAVITY * np.array([*across, -np.sqrt(1.0 - across @ across)])
            self._data.qpos[:], self._data.qvel[:] = state, 0.0
            self._step(*TILTING)
            for name, T in self.poses().items():
                gone[name] = max(gone[name], _moved(self._free[name], resting[name], T))
        return {name: far for name, far in gone.items() if far > self._config.wobble}


def _add(spec: "mujoco.MjSpec", part: _Rigid, config: SettlingConfig, *, loose: bool) -> None:
    """One body for the root and one for each other body, all rigidly in one."""
    root = spec.worldbody.add_body(name=part.name, **_pose(part.T_scene_root))
    if loose:
        root.add_freejoint()
    T_root_scene = inverse(part.T_scene_root)
    for k, (body, T_scene_body) in enumerate(part.bodies):
        made = root if k == 0 else root.add_body(name=body.name, **_pose(T_root_scene @ T_scene_body))
        if loose and body.mass > 0.0:
            moments, T_body_principal = body.principal_inertia()
            made.explicitinertial = True
            made.mass, made.inertia = body.mass, moments
            made.ipos, made.iquat = T_body_principal[:3, 3], quaternion_from_rotation(T_body_principal[:3, :3])
        T_made_body = T_root_scene @ T_scene_body if k == 0 else np.eye(4)
        for number, shape in enumerate(body.collision):
            _add_shape(spec, made, f"{part.name}/{k}/{number}", shape, T_made_body, config.friction * body.friction)


def _add_shape(
    spec: "mujoco.MjSpec", body: Any, name: str, shape: Shape, T_made_body: Float64, friction: float
) -> None:
    import mujoco

    kinds = mujoco.mjtGeom
    geom = body.add_geom(mass=0.0, **_pose(T_made_body @ shape.pose))
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


def _moved(part: _Rigid, T_start: Float64, T_end: Float64) -> float:
    """Largest distance that a corner of the shapes goes when the root goes from one pose to another, metres."""
    points = apply(inverse(part.T_scene_root), part.corners) if len(part.corners) else np.zeros((1, 3))
    return float(np.linalg.norm(apply(T_end, points) - apply(T_start, points), axis=1).max())
