"""Tidies up: grasps what is not where it should be, and puts it where the goal will hold. Sees beliefs only."""

from collections.abc import Generator, Sequence
from dataclasses import replace
from typing import Any, TypeAlias

import numpy as np

from simtrack.contracts import NANOSECONDS, Belief, Float32, Float64, Relation, Track
from simtrack.envs.actions import AXES, Outcome, Request, vector
from simtrack.envs.grasps import suction_spot
from simtrack.envs.observations import OUTCOMES, decode
from simtrack.envs.planning import Places, Reach, Spot, believed
from simtrack.envs.policies import Briefing
from simtrack.envs.settings import CONTROL_HZ
from simtrack.geometry.transforms import apply, inverse, wrapped, yaw_of

Plan: TypeAlias = Generator[Float32, None, None]
"""Actions; each is answered by the next observation."""

FRESH = 1.0
"""Seconds since a thing was seen, up to which it may be grasped."""
MEMORY = 20
"""Seconds for which a thing is remembered that is not believed any more."""
SETTLED = 8
"""Steps that a thing is looked at before it is grasped."""
TURN_GAIN, TURN_LEAST = 1.5, 0.03
"""1/s, and radians that do not matter."""
FLUENT = 0.01
"""Metres by which a goal has to be believed to hold."""
SWEEP = (0.0, 0.35, -0.35)
"""Pan angles at which things are sought, radians."""
DWELL = 12
"""Steps that each of them is held."""
TRIES = 12
"""Places that are tried before what is held goes back."""
PATIENCE, REST = 60, 3
"""Steps that a turn or a drive may take, and after which the robot stands still."""
ASIDE = (0.08, 0.6)
"""Metres that a step to the side is worth, and that it goes at most."""
DRIVE_GAIN, DRIVE_LEAST, FASTEST = 1.2, 0.01, 0.25
"""1/s, metres that do not matter, and m/s."""


class TidyPolicy:
    """One goal after the other; a goal that fails is tried again."""

    def __init__(self, briefing: Briefing, mode: str) -> None:
        self._briefing, self._mode = briefing, mode
        self._reach = Reach(briefing.robot)
        self._places = Places(briefing.static_map, briefing.models, briefing.goals)
        self.begin(np.random.default_rng(0))

    def begin(self, rng: np.random.Generator) -> None:
        """See `simtrack.envs.policies.Policy`."""
        self._plan = self._tidy()
        self._memory: dict[str, Track] = {}

    def act(self, observation: Any) -> Float32:
        """See `simtrack.envs.policies.Policy`."""
        arrays = self._briefing.arrays(observation, self._mode)
        belief, _ = decode(arrays, self._briefing.layout, self._briefing.robot)
        self._belief = self._remembered(belief)
        self._outcome = OUTCOMES[int(np.argmax(arrays["macro"]))]
        self._holds = bool(arrays["holding"].any())
        self._pan, _, self._torso = arrays["joints"].tolist()
        return next(self._plan)

    def _remembered(self, belief: Belief) -> Belief:
        """The belief, with what was believed a while ago and has only been hidden since, by the arm for instance."""
        self._memory |= {track.class_name: track for track in belief.tracks if track.believed}
        oldest = belief.stamp - MEMORY * NANOSECONDS
        now = {track.class_name for track in belief.tracks if track.believed}
        kept = (t for name, t in self._memory.items() if name not in now and t.last_seen >= oldest)
        return replace(belief, tracks=(*belief.tracks, *kept))

    # ----------------------------------------------------------------------------------------------------------- plans

    def _tidy(self) -> Plan:
        while True:
            for goal in self._briefing.goals:
                if self._places.margin(goal, self._belief) < FLUENT:
                    yield from self._fulfil(goal)
            yield self._move()

    def _fulfil(self, goal: Relation) -> Plan:
        for name in (goal.reference, goal.subject):
            yield from self._look_for(name)
        if self._places.margin(goal, self._belief) >= FLUENT:
            return
        heading = yaw_of(self._belief.localization.T_map_base)
        if not self._holds:
            yield from self._grasp(goal.subject)
        if self._holds:
            yield from self._put(goal)
            # What was believed before it was carried is not worth much: look at both again, from where they were seen.
            yield from self._turn_to(heading)
            for name in (goal.subject, goal.reference):
                yield from self._look_for(name)
        yield from self._look(0.0, DWELL)

    def _look_for(self, name: str) -> Plan:
        """Until a thing has been in view for a while, or was not found anywhere."""
        for pan in SWEEP:
            seen = 0
            for _ in range(DWELL):
                track = believed(self._belief, name)
                fresh = track is not None and self._belief.stamp - track.last_seen < FRESH * NANOSECONDS
                seen = seen + 1 if fresh else 0
                if seen >= SETTLED:
                    return
                yield self._move(pan=pan)

    def _look(self, pan: float, steps: int) -> Plan:
        for _ in range(steps):
            yield self._move(pan=pan)

    def _grasp(self, name: str) -> Plan:
        track = believed(self._belief, name)
        spot = None if track is None else suction_spot(self._briefing.models[name], track.T_map_object)
        if spot is None or not (yield from self._approach(spot)):
            return
        track = believed(self._belief, name)
        spot = None if track is None else suction_spot(self._briefing.models[name], track.T_map_object)
        if track is not None and spot is not None:
            self._grasped, self._spot = track.T_map_object, spot
            yield from self._ask(Request("grasp", self._in_base(track.T_map_object[:3, 3])))
            if self._holds:
                self._memory.pop(name, None)

    def _put(self, goal: Relation) -> Plan:
        """Try places until one is within reach; if none is, from beside; if still none, it goes back where it was."""
        spots = self._places.spots(goal, self._belief, self._grasped)
        if not spots:
            yield from self._look_for(goal.reference)
            spots = self._places.spots(goal, self._belief, self._grasped)
        if (yield from self._place_at(spots)):
            return
        reference = believed(self._belief, goal.reference)
        towards = spots[0].position if spots else None if reference is None else reference.T_map_object[:3, 3]
        if towards is not None and (yield from self._sidestep(float(self._in_base(towards)[1]))):
            yield from self._look_for(goal.reference)
            if (yield from self._place_at(self._places.spots(goal, self._belief, self._grasped))):
                return
        origin = self._grasped[:3, 3]
        if (yield from self._approach(origin)):
            yield from self._place_at([Spot(origin, yaw_of(self._grasped), 0.0)])

    def _place_at(self, spots: Sequence[Spot]) -> Generator[Float32, None, bool]:
        """Put what is held down at one of some places, the best first; whether that was done."""
        origin = self._grasped[:3, 3]
        for spot in spots[:: max(1, len(spots) // TRIES)]:
            turn = spot.heading - yaw_of(self._grasped)
            R = np.array([[np.cos(turn), -np.sin(turn), 0.0], [np.sin(turn), np.cos(turn), 0.0], [0.0, 0.0, 1.0]])
            if (yield from self._stand(spot.position + R @ (self._spot - origin))):
                heading = spot.heading - yaw_of(self._belief.localization.T_map_base)
                yield from self._ask(Request("place", self._in_base(spot.position), heading))
                if not self._holds:
                    return True
        return False

    def _approach(self, place: Float64) -> Generator[Float32, None, bool]:
        """Turn so that a place (3,) of the map is within reach, if need be after a step to the side; whether it is."""
        if (yield from self._stand(place)):
            return True
        return (yield from self._sidestep(float(self._in_base(place)[1]))) and (yield from self._stand(place))

    def _stand(self, place: Float64) -> Generator[Float32, None, bool]:
        """Turn so that a place (3,) of the map is within reach; False if no turn helps."""
        turn = self._reach.turn(place, self._belief.localization.T_map_base, self._torso)
        if turn is None:
            return False
        yield from self._turn_to(yaw_of(self._belief.localization.T_map_base) + turn)
        return True

    def _turn_to(self, wanted: float) -> Plan:
        """To a heading in the map, radians; then stand still."""
        for _ in range(PATIENCE):
            gap = wrapped(wanted - yaw_of(self._belief.localization.T_map_base))
            if abs(gap) < TURN_LEAST:
                break
            yield self._move(angular=float(np.clip(TURN_GAIN * gap, -0.6, 0.6)))
        for _ in range(REST):
            yield self._move()

    def _sidestep(self, left: float) -> Generator[Float32, None, bool]:
        """So many metres to the left (right if negative), looking where it looked before; whether it is worth it.

        Along the furniture before it, where it could turn and has driven: there the floor is free.
        """
        way = float(np.clip(left, -ASIDE[1], ASIDE[1]))
        if abs(way) < ASIDE[0]:
            return False
        T = self._belief.localization.T_map_base
        heading, course = yaw_of(T), T[:2, 1] * np.sign(way)
        yield from self._turn_to(heading + np.sign(way) * np.pi / 2)
        for _ in range(PATIENCE):
            gone = self._belief.localization.T_map_base[:2, 3] - T[:2, 3]
            gap = abs(way) - float(gone @ course)
            if abs(gap) < DRIVE_LEAST:
                break
            yield self._move(linear=float(np.clip(DRIVE_GAIN * gap, -FASTEST, FASTEST)))
        yield from self._turn_to(heading)
        return True

    def _ask(self, request: Request) -> Plan:
        """Until the arm has done it, or has said why not."""
        yield request.action(self._briefing.layout.macros)
        while self._outcome is Outcome.BUSY:
            yield self._move()

    # --------------------------------------------------------------------------------------------------------- actions

    def _move(self, angular: float = 0.0, pan: float = 0.0, linear: float = 0.0) -> Float32:
        speeds = {
            "linear": linear / AXES["linear"],
            "angular": angular / AXES["angular"],
            "pan": (pan - self._pan) * CONTROL_HZ / AXES["pan"] / 2.0,
        }
        return np.clip(vector(speeds, self._briefing.layout.macros), -1.0, 1.0)

    def _in_base(self, place: Float64) -> Float64:
        return apply(inverse(self._belief.localization.T_map_base), place[None])[0]
