"""Macros that work from the front: open and close doors and drawers, take things off shelves, put things into cavities.

All is done through physics: servos follow joint angles that bring the cup to where things are BELIEVED to be, the
wheels follow a straight line where the arm alone does not reach, and the cup holds what it truly touches. No pose and
no joint is ever set.
"""

from collections.abc import Generator

import numpy as np

from simtrack.contracts import Articulation, Float64
from simtrack.envs.actions import Outcome
from simtrack.envs.arm import RAISED
from simtrack.envs.fronts import BEFORE, COMFORT, Front, FrontReach, flat_spots, followed, turned
from simtrack.envs.macros import Held, Manipulator, Motion
from simtrack.envs.settings import CONTROL_HZ
from simtrack.geometry.transforms import apply, inverse, yaw_of
from simtrack.objects import ObjectModel
from simtrack.objects.tiago import TORSO

STEP, DEEPER = 0.008, 0.03
"""Metres that it comes nearer at a time, and beyond the believed face at which it gives up."""
EARLY = 0.035
"""Metres before a thing at which the cup cannot have met it yet."""
SPEED = 0.10
"""m/s at which what is held moves."""
LIFT, STROKE = 0.03, 0.22
"""Metres that a thing is lifted off a shelf, and that the arm pulls it out or pushes it in."""
RELEASE = 0.005
"""Metres above its place at which it is let go."""
SWEEP = 0.35
"""Metres before the place to insert something at which the arm stretches out."""
BACK = 0.12
"""Metres that the base backs off from a door that it has let go."""
DRIVE_GAIN, DRIVE_LIMIT = 1.5, 0.25
"""1/s and m/s: how the wheels follow."""
AIMS = np.deg2rad([0, 8, -8, 16, -16, 24, -24])
"""Directions, off the robot's heading, from which a thing is taken."""
STRAIGHT = 12
"""Steps of a straight stroke of the arm."""


def articulate(m: Manipulator, articulation: Articulation, position: float, goal: float) -> Motion:
    """Move a joint from where it is believed to be to a goal, rad or m."""
    front, reach = Front(articulation), FrontReach(m.arm)
    spot = front.spot(COMFORT + m.torso())
    if spot is None:
        return m.refuse(Outcome.NO_SPOT)
    start = m.T_map_base
    place, inwards = _in_base(m, *front.at(spot, position))
    begun = reach.approach(place, inwards, m.torso())
    if begun is None or reach.follows(front, spot, (position, goal), start, m.torso()) is None:
        return m.refuse(Outcome.OUT_OF_REACH)
    above, _, direction = begun
    lean = float(np.arctan2(np.cross(inwards, direction)[2], inwards @ direction))
    yield from m.unfold()
    yield from m.go(above)
    if not (yield from _touch(m, reach, place, direction)):
        yield from m.go(above)
        m.outcome = Outcome.MISSED
        return
    travel = float(np.linalg.norm(front.at(spot, goal)[0] - front.at(spot, position)[0]))
    if articulation.kind == "revolute":
        lever = float(np.linalg.norm(np.cross(articulation.axis, spot - articulation.anchor)))
        travel = lever * abs(goal - position)
    steps = max(1, int(np.ceil(travel / SPEED * CONTROL_HZ)))
    joints = m.joints()
    for q in [*np.linspace(position, goal, steps + 1)[1:].tolist(), *[goal] * 8]:
        _drive(m, followed(front, spot, position, q, start))
        place, inwards = _in_base(m, *front.at(spot, q))
        wanted = _nearest_lean(reach, place, inwards, m.torso(), joints, lean)
        if wanted is not None:
            joints, lean = wanted
            m.follow(joints)
        yield
        if m.cup.check() is None:
            yield from _back_off(m, BACK)
            yield from m.go(RAISED)
            m.outcome = Outcome.SLIPPED
            return
    m.cup.open()
    yield from m.wait(2)
    yield from _back_off(m, BACK)
    yield from m.go(RAISED)
    m.outcome = Outcome.DONE


def take(m: Manipulator, model: ObjectModel, T_map_object: Float64) -> Motion:
    """Take a thing from the front, lift it, and draw it back."""
    reach, torso = FrontReach(m.arm), m.torso()
    found = _hold(m, reach, model, T_map_object)
    if found is None:
        return m.refuse(Outcome.OUT_OF_REACH)
    place, direction = found
    before = reach.joints(place - BEFORE * direction, direction, torso, level=True)
    if before is None:
        return m.refuse(Outcome.OUT_OF_REACH)
    yield from m.unfold()
    yield from m.go(before)
    if not (yield from _touch(m, reach, place, direction, level=True)):
        yield from m.go(before)
        m.outcome = Outcome.MISSED
        return
    T_base_cup = m.arm.cup({**m.joints(), TORSO: torso})
    T_map_cup = m.T_map_base @ T_base_cup
    yaw = yaw_of(m.T_map_base) + float(np.arctan2(T_base_cup[1, 1], T_base_cup[0, 1]))
    m.held = Held(model.name, T_map_object.copy(), T_map_cup[:3, 3].copy(), yaw, inverse(T_map_cup) @ T_map_object)
    at = T_base_cup[:3, 3]
    lifted = at + (0.0, 0.0, LIFT)
    yield from _stroke(m, reach, at, lifted, direction)
    yield from _stroke(m, reach, lifted, lifted - STROKE * direction, direction)
    m.outcome = Outcome.DONE


def insert(m: Manipulator, place: Float64) -> Motion:
    """Put what is held to a place (3,) of its origin, map frame: straight in, down, and back without it.

    The arm stretches out some way before it, and the base carries it there: on its way a hand sweeps through a part of
    what it is to reach into, and would push that away.
    """
    start = m.T_map_base.copy()
    begun = _insertion(m, place)
    if begun is None:
        return m.refuse(Outcome.OUT_OF_REACH)
    yield from _back_off(m, SWEEP)
    yield from m.go(begun[2])
    for _ in range(60):
        if float((start[:2, 3] - m.T_map_base[:2, 3]) @ m.T_map_base[:2, 0]) < 0.01:
            break
        _drive(m, start)
        yield
    yield from m.wait(3)
    best = _insertion(m, place)
    if best is None:
        return m.refuse(Outcome.OUT_OF_REACH)
    reach = FrontReach(m.arm)
    wanted, direction, outside = best
    high = wanted + (0.0, 0.0, LIFT)
    yield from m.go(outside)
    yield from _stroke(m, reach, high - STROKE * direction, high, direction)
    yield from _stroke(m, reach, high, wanted + (0.0, 0.0, RELEASE), direction)
    yield from m.wait(3)
    m.cup.open()
    m.held = None
    yield from m.wait(2)
    low = wanted + (0.0, 0.0, RELEASE)
    yield from _stroke(m, reach, low, low - STROKE * direction, direction)
    m.outcome = Outcome.DONE


def _insertion(m: Manipulator, place: Float64) -> tuple[Float64, Float64, dict[str, float]] | None:
    """Where the cup has to be, base frame, in which direction, and the joint angles `STROKE` before that."""
    assert m.held is not None
    reach, torso = FrontReach(m.arm), m.torso()
    ahead = np.array([1.0, 0.0, 0.0])
    T_cup_object = m.held.T_cup_object
    for angle in AIMS.tolist():
        direction = turned(ahead, angle)
        wanted = apply(inverse(m.T_map_base), place[None])[0] - _level(direction) @ T_cup_object[:3, 3]
        inside = reach.joints(wanted + (0.0, 0.0, LIFT), direction, torso, level=True)
        outside = reach.joints(wanted - STROKE * direction + (0.0, 0.0, LIFT), direction, torso, level=True)
        if inside is not None and outside is not None:
            return wanted, direction, outside
    return None


# ------------------------------------------------------------------------------------------------------------- motions


def _touch(
    m: Manipulator, reach: FrontReach, place: Float64, direction: Float64, *, level: bool = False
) -> Generator[None, None, bool]:
    """Approach a face until the cup has hold of something; returns whether it has.

    A `level` cup takes things: what it meets long before the thing is to come is something else, and is let go.
    """
    for gap in np.arange(BEFORE - STEP, -DEEPER, -STEP).tolist():
        joints = reach.joints(place - gap * direction, direction, m.torso(), m.joints(), level)
        if joints is None:
            continue
        yield from m.go(joints)
        if m.cup.close() is not None:
            if level and gap > EARLY:
                m.cup.open()
                return False
            return True
    return False


def _stroke(m: Manipulator, reach: FrontReach, begin: Float64, end: Float64, direction: Float64) -> Motion:
    """Move the cup straight; where the arm's reach ends, so does the stroke."""
    steps = max(2, int(np.ceil(float(np.linalg.norm(end - begin)) / SPEED * CONTROL_HZ)))
    joints = m.joints()
    for share in np.linspace(0.0, 1.0, steps + 1)[1:].tolist():
        wanted = reach.joints(begin + share * (end - begin), direction, m.torso(), joints, level=True)
        if wanted is None:
            break
        joints = wanted
        m.follow(joints)
        yield
    yield from m.go(joints)


def _back_off(m: Manipulator, distance: float) -> Motion:
    begin = m.T_map_base[:2, 3].copy()
    for _ in range(40):
        if float(np.linalg.norm(m.T_map_base[:2, 3] - begin)) >= distance:
            break
        m.drive = -0.15
        yield
    yield from m.wait(3)


def _drive(m: Manipulator, T_map_wanted: Float64) -> None:
    """Let the wheels go towards a place that lies straight ahead or behind."""
    gap = float((T_map_wanted[:2, 3] - m.T_map_base[:2, 3]) @ m.T_map_base[:2, 0])
    m.drive = float(np.clip(DRIVE_GAIN * gap * 2.0, -DRIVE_LIMIT, DRIVE_LIMIT))


def _in_base(m: Manipulator, place: Float64, direction: Float64) -> tuple[Float64, Float64]:
    T = inverse(m.T_map_base)
    return apply(T, place[None])[0], T[:3, :3] @ direction


def _nearest_lean(
    reach: FrontReach, place: Float64, inwards: Float64, torso: float, joints: dict[str, float], lean: float
) -> tuple[dict[str, float], float] | None:
    """Joint angles near the present ones, with the cup leaning about as it does, but no more than it must."""
    for change in np.deg2rad([0.0, 3.0, 6.0, 10.0, 15.0, 25.0]).tolist():
        for sign in (-np.sign(lean) or 1.0, np.sign(lean) or -1.0):
            offset = float(np.clip(lean + sign * change, -np.deg2rad(60.0), np.deg2rad(60.0)))
            found = reach.joints(place, turned(inwards, offset), torso, joints)
            if found is not None:
                return found, offset
    return None


def _hold(
    m: Manipulator, reach: FrontReach, model: ObjectModel, T_map_object: Float64
) -> tuple[Float64, Float64] | None:
    """(3,) place and (3,) direction, base frame, from which the cup finds hold of a thing, near its centre of mass."""
    T_base_object = inverse(m.T_map_base) @ T_map_object
    vertices = apply(T_base_object, model.mesh.vertices)
    centre = apply(T_base_object, model.centre_of_mass[None])[0]
    for angle in AIMS.tolist():
        direction = turned(np.array([1.0, 0.0, 0.0]), angle)
        spots = flat_spots(vertices, model.mesh.faces, direction, 0.008)
        across = np.linalg.norm(np.cross(spots - centre, direction), axis=1)
        for k in np.argsort(across)[:4].tolist():
            if reach.joints(spots[k], direction, m.torso(), level=True) is not None:
                return spots[k], direction
    return None


def _level(direction: Float64) -> Float64:
    """(3, 3) axes of a cup that looks along a horizontal direction with z up."""
    return np.stack([direction, [-direction[1], direction[0], 0.0], [0.0, 0.0, 1.0]], axis=1)
