"""What the hand does: picks, carries, puts down and pushes objects as the scene's script says."""

from collections.abc import Callable, Iterator
from functools import partial
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from simtrack.contracts import Float64
from simtrack.errors import FileFormatError, SimtrackError
from simtrack.geometry.transforms import difference, exp_so3, inverse, perturb, quaternion_from_rotation, transform
from simtrack.simulation import hand
from simtrack.simulation.hand import HandPose
from simtrack.simulation.placement import Area, Outline, is_free, outline, support_area
from simtrack.simulation.scene_file import Carry, Push, Retreat, Target, Wait
from simtrack.simulation.world import HAND_BITS, TIMESTEP_NS, World, body_pose

if TYPE_CHECKING:
    import mujoco

Motion: TypeAlias = Iterator[HandPose | Callable[[], HandPose]]
"""One pose for each physics step, or how it is worked out if it is wanted."""

DT = TIMESTEP_NS * 1e-9
PEAK = 1.875
"""Peak over mean speed of a minimum-jerk motion (Flash and Hogan, 1985)."""
REACH_SPEED, REACH_RATE = 1.5, 4.0
"""Peak speed (m/s) and turning rate (rad/s) of the empty hand."""
GENTLE = 0.4
"""Peak speed near things, m/s."""
HOVER = 0.14
"""Metres above a thing from which the hand comes down to it."""
GRIP_DEPTH = 0.055
"""Metres below the top of a thing that the finger tips reach."""
CLEAR = 0.06
"""Metres that a thing keeps from others when it is put down."""
TRIES = 200
SIDES = np.array(hand.SIDES)[:, None]
INNER = 0.76
"""Share of a container's width that is taken for its clear inside."""


def minimum_jerk(share: float) -> float:
    """Position 0 to 1 on a minimum-jerk path at a share 0 to 1 of its duration."""
    return share**3 * (10.0 - 15.0 * share + 6.0 * share**2)


class HandDirector:
    """Plays the script of a scene, over and over; plans each action from where things really are when it begins.

    An action that cannot be done (its object has fallen over, there is no free place) is left out.
    """

    def __init__(self, world: World, rng: np.random.Generator) -> None:
        """Check the script against the world.

        Raises:
            FileFormatError: it names a support that does not exist.
        """
        assert world.scene.hand is not None
        self._world, self._rng = world, rng
        self._settings = world.scene.hand
        self._model, self._data = world.model, world.data
        for k, action in enumerate(self._settings.script):
            if isinstance(action, Carry) and action.to.on is not None:
                try:
                    self._area(action.to)
                except SimtrackError as error:
                    raise FileFormatError(world.scene.path, f"hand.script.{k}.to", str(error)) from error
        mocap = [int(self._model.body(name).mocapid[0]) for name in hand.PARTS]
        self._mocap = slice(mocap[0], mocap[-1] + 1)  # one after the other: they are made together
        self._contacts = [g for g in range(self._model.ngeom) if self._model.geom(g).name.startswith("hand/contact")]
        self._faces = [
            Area(part.T_map_part @ T, (0.0, 0.0), (0.0, 0.0), np.asarray(size, dtype=float))
            for part in world.static.parts
            for T, size in part.supports
        ]
        rest = np.array(self._settings.rest)
        centre = np.mean([body_pose(self._data, world.bodies[name])[:2, 3] for name in world.objects], axis=0)
        self._rest_yaw = float(np.arctan2(centre[1] - rest[1], centre[0] - rest[0]))
        self._pose = HandPose(transform(_yawed(self._rest_yaw), rest), 0.06)
        self._motion = self._play()
        self._touch(False)
        self._apply(self._data)

    @property
    def pose(self) -> HandPose:
        """Where the hand is now."""
        return self._pose

    def step(self, data: "mujoco.MjData", steps: int = 1) -> None:
        """Move the hand on by so many physics steps."""
        for _ in range(steps - 1):
            next(self._motion)
        pose = _made(next(self._motion))
        if pose is not self._pose:
            self._pose = pose
            self._apply(data)

    def _apply(self, data: "mujoco.MjData") -> None:
        T = self._pose.T_map_hand
        data.mocap_quat[self._mocap] = quaternion_from_rotation(T[:3, :3])
        data.mocap_pos[self._mocap] = T[:3, 3] + SIDES * (self._pose.opening / 2 * T[:3, 0])

    # ------------------------------------------------------------------------------------------------------- the script

    def _play(self) -> Motion:
        while True:
            for action in self._settings.script:
                if isinstance(action, Wait):
                    yield from self._wait(self._rng.uniform(*action.seconds))
                elif isinstance(action, Retreat):
                    yield from self._retreat()
                elif isinstance(action, Carry):
                    yield from self._carry(action)
                elif isinstance(action, Push):
                    yield from self._push(action)
            yield self._pose  # a script that does nothing must not stop the clock

    def _wait(self, seconds: float) -> Motion:
        for _ in range(round(seconds / DT)):
            yield self._pose

    def _retreat(self) -> Motion:
        yield from self._move(transform(_yawed(self._rest_yaw), self._settings.rest), 0.06, REACH_SPEED)

    def _move(self, T: Float64, opening: float, speed: float, rate: float = REACH_RATE) -> Motion:
        """Straight to a pose, with minimum jerk and a peak speed in m/s."""
        start = self._pose
        way = float(np.linalg.norm(T[:3, 3] - start.T_map_hand[:3, 3]))
        turn = float(np.arccos(np.clip((np.trace(T[:3, :3].T @ start.T_map_hand[:3, :3]) - 1.0) / 2.0, -1.0, 1.0)))
        seconds = max(PEAK * way / speed, PEAK * turn / rate, PEAK * abs(opening - start.opening) / 0.3, DT)
        steps = int(np.ceil(seconds / DT))
        course = difference(T, start.T_map_hand)

        def pose(share: float) -> HandPose:
            s = minimum_jerk(share)
            return HandPose(perturb(start.T_map_hand, s * course), start.opening + s * (opening - start.opening))

        for k in range(1, steps + 1):
            yield partial(pose, k / steps)

    # ------------------------------------------------------------------------------------------------------------ carry

    def _carry(self, action: Carry) -> Motion:
        name = action.object
        T_object = self._object(name)
        extents = self._world.objects[name].extents
        box = outline(extents, T_object)
        if T_object[2, 2] < 0.8 or min(box.half) > hand.MAX_OPENING:
            return
        T_grip, width = self._grip(box)
        plan = self._plan(action, T_object, T_grip)
        if plan is None:
            return
        T_down, turn = plan
        yield from self._approach(T_grip, min(width + 0.03, hand.MAX_OPENING))
        yield from self._move(T_grip, width, GENTLE)
        self._hold(name)
        T_object = self._object(name)
        height = self._rng.uniform(*action.height)
        top = max(T_grip[2, 3], T_down[2, 3]) + height
        yield from self._move(_raised(T_grip, top), width, GENTLE)
        yield from self._transport(_raised(T_down, top), turn, action, width)
        yield from self._put_down(T_down, width, name)
        self._release(name)
        T_down = self._pose.T_map_hand
        yield from self._move(T_down, min(width + 0.03, hand.MAX_OPENING), GENTLE)
        yield from self._move(_raised(T_down, T_down[2, 3] + HOVER), 0.06, 2 * GENTLE)

    def _put_down(self, T: Float64, opening: float, name: str) -> Motion:
        """Down until the thing touches something, then hold still for a moment."""
        for course in self._move(T, opening, GENTLE):
            pose = _made(course)
            yield pose
            if pose.T_map_hand[2, 3] - T[2, 3] < 0.03 and self._touches(name):
                break
        yield from self._wait(0.15)

    def _grip(self, box: Outline) -> tuple[Float64, float]:
        """Pose of the hand that grips a thing across its narrow side, forearm towards the rest place; its opening."""
        narrow = 0 if box.half[0] <= box.half[1] else 1
        yaw = box.yaw + narrow * np.pi / 2
        if np.cos(yaw - self._rest_yaw) < 0.0:
            yaw += np.pi
        tip = max(box.bottom + 0.006, box.top - GRIP_DEPTH)
        T = transform(_yawed(yaw), (box.x, box.y, tip))
        return T, float(min(2.0 * box.half[narrow], hand.MAX_OPENING))

    def _plan(self, action: Carry, T_object: Float64, T_grip: Float64) -> tuple[Float64, float] | None:
        """Pose of the hand when it lets go, and the turn about the vertical until then; None if there is no place."""
        extents = self._world.objects[action.object].extents
        others = self._others(action.object, action.to.into)
        for _ in range(TRIES):
            turn = self._turn(action, T_grip)
            spot = self._spot(action.to, T_object, extents, turn)
            if spot is None:
                continue
            if is_free(outline(extents, spot), others, CLEAR):
                T_down = transform(_yawed(turn) @ T_grip[:3, :3])
                T_down[:3, 3] = spot[:3, 3] + _yawed(turn) @ (T_grip[:3, 3] - T_object[:3, 3])
                return T_down, turn
        return None

    def _turn(self, action: Carry, T_grip: Float64) -> float:
        """A turn that leaves the forearm on the side that it comes from."""
        turn = self._rng.uniform(-2.0, 2.0)
        yaw = float(np.arctan2(T_grip[1, 0], T_grip[0, 0])) - self._rest_yaw + turn
        return turn if abs(np.arctan2(np.sin(yaw), np.cos(yaw))) < 1.6 else 0.3 * turn

    def _spot(self, to: Target, T_object: Float64, extents: Float64, turn: float) -> Float64 | None:
        """Pose of the object when it is let go, or None if this draw does not fit."""
        R = _yawed(turn) @ T_object[:3, :3]
        lift = float(np.abs(R[2]) @ extents) / 2
        if to.into is not None:
            T_container, container = self._object(to.into), self._world.objects[to.into]
            relative = T_container[:3, :3].T @ R
            room = INNER * container.extents[:2] - np.abs(relative[:2]) @ extents
            if T_container[2, 2] < 0.95 or np.any(room < 0.0):
                return None
            offset = np.append(self._rng.uniform(-room / 2, room / 2), -container.extents[2] / 2)
            floor = T_container[:3, 3] + T_container[:3, :3] @ offset
            return transform(R, floor + np.array([0.0, 0.0, lift]))
        area = self._area(to)
        local = np.array([self._rng.uniform(*area.x), self._rng.uniform(*area.y), 0.0])
        reach = np.abs((area.T_map_face[:3, :3].T @ R)[:2]) @ extents / 2
        if np.any(np.abs(local[:2]) + reach > area.size / 2 - 0.02):
            return None
        face = area.T_map_face[:3, 3] + area.T_map_face[:3, :3] @ local
        return transform(R, face + np.array([0.0, 0.0, lift - 0.002]))

    def _transport(self, T: Float64, turn: float, action: Carry, opening: float) -> Motion:
        """Across to above the target: turning about the vertical and tilting on the way, upright at both ends."""
        start = self._pose.T_map_hand
        way = float(np.linalg.norm(T[:3, 3] - start[:3, 3]))
        heading = self._rng.uniform(-np.pi, np.pi)
        axis = np.array([np.cos(heading), np.sin(heading), 0.0])
        tilt = self._rng.uniform(*action.tilt)
        share = np.linspace(0.0, 1.0, 101)
        slope = 30.0 * share**2 * (1.0 - share) ** 2  # of the minimum-jerk path
        tilting = np.pi * tilt * np.sin(2.0 * np.pi * np.array([minimum_jerk(x) for x in share]))
        spin = float(np.max(slope * np.hypot(turn, tilting)))
        seconds = max(PEAK * way / action.speed, spin / max(action.turn_rate, 0.1), 0.4)
        steps = int(np.ceil(seconds / DT))

        def pose(share: float) -> HandPose:
            s = minimum_jerk(share)
            R = exp_so3(tilt * np.sin(np.pi * s) ** 2 * axis) @ _yawed(s * turn) @ start[:3, :3]
            return HandPose(transform(R, start[:3, 3] + s * (T[:3, 3] - start[:3, 3])), opening)

        for k in range(1, steps + 1):
            yield partial(pose, k / steps)

    # ------------------------------------------------------------------------------------------------------------- push

    def _push(self, action: Push) -> Motion:
        name = action.object
        box = outline(self._world.objects[name].extents, self._object(name))
        course = self._course(action, box)
        if course is None:
            return
        yaw, distance = course
        direction = np.array([np.cos(yaw), np.sin(yaw), 0.0])
        opening = 0.02
        # The outside of the fingers starts two centimetres behind the thing.
        behind = _reach(box, yaw) + 0.02 + hand.FINGER_FRONT + opening / 2
        start = transform(_yawed(yaw), np.array([box.x, box.y, box.bottom + 0.012]) - behind * direction)
        end = start.copy()
        end[:3, 3] += (distance + 0.02) * direction
        yield from self._approach(start, opening)
        yield from self._move(start, opening, GENTLE)
        self._touch(True)
        yield from self._move(end, opening, action.speed)
        self._touch(False)
        yield from self._move(start, opening, GENTLE)
        yield from self._move(_raised(start, start[2, 3] + HOVER), 0.06, 2 * GENTLE)

    def _course(self, action: Push, box: Outline) -> tuple[float, float] | None:
        """Heading and distance of a push that ends on the same support, nothing in the way; None if there is none."""
        others = self._others(action.object, None)
        for _ in range(TRIES):
            yaw = float(self._rest_yaw + self._rng.uniform(-1.9, 1.9))
            distance = float(self._rng.uniform(*action.distance))
            c, s = np.cos(yaw), np.sin(yaw)
            path = [
                Outline(box.x + d * c, box.y + d * s, box.yaw, box.half, box.bottom, box.top)
                for d in (0.5 * distance, distance, distance + 0.03)
            ]
            back = _reach(box, yaw) + 0.06
            fingers = Outline(box.x - back * c, box.y - back * s, yaw, (0.06, 0.05), box.bottom, box.top)
            clear = all(is_free(place, others, 0.02) for place in path) and is_free(fingers, others, 0.0)
            if clear and any(_stands_on(path[-1], face) for face in self._faces):
                return yaw, distance
        return None

    # ---------------------------------------------------------------------------------------------------- what it knows

    def _approach(self, T: Float64, opening: float) -> Motion:
        """From wherever the hand is to above a pose, over the heads of the things."""
        yield from self._move(_raised(T, T[2, 3] + HOVER), opening, REACH_SPEED)

    def _area(self, to: Target) -> Area:
        assert to.on is not None
        return support_area(self._world.static, to.on, to.face, to.x, to.y)

    def _object(self, name: str) -> Float64:
        return body_pose(self._data, self._world.bodies[name])

    def _others(self, name: str, container: str | None) -> list[Outline]:
        return [
            outline(model.extents, self._object(other))
            for other, model in self._world.objects.items()
            if other not in (name, container)
        ]

    def _hold(self, name: str) -> None:
        """Weld the object to the palm as it is now."""
        weld = self._model.equality(f"grip/{name}").id
        palm = self._pose.T_map_hand
        T_palm_object = inverse(palm) @ self._object(name)
        self._model.eq_data[weld, 0:3] = 0.0
        self._model.eq_data[weld, 3:6] = T_palm_object[:3, 3]
        self._model.eq_data[weld, 6:10] = quaternion_from_rotation(T_palm_object[:3, :3])
        self._data.eq_active[weld] = 1

    def _release(self, name: str) -> None:
        self._data.eq_active[self._model.equality(f"grip/{name}").id] = 0

    def _touches(self, name: str) -> bool:
        """Whether a thing is in contact with anything."""
        contact, body = self._data.contact, self._world.bodies[name]
        bodies = self._model.geom_bodyid[contact.geom]
        return bool(np.any((bodies == body).any(axis=1) & (contact.dist <= 0.0)))

    def _touch(self, on: bool) -> None:
        """Let the fingers make contact, for pushes only: a grip is a weld, not a squeeze."""
        self._model.geom_contype[self._contacts] = HAND_BITS[0] if on else 0


def _made(pose: HandPose | Callable[[], HandPose]) -> HandPose:
    return pose if isinstance(pose, HandPose) else pose()


def _yawed(yaw: float) -> Float64:
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _raised(T: Float64, z: float) -> Float64:
    out = T.copy()
    out[2, 3] = z
    return out


def _reach(box: Outline, yaw: float) -> float:
    """Metres from the centre of an outline to its edge along a heading, at most to its supporting line."""
    turn = yaw - box.yaw
    along = (abs(np.cos(turn)) / max(box.half[0], 1e-9), abs(np.sin(turn)) / max(box.half[1], 1e-9))
    return float(1.0 / max(*along, 1e-9))


def _stands_on(box: Outline, face: Area) -> bool:
    """Whether an outline lies wholly on a face, with a margin from its edge."""
    if abs(box.bottom - face.T_map_face[2, 3]) > 0.02:
        return False
    corners = np.column_stack([box.corners(), np.full(4, box.bottom)]) - face.T_map_face[:3, 3]
    return bool(np.all(np.abs((corners @ face.T_map_face[:3, :3])[:, :2]) < face.size / 2 - 0.02))
