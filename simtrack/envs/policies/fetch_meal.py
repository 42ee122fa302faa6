"""Fetches a meal: opens what has to be open, takes the item, puts it in, closes. Sees beliefs and the survey only."""

from collections.abc import Generator, Iterator
from typing import Any

import numpy as np

from simtrack.contracts import NANOSECONDS, Articulation, Float32, Float64, JointEstimate, MapEntity, Track
from simtrack.envs.actions import Outcome, Request
from simtrack.envs.arm import ArmKinematics
from simtrack.envs.front_macros import LIFT, STROKE
from simtrack.envs.fronts import BEFORE, COMFORT, Front, FrontReach, followed, turned
from simtrack.envs.planning import believed
from simtrack.envs.policies import Briefing
from simtrack.envs.policies.driver import Driver, Plan, Tried
from simtrack.errors import InvalidValueError
from simtrack.geometry.transforms import apply, inverse, transform_planar
from simtrack.perception.tracking.articulation import motion

FRIDGE_OPEN, MICROWAVE_OPEN = np.deg2rad([95.0, 88.0, 82.0, 75.0]), np.deg2rad([72.0])
"""Radians, the first that the arm can do: far enough to reach in; a microwave's is pushed shut from the front."""
ENOUGH = np.deg2rad(60.0)
"""Radians from which on it is worth a try to reach into the fridge."""
NEARLY = np.deg2rad(9.0)
"""Radians off the wanted position that do not matter."""
SHUT = np.deg2rad(3.0)
"""Radians up to which a door is believed to be shut."""
AJAR = np.deg2rad(15.0)
"""Radians from which on the fridge's leaf is in the way of who drives past."""
FRESH = 1.0
"""Seconds since something was seen, up to which it counts as known."""
VIEW = 1.25
"""Metres from which something is looked at."""
TURNS = np.deg2rad([0, 15, -15, 30, -30, 45, -45])
ASIDE = (0.0, 0.2, -0.2, 0.35, -0.35)
AHEAD = (0.8, 0.75, 0.85, 0.7, 0.9, 0.65)
"""Where a thing may be from the base that the arm works on: radians off straight, metres to the left, ahead."""
LIFTS = (0.3, 0.2)
"""Metres of the torso with which doors are worked."""
ROOM = 0.29
"""Metres around the middle of the base that must be free where it stands."""
INTO = 0.075
"""Metres behind the edge of a board at which the middle of the item is put down."""
HALF_WIDTH = 0.085
"""Metres to each side of the item's middle that must be free on its way: hand and item."""
RUN_UP = 0.4
"""Metres before the place where something is inserted from which the robot drives straight."""
ELSEWHERE = 0.08
"""Metres from where something failed that are tried next."""
TRIES = 3


class FetchMealPolicy(Driver):
    """Goes through the stages of the task; what fails is tried again from elsewhere."""

    def __init__(self, briefing: Briefing, mode: str) -> None:
        super().__init__(briefing, mode)
        (self._goal,) = briefing.goals
        self._reach = FrontReach(ArmKinematics(briefing.robot))
        self._fridge = Front(_door(briefing, "fridge"))
        self._microwave = Front(_door(briefing, self._goal.reference))
        self._board = _board(briefing, self._goal.reference, self._microwave)
        self.begin(np.random.default_rng(0))

    def begin(self, rng: np.random.Generator) -> None:
        """See `simtrack.envs.policies.Policy`."""
        super().begin(rng)
        self._failed: list[Float64] = []
        self._plan = self._fetch()

    def act(self, observation: Any) -> Float32:
        """See `simtrack.envs.policies.Policy`."""
        self._sense(observation)
        return next(self._plan)

    # ----------------------------------------------------------------------------------------------------------- plans

    def _fetch(self) -> Plan:
        put = False
        while True:
            if not (self._holds or put):
                if not (yield from self._open(self._microwave, MICROWAVE_OPEN)):
                    continue
                if not (yield from self._open(self._fridge, FRIDGE_OPEN, more=True)):
                    continue
                yield from self._take()
            if self._holds:
                yield from self._insert()
                put = not self._holds and self._is_in()
            if put:
                yield from self._open(self._microwave, np.zeros(1))
            yield self._move()

    def _open(self, front: Front, angles: Float64, *, more: bool = False) -> Tried:
        """Bring a door to the first of some angles off its closed position that can be done; closes it with 0.

        With `more`, any angle from the last of them on will do, and `ENOUGH` if no more can be done.
        """
        a, angle = front.articulation, float(angles[-1])
        least, moved = min(a.lower + angle, a.upper), False
        for attempt in range(TRIES + 1):
            yield from self._see(front, move=not moved)  # going round an open door would push it
            q = self._joint(a).position
            near = SHUT if angle == 0.0 else NEARLY
            if abs(q - least) < near or (more and q > least):
                self._failed.clear()
                return True
            targets = np.minimum(a.lower + angles[min(attempt, len(angles) - 1) :], a.upper).tolist()
            found = self._door_plan(front, q, targets)
            if found is None or attempt == TRIES:
                break
            spot, stance, wanted, lift = found
            yield from self._raise(lift)
            if (yield from self._drive(stance)):
                yield from self._see(front, move=False)
                q, here = self._joint(a).position, self._belief.localization.T_map_base
                can = (w for w in targets if self._reach.follows(front, spot, (q, w), here, lift) is not None)
                wanted = next(can, wanted)  # from where it has really come to stand
                push = wanted if angle > 0.0 else a.lower - 0.03
                yield from self._ask(Request("articulate", self._in_base(front.at(spot, q)[0]), push))
                moved = self._outcome is Outcome.DONE
                yield from self._straight(-0.1)
            self._failed.append(stance[:2, 3])  # if it is tried again, then from elsewhere
        self._failed.clear()
        yield from self._wait(10)
        return more and self._opened(front) > ENOUGH

    def _take(self) -> Tried:
        item = self._goal.subject
        middle = self._shelf()
        self._failed.clear()
        for _ in range(TRIES):
            yield from self._view(middle, self._fridge.outwards_closed)
            track = yield from self._look_for(item, middle)
            if self._opened(self._fridge) < ENOUGH:
                return False  # it has been run into
            if track is None:
                middle = middle + (0.0, 0.0, -0.25) if middle[2] > 0.8 else middle + (0.0, 0.0, 0.3)
                continue
            place = track.T_map_object[:3, 3]
            yield from self._raise(float(np.clip(place[2] - COMFORT, 0.0, 0.35)))
            inwards = -self._fridge.outwards_closed
            side = self._hinge_side(self._fridge)
            stance = next((s for r in (RUN_UP, 0.0) if (s := self._stance(place, inwards, BEFORE, 0.0, r, side))), None)
            if stance is None:
                return False
            yield from self._come(*stance)
            self._failed.append(stance[0][:2, 3])  # if it is tried again, then from elsewhere
            yield from self._look_for(item, place)
            track = believed(self._belief, item)
            if track is not None:
                yield from self._ask(Request("take", self._in_base(track.T_map_object[:3, 3])))
            yield from self._straight(-0.4)
            if self._holds:
                return True
        return False

    def _insert(self) -> Plan:
        place, inwards, side = self._inside()
        yield from self._raise(float(np.clip(place[2] + 0.04 - COMFORT, 0.0, 0.35)))
        stance = self._stance(place - 0.03 * inwards, inwards, STROKE, LIFT, RUN_UP, side)
        if stance is None:
            yield from self._wait(10)
            return
        self._gaze = place
        yield from self._come(*stance)
        yield from self._wait(8)
        yield from self._ask(Request("insert", self._in_base(place)))
        yield from self._straight(-0.3)
        yield from self._wait(5)

    def _is_in(self) -> bool:
        """Whether the item may be in the microwave: nothing that was seen lately speaks against it."""
        track = believed(self._belief, self._goal.subject)
        if track is None or not self._fresh(track.last_seen):
            return self._outcome is Outcome.DONE
        T_map_board, size = self._board
        x, y, z = apply(inverse(T_map_board), track.T_map_object[:3, 3][None])[0]
        return bool(abs(x) < size[0] / 2 and abs(y) < size[1] / 2 and z > -0.02)

    # ------------------------------------------------------------------------------------------------- what is believed

    def _joint(self, articulation: Articulation) -> JointEstimate:
        return next(joint for joint in self._belief.joints if joint.name == articulation.name)

    def _opened(self, front: Front) -> float:
        """How far a door is believed to be open, radians."""
        return self._joint(front.articulation).position - front.articulation.lower

    def _obstacles(self) -> list[Float64]:
        """See `Driver`; and the leaf of the fridge's door, where it stands open."""
        a, opened = self._fridge.articulation, self._opened(self._fridge)
        if opened < AJAR:
            return self._met
        leaf = apply(motion(a, a.lower + opened), a.vertices.astype(float))[:, :2]
        tip = leaf[int(np.argmax(np.linalg.norm(leaf - a.anchor[:2], axis=1)))]
        along = np.linspace(a.anchor[:2], tip, 1 + int(np.linalg.norm(tip - a.anchor[:2]) / self._floor.config.cell))
        return [*self._met, *along]

    def _fresh(self, seen: int | None) -> bool:
        return seen is not None and self._belief.stamp - seen < FRESH * NANOSECONDS

    def _shelf(self) -> Float64:
        """(3,) where the item is sought first: behind the fridge's door, at the height of the shoulder."""
        door = self._fridge.articulation.vertices.astype(float)
        middle = door.mean(axis=0)
        middle[2] = min(max(0.85, door[:, 2].min()), door[:, 2].max())
        return middle - 0.1 * self._fridge.outwards_closed

    def _inside(self) -> tuple[Float64, Float64, float]:
        """(3,) where the item shall be in the microwave, and (3,) the direction in, past the door as it is now.

        Last, 1 if the door's hinge is on the left of who looks in, else -1: there the robot should not stand.
        """
        T_map_board, size = self._board
        a = self._microwave.articulation
        opened = self._opened(self._microwave)
        hinge = float(apply(inverse(T_map_board), a.anchor[None])[0][1])
        width = float(np.ptp((a.vertices - a.anchor) @ T_map_board[:3, 1]))
        side = self._hinge_side(self._microwave)
        tip = hinge + side * width * float(np.cos(opened))
        far = side * (size[1] / 2 - HALF_WIDTH)
        # From the leaf's tip to the far wall there has to be room for the hand.
        y = side * min(max(side * tip + HALF_WIDTH + 0.01, 0.0), max(side * far, 0.0))
        height = float(self._briefing.models[self._goal.subject].extents[2]) / 2
        local = np.array([size[0] / 2 - INTO, y, height])
        return apply(T_map_board, local[None])[0], -T_map_board[:3, 0], side

    def _hinge_side(self, front: Front) -> float:
        """1 if the hinge of a door is on the left of who looks at it, else -1."""
        a, out = front.articulation, front.outwards_closed
        leaf = apply(motion(a, a.lower), a.vertices.astype(float)).mean(axis=0)
        return 1.0 if float(np.cross(out, leaf - a.anchor)[2]) > 0.0 else -1.0

    # --------------------------------------------------------------------------------------------------------- stances

    def _candidates(self, place: Float64, inwards: Float64, side: float = 0.0) -> Iterator[Float64]:
        """(4, 4) T_map_base from which a place is before the arm, the straightest first, on floor that is free now.

        With a `side` of 1 or -1 the place is rather to the left or right of the robot.
        """
        self._mind_obstacles()
        for turn in TURNS.tolist():
            ahead = turned(inwards, turn)
            for left in sorted(ASIDE, key=lambda left: -side * left):
                for forward in AHEAD:
                    T = transform_planar(0.0, 0.0, float(np.arctan2(ahead[1], ahead[0])))
                    T[:2, 3] = place[:2] - (T[:3, :3] @ [forward, left, 0.0])[:2]
                    tried = any(np.linalg.norm(T[:2, 3] - other) < ELSEWHERE for other in self._failed)
                    if not tried and self._floor.clearance_at(*T[:2, 3].tolist()) > ROOM:
                        yield T

    def _door_plan(
        self, front: Front, position: float, targets: list[float]
    ) -> tuple[Float64, Float64, float, float] | None:
        """Where a door is held, where the robot stands, to which of some positions, first the best, and the torso."""
        for wanted in targets:
            for lift in LIFTS:
                spot = front.spot(COMFORT + lift)
                stance = None if spot is None else self._door_stance(front, spot, position, wanted, lift)
                if spot is not None and stance is not None:
                    return spot, stance, wanted, lift
        return None

    def _door_stance(self, front: Front, spot: Float64, position: float, wanted: float, lift: float) -> Float64 | None:
        place, inwards = front.at(spot, position)
        best: tuple[float, Float64] | None = None
        for T in self._candidates(place, inwards):
            end = followed(front, spot, position, wanted, T)
            if self._floor.clearance_at(*end[:2, 3].tolist()) < ROOM:
                continue
            lean = self._reach.follows(front, spot, (position, wanted), T, lift)
            if lean is not None and (best is None or lean < best[0]):
                best = lean, T
            if best is not None and best[0] < np.deg2rad(59.0):
                break
        return None if best is None else best[1]

    def _stance(
        self, place: Float64, inwards: Float64, stroke: float, lift: float, run_up: float = 0.0, side: float = 0.0
    ) -> tuple[Float64, float] | None:
        """Where to stand so that a level cup goes straight to a place and has come from `stroke` metres before it.

        The robot drives straight for the last `run_up` metres, which are the second of what is returned.
        """
        for T in self._candidates(place, inwards, side):
            behind = T[:2, 3] - run_up * T[:2, 0]
            if self._floor.clearance_at(*behind.tolist()) < ROOM:
                continue
            T_base_map = inverse(T)
            at, ahead = apply(T_base_map, place[None])[0] + (0.0, 0.0, lift), T_base_map[:3, :3] @ inwards
            inside = self._reach.joints(at, ahead, self._lift, level=True)
            if inside is None:
                continue
            if self._reach.joints(at - stroke * ahead, ahead, self._lift, level=True) is not None:
                return T, run_up
        return None

    # ------------------------------------------------------------------------------------------------------- movements

    def _see(self, front: Front, *, move: bool = True) -> Plan:
        """Look at a door until it is known how far it is open."""
        a = front.articulation
        middle = a.vertices.astype(float).mean(axis=0)
        middle[2] = min(middle[2], 1.2)
        if move and not self._fresh(self._joint(a).last_seen):
            yield from self._view(middle, front.outwards_closed)
        self._gaze = front.at(middle, self._joint(a).position)[0]
        for _ in range(25):
            yield self._move()
            if self._fresh(self._joint(a).last_seen) and self._joint(a).last_seen == self._belief.stamp:
                break
        yield from self._wait(3)

    def _view(self, place: Float64, outwards: Float64) -> Plan:
        """Go to where a place can be looked at from the front, from the nearest free floor there."""
        self._gaze = place
        best: tuple[float, Float64] | None = None
        here = self._belief.localization.T_map_base[:2, 3]
        self._mind_obstacles()
        for turn in np.deg2rad([0, 20, -20, 40, -40]).tolist():
            for distance in (VIEW, 1.1, 1.4, 0.95, 1.6):
                xy = (place + distance * turned(outwards, turn))[:2]
                if self._floor.clearance_at(*xy.tolist()) < ROOM + 0.03:
                    continue
                cost = abs(turn) + abs(distance - VIEW) + 0.1 * float(np.linalg.norm(xy - here))
                if best is None or cost < best[0]:
                    best = cost, xy
        if best is None:
            return
        ahead = place[:2] - best[1]
        T = transform_planar(float(best[1][0]), float(best[1][1]), float(np.arctan2(ahead[1], ahead[0])))
        yield from self._drive(T, near=0.12)

    def _look_for(self, name: str, place: Float64) -> Generator[Float32, None, Track | None]:
        """Look at a place until a thing has been seen for a while."""
        self._gaze, seen = place, 0
        for _ in range(45):
            track = believed(self._belief, name)
            seen = seen + 1 if track is not None and self._fresh(track.last_seen) else 0
            if seen >= 8:
                return track
            yield self._move()
        return believed(self._belief, name)


def _door(briefing: Briefing, name: str) -> Articulation:
    """The largest door of a piece of furniture, by its name or class.

    Raises:
        InvalidValueError: the survey knows none.
    """
    doors = [
        a
        for a in briefing.static_map.articulations
        if a.kind == "revolute" and (a.semantic_class == name or a.name.startswith(f"{name}/"))
    ]
    if not doors:
        raise InvalidValueError("static_map", name, "a map with a door of it")
    return max(doors, key=lambda a: float(np.prod(np.sort(np.ptp(a.vertices, axis=0))[1:])))


def _board(briefing: Briefing, name: str, front: Front) -> tuple[Float64, Float64]:
    """(4, 4) T_map_board with x towards the door, and (2,) size of the lowest board of a piece of furniture."""
    entity: MapEntity = next(e for e in briefing.static_map.entities if e.name == name)
    T_map_face, size = min(
        ((T, size) for T, size in entity.supports if np.prod(size) > 0.03), key=lambda face: float(face[0][2, 3])
    )
    out = front.outwards_closed
    local = T_map_face[:3, :3].T @ out
    T = np.eye(4)
    T[:3, :3] = np.stack([out, np.cross([0.0, 0.0, 1.0], out), [0.0, 0.0, 1.0]], axis=1)
    T[:3, 3] = T_map_face[:3, 3]
    return T, np.asarray(size)[::-1] if abs(local[1]) > abs(local[0]) else np.asarray(size)
