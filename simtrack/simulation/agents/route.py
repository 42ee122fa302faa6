"""An agent that tours a building: from room to room on planned ways, as fast as the place allows."""

from dataclasses import dataclass, field

import numpy as np

from simtrack.contracts import NANOSECONDS, Belief, Command, Float64, JointState, StaticMap, Status
from simtrack.errors import InvalidValueError
from simtrack.geometry.transforms import yaw_of
from simtrack.simulation.agents.floor_plan import FloorPlan, FloorPlanConfig
from simtrack.simulation.agents.obstacles import ObstacleMemory


@dataclass(frozen=True, slots=True)
class RouteConfig:
    """How the tour is driven."""

    speed: float = 0.9
    """Largest speed, m/s."""
    turn_rate: float = 1.0
    """Largest yaw rate, rad/s."""
    acceleration: float = 0.8
    """m/s^2; turns are slow enough for so much lateral acceleration, too."""
    goal_radius: float = 0.4
    """A goal counts as reached within so many metres."""
    off_path: float = 0.6
    """Metres from the way at which a new one is planned."""
    stuck_after: float = 2.5
    """Seconds without progress after which the robot backs off and looks for another way."""
    sightings: int = 3
    """Scans or images that must show something unexplained at a place before ways lead around it."""
    plan: FloorPlanConfig = field(default_factory=FloorPlanConfig)

    def __post_init__(self) -> None:
        for name in ("speed", "turn_rate", "acceleration", "goal_radius", "off_path", "stuck_after", "sightings"):
            if not getattr(self, name) > 0:
                raise InvalidValueError(f"RouteConfig.{name}", getattr(self, name), "positive")


class RouteAgent:
    """Drives a tour through the rooms of the survey, believing the stack's localization.

    Ways are followed by pure pursuit (Coulter 1992), slower in turns and where it is narrow. While the localization is
    lost the robot turns in place to look around; while it is ambiguous it creeps. What the pre-segmentation reports as
    unexplained is avoided: the furniture that was moved since the survey.

    Args:
        static_map: the survey.
        rng: chooses the rooms of the tour.
        config: speeds and clearances.
    """

    def __init__(self, static_map: StaticMap, rng: np.random.Generator, config: RouteConfig | None = None) -> None:
        self.config = RouteConfig() if config is None else config
        self.floor_plan = FloorPlan(static_map, self.config.plan)
        self.path: Float64 = np.empty((0, 2))
        """(N, 2), the way being driven, map frame."""
        self._rooms, self._rng = static_map.rooms, rng
        self._visits = np.zeros(len(static_map.rooms), int)
        self._goal: Float64 | None = None
        self._progress = 0
        self._stamp: int | None = None
        self._speed = self._turn = 0.0
        self._obstacles = ObstacleMemory(self.floor_plan, self.config.sightings)
        self._anchor, self._idle, self._backing = np.zeros(2), 0.0, 0.0

    def act(self, belief: Belief, joints: JointState) -> Command:
        """Drive on; `joints` are not needed."""
        elapsed = 0.0 if self._stamp is None else max(0, belief.stamp - self._stamp) / NANOSECONDS
        self._stamp = belief.stamp
        where = belief.localization
        if where.status is Status.LOST or not np.isfinite(where.T_map_base).all():
            self.path, self._idle = np.empty((0, 2)), 0.0
            return self._drive(0.0, 0.4, elapsed)
        xy, yaw = where.T_map_base[:2, 3], yaw_of(where.T_map_base)
        trusted = where.status is not Status.AMBIGUOUS
        if trusted:
            new = self._obstacles.notice(belief, xy, self.path[self._progress : self._progress + 40])
            if len(new):
                self.floor_plan.block(new)
                self.path = np.empty((0, 2))
        if self._backing > 0.0:
            self._backing -= elapsed
            return self._drive(-0.2, 0.0, elapsed)
        if trusted and self._is_stuck(xy, elapsed):
            return self._back_off(xy, yaw, elapsed)
        if not self._has_way(xy):
            return self._drive(0.0, 0.4, elapsed)
        return self._pursue(xy, yaw, elapsed, self.config.speed if trusted else 0.15)

    # --------------------------------------------------------------------------------------------------------- planning

    def _has_way(self, xy: Float64) -> bool:
        """See to it that there is a goal and a way to it from here; False if none can be found now."""
        if self._goal is None or np.linalg.norm(self._goal - xy) < self.config.goal_radius:
            self._goal, self.path = self._next_goal(xy), np.empty((0, 2))
        if self._goal is None:
            return False
        if len(self.path):
            ahead = self.path[self._progress : self._progress + 30]
            distances = np.linalg.norm(ahead - xy, axis=1)
            self._progress += int(np.argmin(distances))
            if distances.min() > self.config.off_path:
                self.path = np.empty((0, 2))
        if not len(self.path):
            way = self.floor_plan.plan(xy, self._goal)
            self._progress = 0
            if way is None:
                self._obstacles.forget()
                self._goal = None
                return False
            self.path = way
        return True

    def _next_goal(self, xy: Float64) -> Float64 | None:
        """A place in a room far away that was not visited before the others."""
        if not self._rooms:
            return self.floor_plan.random_free(self._rng)
        centres = np.array([room.polygon.mean(axis=0) for room in self._rooms])
        appeal = np.linalg.norm(centres - xy, axis=1) * self._rng.uniform(0.5, 1.0, len(centres))
        for k in np.lexsort((-appeal, self._visits)):
            self._visits[k] += 1
            place = self.floor_plan.place_in(self._rooms[k], self._rng)
            if place is not None and np.linalg.norm(place - xy) > 2 * self.config.goal_radius:
                return place
        return None

    # ---------------------------------------------------------------------------------------------------------- driving

    def _is_stuck(self, xy: Float64, elapsed: float) -> bool:
        """Whether the robot wants to drive and has not moved for a while."""
        if np.linalg.norm(xy - self._anchor) > 0.1 or self._speed < 0.05:
            self._anchor, self._idle = xy.copy(), 0.0
        self._idle += elapsed
        return self._idle > self.config.stuck_after

    def _back_off(self, xy: Float64, yaw: float, elapsed: float) -> Command:
        """Back away from whatever stops the robot, and take the place before it as blocked."""
        reach = self.config.plan.radius + 0.1
        spread = yaw + np.linspace(-0.6, 0.6, 9)
        self.floor_plan.block(xy + reach * np.stack([np.cos(spread), np.sin(spread)], axis=1))
        self.path, self._idle, self._backing = np.empty((0, 2)), 0.0, 1.2
        return self._drive(-0.2, 0.0, elapsed)

    def _pursue(self, xy: Float64, yaw: float, elapsed: float, limit: float) -> Command:
        """One step of pure pursuit along the way."""
        config, ahead = self.config, self.path[self._progress :]
        travelled = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(ahead, axis=0), axis=1))])
        lookahead = 0.35 + 0.5 * max(self._speed, 0.0)
        target = ahead[min(int(np.searchsorted(travelled, lookahead)), len(ahead) - 1)]
        bearing = _wrapped(float(np.arctan2(*(target - xy)[::-1])) - yaw)
        if abs(bearing) > 1.0:
            return self._drive(
                0.0, float(np.clip(2.0 * bearing, -config.turn_rate, config.turn_rate)), elapsed, bearing
            )
        distance = max(float(np.linalg.norm(target - xy)), 0.2)
        curvature = 2.0 * np.sin(bearing) / distance
        speed = min(limit, self._speed_for(ahead, travelled))
        speed = min(
            speed,
            np.sqrt(config.acceleration / max(abs(curvature), 1e-6)),
            config.turn_rate / max(abs(curvature), 1e-6),
        )
        return self._drive(speed, speed * curvature, elapsed, bearing)

    def _speed_for(self, ahead: Float64, travelled: Float64) -> float:
        """m/s that narrow places, bends and the end of the way within braking distance allow."""
        config, speed = self.config, self.config.speed
        for k in np.flatnonzero(travelled < 1.2)[::2]:
            room = self.floor_plan.clearance_at(*ahead[k].tolist()) - config.plan.radius
            allowed = 0.4 + 1.6 * max(room, 0.0)
            speed = min(speed, np.sqrt(allowed**2 + 1.2 * config.acceleration * travelled[k]))
        left = max(float(travelled[-1]) - 0.5 * config.goal_radius, 0.0)
        return float(min(speed, np.sqrt(1.2 * config.acceleration * left) + 0.1))

    def _drive(self, speed: float, turn: float, elapsed: float, gaze: float = 0.0) -> Command:
        """Ease towards speeds, the head turned where the robot is going."""
        step = self.config.acceleration * elapsed
        braking = 2.0 * step
        self._speed += float(np.clip(speed - self._speed, -braking, step))
        self._turn += float(np.clip(turn - self._turn, -4.0 * elapsed, 4.0 * elapsed))
        return Command(
            linear=self._speed,
            angular=self._turn,
            head_pan=float(np.clip(gaze, -0.6, 0.6)),
            head_tilt=-0.35,
            torso=0.15,
        )


def _wrapped(angle: float) -> float:
    """The same angle between -pi and pi."""
    return float(np.arctan2(np.sin(angle), np.cos(angle)))
