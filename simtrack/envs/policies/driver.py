"""A robot that drives, looks and asks its arm, in plans of one action after the other; for scripted policies."""

from collections.abc import Generator
from typing import Any, TypeAlias

import numpy as np

from simtrack.contracts import Float32, Float64
from simtrack.envs.actions import AXES, Outcome, Request, vector
from simtrack.envs.fronts import turned
from simtrack.envs.observations import OUTCOMES, decode
from simtrack.envs.policies import Briefing
from simtrack.envs.settings import CONTROL_HZ
from simtrack.geometry.transforms import apply, inverse, wrapped, yaw_of
from simtrack.simulation.agents.floor_plan import FloorPlan

Plan: TypeAlias = Generator[Float32, None, None]
"""Actions; each is answered by the next observation."""
Tried: TypeAlias = Generator[Float32, None, bool]
"""The same, and whether it worked."""

CAMERA_HEIGHT = 1.12
"""Metres of the camera above the floor, with the torso down."""
STALLED, STILL = 20, 0.03
"""Steps in which the base moves by less than so many metres and radians: it does not get on."""
BUMPER = 0.33
"""Metres from the base's middle at which something is taken to be that it ran into."""


class Driver:
    """What a scripted policy is made of that drives about and works from the front."""

    def __init__(self, briefing: Briefing, mode: str) -> None:
        self._briefing, self._mode = briefing, mode

    def begin(self, rng: np.random.Generator) -> None:
        """See `simtrack.envs.policies.Policy`."""
        self._floor = FloorPlan(self._briefing.static_map)
        self._met: list[Float64] = []
        self._gaze: Float64 | None = None
        self._lift = 0.3

    def _sense(self, observation: Any) -> None:
        """Take in what is believed now."""
        arrays = self._briefing.arrays(observation, self._mode)
        self._belief, _ = decode(arrays, self._briefing.layout, self._briefing.robot)
        self._outcome = OUTCOMES[int(np.argmax(arrays["macro"]))]
        self._holds = bool(arrays["holding"].any())
        self._pan, self._tilt, self._torso = arrays["joints"].tolist()

    def _come(self, stance: Float64, run_up: float) -> Plan:
        """Drive to a stance (4, 4), the last metres straight: the arm is stretched out."""
        before = stance.copy()
        before[:2, 3] -= run_up * stance[:2, 0]
        yield from self._drive(before)
        yield from self._straight(float((stance[:2, 3] - self._belief.localization.T_map_base[:2, 3]) @ stance[:2, 0]))

    def _drive(self, T_map_goal: Float64, near: float = 0.03) -> Tried:
        """Drive to a pose: along a planned way, then straight there, then turn."""
        goal, yaw, been = T_map_goal[:2, 3], yaw_of(T_map_goal), list[Float64]()
        way, index = self._way(goal), 0
        for _ in range(300):
            xy = self._belief.localization.T_map_base[:2, 3]
            if self._stalled(been):
                if float(np.linalg.norm(goal - xy)) < BUMPER:
                    break  # the arm leans against something
                yield from self._around()
                way, index = self._way(goal), 0
                been.clear()
            while index < len(way) - 1 and float(np.linalg.norm(way[index] - xy)) < 0.25:
                index += 1
            offset = np.asarray(way[index]) - xy
            distance = float(np.linalg.norm(offset))
            if index == len(way) - 1 and distance < near:
                break
            heading = yaw_of(self._belief.localization.T_map_base)
            bearing = wrapped(float(np.arctan2(offset[1], offset[0])) - heading)
            if index == len(way) - 1 and distance < 0.3 and abs(bearing) > np.pi / 2:  # it lies behind
                bearing = wrapped(bearing + np.pi)
                speed = 0.0 if abs(bearing) > 0.15 else -min(0.2, 0.6 * distance + 0.03)
                yield self._move(linear=speed, angular=float(np.clip(1.8 * bearing, -0.6, 0.6)))
                continue
            left = float(np.linalg.norm(goal - xy))
            speed = 0.0 if abs(bearing) > 0.35 else min(0.45, 0.8 * left + 0.03)
            yield self._move(linear=speed, angular=float(np.clip(1.8 * bearing, -0.8, 0.8)))
        been.clear()
        for _ in range(120):
            gap = wrapped(yaw - yaw_of(self._belief.localization.T_map_base))
            if abs(gap) < 0.02 or self._stalled(been):
                break
            yield self._move(angular=float(np.clip(1.6 * gap, -0.7, 0.7) + 0.02 * np.sign(gap)))
        yield from self._wait(4)
        return float(np.linalg.norm(self._belief.localization.T_map_base[:2, 3] - goal)) < 0.1

    def _way(self, goal: Float64) -> list[Float64]:
        """Places (2,) of the map that lead to a goal."""
        self._mind_obstacles()
        path = self._floor.plan(self._belief.localization.T_map_base[:2, 3], goal)
        return [goal] if path is None else [*path[3:], goal]

    def _around(self) -> Plan:
        """Something is in the way that the survey does not show: remember it, and back off."""
        T = self._belief.localization.T_map_base
        ahead = [turned(T[:3, 0], angle) for angle in np.deg2rad([-25.0, 0.0, 25.0]).tolist()]
        self._met += [T[:2, 3] + BUMPER * direction[:2] for direction in ahead]
        yield from self._straight(-0.2)

    def _obstacles(self) -> list[Float64]:
        """Places (2,) of the map that are taken now, though the survey does not show it: what was run into."""
        return self._met

    def _mind_obstacles(self) -> None:
        """Bring the floor plan up to date with what is in the way now."""
        self._floor.unblock()
        if places := self._obstacles():
            self._floor.block(np.array(places))

    def _stalled(self, been: list[Float64]) -> bool:
        """Remember where the base is; whether it does not get on, because the arm leans against something."""
        T = self._belief.localization.T_map_base
        been.append(np.array([*T[:2, 3].tolist(), yaw_of(T)]))
        return len(been) > STALLED and bool(np.abs(been[-1] - been[-STALLED]).max() < STILL)

    def _straight(self, distance: float) -> Plan:
        """Go straight ahead, or back if negative."""
        begin = self._belief.localization.T_map_base[:2, 3].copy()
        for _ in range(40):
            left = abs(distance) - float(np.linalg.norm(self._belief.localization.T_map_base[:2, 3] - begin))
            if left < 0.02:
                break
            yield self._move(linear=float(np.sign(distance)) * min(0.25, left + 0.05))
        yield from self._wait(3)

    def _raise(self, lift: float) -> Plan:
        """Bring the torso to a height."""
        self._lift = lift
        for _ in range(60):
            if abs(self._torso - lift) < 0.003:
                break
            yield self._move()

    def _wait(self, steps: int) -> Plan:
        for _ in range(steps):
            yield self._move()

    def _ask(self, request: Request) -> Plan:
        """Until the arm has done it, or has said why not."""
        yield request.action(self._briefing.layout.macros)
        while self._outcome is Outcome.BUSY:
            yield self._move()

    def _move(self, linear: float = 0.0, angular: float = 0.0) -> Float32:
        """An action that drives, and looks where the policy looks."""
        pan, tilt = self._towards()
        speeds = {
            "linear": linear / AXES["linear"],
            "angular": angular / AXES["angular"],
            "pan": (pan - self._pan) * CONTROL_HZ / AXES["pan"] / 2.0,
            "tilt": (tilt - self._tilt) * CONTROL_HZ / AXES["tilt"] / 2.0,
            "torso": (self._lift - self._torso) * CONTROL_HZ / AXES["torso"] / 2.0,
        }
        return np.clip(vector(speeds, self._briefing.layout.macros), -1.0, 1.0)

    def _towards(self) -> tuple[float, float]:
        """Angles of the head that look at the place that is gazed at."""
        if self._gaze is None:
            return 0.0, -0.4
        x, y, z = self._in_base(self._gaze)
        pan = float(np.clip(np.arctan2(y, x), -1.1, 1.1))
        rise = z - (CAMERA_HEIGHT + self._torso)
        return pan, float(np.clip(np.arctan2(rise, max(np.hypot(x, y), 0.2)), -0.9, 0.4))

    def _in_base(self, place: Float64) -> Float64:
        return apply(inverse(self._belief.localization.T_map_base), place[None])[0]
