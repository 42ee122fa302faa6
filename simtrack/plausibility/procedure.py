"""The check itself, the same for every engine: settle under gravity, then move each joint through its range."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from simtrack.contracts import Float64
from simtrack.geometry.transforms import apply, transform
from simtrack.perception.reconstruction.body_tree import Body, BodyTree, Component, Shape, collision_points, standing_on
from simtrack.plausibility.engine import Engine, Proximity
from simtrack.plausibility.verdict import BodyResult, CheckConfig, EngineResult, Finding, JointResult

SEARCH = (0.02, 0.2, 2.0)
"""Metres in which something below a body is looked for, the next only if the one before finds nothing."""
TOUCHING = 1e-5
"""Metres below which bodies touch, and the direction between their nearest points says nothing."""
GROUND = "ground"
LAST = 0.25
"""Seconds at the end in which a body at rest moves less than `STILL`."""
STILL = 0.0005
FALL = 0.5
"""Metres by which a body must sink to count as fallen."""
ASTRAY = 1e-3
"""Metres that a joint may lead a body away from where the description has it."""


@dataclass(frozen=True, slots=True)
class Prepared:
    """A tree that an engine can settle, and what had to be said about it."""

    tree: BodyTree
    findings: tuple[Finding, ...]


def prepare(tree: BodyTree) -> Prepared:
    """Put a URDF of a lone object or robot on a ground plane, and say what is static and what lacks."""
    findings = []
    poses = tree.forward()
    static = [component for component in tree.components if component.static]
    if not tree.components[0].static:
        points = collision_points(tree.bodies, poses)
        if not len(points):
            findings.append(Finding("problem", "no-collision", tree.name, "nothing in it collides"))
            return Prepared(tree, tuple(findings))
        name = GROUND if GROUND not in tree.by_name else f"{GROUND}/{tree.name}"
        size = (100.0, 100.0, 1.0)
        shape = Shape("box", size, T_body_shape=transform(None, (0.0, 0.0, -0.5)))
        low = float(points[:, 2].min())
        tree = standing_on(Body(name, collision=(shape,), friction=0.5), tree, transform(None, (0.0, 0.0, -low)))
        message = "the root is free: its lowest point is put on a level ground"
        findings.append(Finding("note", "ground", tree.name, message))
    elif len(static) < len(tree.components) and not any(body.collision for part in static for body in part.bodies):
        message = "there is no floor: nothing that is static collides, so everything falls"
        findings.append(Finding("problem", "no-floor", tree.name, message))
    for component in static:
        if component.name != GROUND:
            message = "has no mass: static, it cannot fall or move as a whole"
            findings.append(Finding("note", "static", component.name, message))
    for component in tree.components:
        if not component.static and not any(body.collision for body in component.bodies):
            message = "is free but nothing of it collides: it falls through everything"
            findings.append(Finding("problem", "no-collision", component.name, message))
    return Prepared(tree, tuple(findings))


def examine(
    engine: Engine, config: CheckConfig, say: Callable[[str], None], picture: Callable[[str], None]
) -> EngineResult:
    """Settle, then sweep; `say` hears what is being done, `picture` is called before and after settling."""
    picture("before")
    say("settling")
    bodies = settle(engine, config)
    picture("after")
    say("moving the joints")
    joints = sweep(engine, config)
    plausible = not any(result.problems for result in (*bodies, *joints))
    inside = overlaps_inside(engine, config)
    return EngineResult(engine.name, engine.version, engine.margin, bodies, joints, plausible, inside)


def settle(engine: Engine, config: CheckConfig) -> tuple[BodyResult, ...]:
    """Let the scene settle for `config.duration` seconds; one result a component."""
    tree = engine.tree
    owner = {body.name: part.name for part in tree.components for body in part.bodies}
    engine.reset()
    start = engine.poses()
    overlaps_start = _overlaps(engine.proximities(0.0), owner)
    gaps = {part.name: _gap(engine, part, owner) for part in tree.components if not part.static}
    engine.reset()
    engine.step(max(config.duration - LAST, 0.0))
    late = engine.poses()
    engine.step(LAST)
    end = engine.poses()
    overlaps_end = _overlaps(engine.proximities(0.0), owner)
    return tuple(
        _judge(part, config, (start, late, end), (overlaps_start, overlaps_end), gaps.get(part.name))
        for part in tree.components
    )


def _overlaps(pairs: Sequence[Proximity], owner: dict[str, str]) -> dict[str, float]:
    """Component -> deepest overlap with another component, metres."""
    deepest: dict[str, float] = {}
    for pair in pairs:
        a, b = owner[pair.body_a], owner[pair.body_b]
        if a != b:
            for name in (a, b):
                deepest[name] = max(deepest.get(name, 0.0), -pair.distance)
    return deepest


def overlaps_inside(engine: Engine, config: CheckConfig) -> tuple[tuple[str, str, float], ...]:
    """Pairs of objects of one component that are in each other as described, and how deep, metres, deepest first.

    They cannot push each other apart, so that settling shows nothing of it: cupboards that are fixed to the floor, say.
    Left out are what a joint connects (doors overlap their frames at the hinge), and pairs without any mass: walls.
    """
    tree = engine.tree
    owner = {body.name: part.name for part in tree.components for body in part.bodies}
    groups: dict[str, str] = {}
    for body in tree.bodies:  # fixed joints tie an object together, but to what has no mass they only hold it
        tied = body.joint is not None and body.joint.kind == "fixed" and tree.by_name[body.joint.parent].mass > 0.0
        groups[body.name] = groups[body.joint.parent] if body.joint is not None and tied else body.name
    joined = {frozenset((groups[body.name], groups[body.joint.parent])) for body in tree.bodies if body.joint}
    deepest: dict[tuple[str, str], float] = {}
    engine.reset()
    for pair in engine.proximities(0.0):
        a, b = sorted((groups[pair.body_a], groups[pair.body_b]))
        scenery = tree.by_name[pair.body_a].mass == tree.by_name[pair.body_b].mass == 0.0
        if owner[a] != owner[b] or a == b or frozenset((a, b)) in joined or scenery:
            continue
        if -pair.distance > config.penetration:
            deepest[a, b] = max(deepest.get((a, b), 0.0), -pair.distance)
    return tuple((a, b, depth) for (a, b), depth in sorted(deepest.items(), key=lambda item: -item[1]))


def _gap(engine: Engine, part: Component, owner: dict[str, str]) -> float | None:
    """Metres from a component to what is below it, or to the nearest thing if nothing is below it."""
    own = {body.name for body in part.bodies}
    nearest: float | None = None
    for radius in SEARCH:
        below, around = np.inf, np.inf
        for pair in engine.proximities(radius, own):
            if owner[pair.body_a] == owner[pair.body_b]:
                continue
            up = pair.up if pair.body_a in own else -pair.up
            around = min(around, pair.distance)
            if up > 0.1 or pair.distance < TOUCHING:
                below = min(below, pair.distance)
        if np.isfinite(below):
            return max(0.0, below)
        if nearest is None and np.isfinite(around):
            nearest = max(0.0, around)
    return nearest


def _judge(
    part: Component,
    config: CheckConfig,
    poses: tuple[dict[str, Float64], dict[str, Float64], dict[str, Float64]],
    overlaps: tuple[dict[str, float], dict[str, float]],
    gap: float | None,
) -> BodyResult:
    root = part.bodies[0]
    assert root.centre_of_mass is not None
    T_start, T_late, T_end = (frame[root.name] for frame in poses)
    centre_start, centre_late, centre_end = (apply(T, root.centre_of_mass[None])[0] for T in (T_start, T_late, T_end))
    finite = bool(np.isfinite(T_end).all())
    drift = float(np.linalg.norm(centre_end - centre_start)) if finite else np.inf
    up = T_end[:3, :3] @ T_start[2, :3] if finite else np.array([0.0, 0.0, -1.0])
    tilt = float(np.arccos(np.clip(up[2], -1.0, 1.0)))
    first, last = overlaps[0].get(part.name, 0.0), overlaps[1].get(part.name, 0.0)
    problems: list[str] = []
    if not part.static:
        if finite and centre_start[2] - centre_end[2] > FALL:
            problems.append("fell")
        if drift > config.drift:
            problems.append("drifted")
        if tilt > config.toppled:
            problems.append("toppled")
        elif tilt > config.tilt:
            problems.append("tilted")
        if gap is None or gap > config.gap:
            problems.append("floating")
        if max(first, last) > config.penetration:
            problems.append("penetrating")
    return BodyResult(
        name=part.name,
        support=part.support,
        static=part.static,
        drift=min(drift, 1e9),
        tilt=tilt,
        penetration_start=first,
        penetration_end=last,
        gap=gap,
        resting=finite and float(np.linalg.norm(centre_end - centre_late)) < STILL,
        problems=tuple(problems),
    )


def sweep(engine: Engine, config: CheckConfig) -> tuple[JointResult, ...]:
    """Move each joint through its range, the others at rest, and look what the moved part runs into."""
    engine.reset()
    rest = {_key(pair): -pair.distance for pair in engine.proximities(0.0)}
    return tuple(_sweep_joint(engine, body, rest, config) for body in engine.tree.joints.values())


def _key(pair: Proximity) -> frozenset[str]:
    return frozenset((pair.body_a, pair.body_b))


def _sweep_joint(engine: Engine, body: Body, rest: dict[frozenset[str], float], config: CheckConfig) -> JointResult:
    tree, joint = engine.tree, body.joint
    assert joint is not None
    lower, upper = (-np.pi, np.pi) if joint.kind == "continuous" else (joint.lower, joint.upper)
    moved, mechanism = tree.below(body.name), tree.mechanism(body.name)
    groups = tree.rigid_groups()
    own = {name for name, group in groups.items() if group == groups[joint.parent]}
    loose = {each.name for part in tree.components if not part.static for each in part.bodies} - moved - own
    positions = np.linspace(lower, upper, config.sweep_steps)
    start = min(max(0.0, lower), upper)
    # outwards from the rest position, so that the first collision on each side bounds what can be reached
    order = [positions[positions >= start], positions[positions < start][::-1]]
    met: dict[str, float] = {}
    follows, reachable, alone, drives = 0.0, 0.0, 0.0, False
    for side, end in zip(order, (upper, lower), strict=True):
        way, way_alone = _Way(start), _Way(start)
        for position in side:
            engine.place({joint.name: float(position)})
            described = tree.forward({joint.name: float(position)})[body.name]
            follows = max(follows, _distance(engine.poses()[body.name], described, body))
            entered = _entered(engine, moved, loose, rest, config.sweep_penetration)
            for name, depth in sorted(entered.items(), key=lambda item: -item[1]):
                met[name] = max(met.get(name, 0.0), depth)
            drives = drives or not own.isdisjoint(entered)
            way.passes(float(position), not entered)
            way_alone.passes(float(position), mechanism.isdisjoint(entered))
        reachable += way.length(end)
        alone += way_alone.length(end)
    engine.reset()
    span = upper - lower
    reached, reached_alone = (min(1.0, part / span) if span > 0.0 else 1.0 for part in (reachable, alone))
    problems = {
        "drives-into-body": drives,
        "unreachable": reached_alone < config.least_range,
        "astray": follows > ASTRAY,
    }
    return JointResult(
        name=joint.name,
        body=body.name,
        lower=float(lower),
        upper=float(upper),
        reached=float(reached),
        reached_alone=float(reached_alone),
        blocked_by=next(iter(met), None),
        depth=float(max(met.values(), default=0.0)),
        follows=float(follows),
        problems=tuple(problem for problem, found in problems.items() if found),
    )


class _Way:
    """How far a joint goes to one side before it is blocked."""

    def __init__(self, start: float) -> None:
        self.start = self.last = start
        self.blocked = False

    def passes(self, position: float, free: bool) -> None:
        """The next position outwards, and whether it can be taken."""
        self.blocked = self.blocked or not free
        if not self.blocked:
            self.last = position

    def length(self, end: float) -> float:
        """Radians or metres of the way to the end of the range that are free."""
        return abs((self.last if self.blocked else end) - self.start)


def _entered(
    engine: Engine, moved: frozenset[str], loose: set[str], rest: dict[frozenset[str], float], least: float
) -> dict[str, float]:
    """Bodies that what is moved has entered -> metres beyond the overlap at rest; those that are loose give way."""
    entered: dict[str, float] = {}
    for pair in engine.proximities(0.0, moved):
        if (pair.body_a in moved) == (pair.body_b in moved):
            continue
        other = pair.body_b if pair.body_a in moved else pair.body_a
        excess = -pair.distance - max(0.0, rest.get(_key(pair), 0.0))
        if excess > least and other not in loose:
            entered[other] = max(excess, entered.get(other, 0.0))
    return entered


def _distance(T_a: Float64, T_b: Float64, body: Body) -> float:
    """Largest distance of a point of the body between two poses, metres."""
    points = collision_points([body], {body.name: np.eye(4)})
    points = points if len(points) else np.eye(3)
    return float(np.linalg.norm(apply(T_a, points) - apply(T_b, points), axis=1).max())
