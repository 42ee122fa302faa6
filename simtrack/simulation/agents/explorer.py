"""An agent that wants to know where everything is: it explores, follows what moves, and looks for what is lost."""

from dataclasses import dataclass

import numpy as np

from simtrack.contracts import (
    NANOSECONDS,
    Belief,
    CameraIntrinsics,
    Command,
    Float64,
    JointState,
    StaticMap,
    Status,
    Track,
    TrackStatus,
)
from simtrack.errors import InvalidValueError
from simtrack.geometry.transforms import yaw_of
from simtrack.simulation.agents.floor_plan import FloorPlan
from simtrack.simulation.agents.gaze import Patch, clipped, head_angles, in_view, support_patches


@dataclass(frozen=True, slots=True)
class ExplorerConfig:
    """Settings of `ExplorerAgent`."""

    classes: tuple[str, ...] = ("workbench", "shelf")
    """Map entities on which objects are sought first."""
    further_classes: tuple[str, ...] = ("table", "desk", "cart")
    """Map entities on which objects are sought when nothing has moved for a while."""
    calm: float = 30.0
    """How long that is, seconds."""
    dwell: float = 0.9
    """How long a patch has to be in view until it counts as explored, seconds."""
    view_distance: tuple[float, float] = (0.8, 1.8)
    """Distances from which a surface is looked at, metres."""
    explore_distance: float = 2.2
    """Largest distance from which an unexplored surface is looked at, metres."""
    half_view: float = np.deg2rad(17.0)
    """What lies within this angle of the camera's axis is in the image, radians."""
    reach: float = 2.6
    """Patches further than this from the camera are not seen well enough, metres."""
    max_linear: float = 0.9
    """m/s."""
    max_angular: float = 1.0
    """rad/s."""
    memory: float = 30.0
    """A surface with tracks on it that has not been looked at for this long is looked at again, seconds."""
    search_time: float = 8.0
    """A lost object is sought for this long, seconds ..."""
    search_radius: float = 1.5
    """... this far around where it was, metres."""

    def __post_init__(self) -> None:
        if not 0.0 < self.view_distance[0] < self.view_distance[1]:
            raise InvalidValueError("ExplorerConfig.view_distance", self.view_distance, "0 < nearest < furthest")


class ExplorerAgent:
    """Explores, then watches; implements `simtrack.contracts.Agent`. Sees beliefs and the survey, nothing else."""

    def __init__(
        self,
        static_map: StaticMap,
        intrinsics: CameraIntrinsics,
        start: Command,
        config: ExplorerConfig | None = None,
    ) -> None:
        self.config = config or ExplorerConfig()
        self._intrinsics = intrinsics
        self._plan = FloorPlan(static_map)
        self._patches = support_patches(static_map, self.config.classes + self.config.further_classes)
        first = {e.name for e in static_map.entities if e.semantic_class in self.config.classes}
        self._first = first or {p.entity for p in self._patches}
        self._last_motion = 0
        self._posture = start
        self._stamp = -1
        self._goal: _Viewpoint | None = None
        self._lost_at: dict[int, tuple[int, Float64]] = {}
        self._home: str | None = None

    def act(self, belief: Belief, joints: JointState) -> Command:
        """Answer one belief with one command."""
        elapsed = 0.0 if self._stamp < 0 else max(0.0, (belief.stamp - self._stamp) / NANOSECONDS)
        self._stamp = belief.stamp
        if belief.localization.status is Status.LOST:
            return Command(0.0, 0.4, 0.0, -0.2, self._posture.torso)  # look around until the map is recognised
        self._remember(belief, elapsed)
        entity, target = self._choose(belief)
        if target is None:
            return self._posture
        self._aim(entity, belief)
        return self._move(belief, target)

    # ------------------------------------------------------------------------------------------------------- attention

    def _remember(self, belief: Belief, elapsed: float) -> None:
        """Note which patches are in view, and which objects went missing."""
        for patch in self._patches:
            if in_view(patch.centre, belief.T_map_camera, self._intrinsics, 30.0, self.config.reach):
                patch.seen_for += elapsed
                patch.last_seen = belief.stamp
        for track in belief.tracks:
            if track.moving:
                self._last_motion = belief.stamp
            if track.status is TrackStatus.LOST:
                self._lost_at.setdefault(track.id, (belief.stamp, track.T_map_object[:3, 3]))
            else:
                self._lost_at.pop(track.id, None)
        if self._home is None:
            visible = [p.entity for p in self._patches if p.seen_for > 0.0]
            if visible:
                self._home = max(set(visible), key=visible.count)

    def _choose(self, belief: Belief) -> tuple[str, Float64 | None]:
        """The entity to look at and the point (3,) of the map to point the camera at."""
        unexplored = [p for p in self._patches if p.seen_for < self.config.dwell]
        calm = belief.stamp - self._last_motion > self.config.calm * NANOSECONDS
        reachable = [p for p in unexplored if (calm or p.entity in self._first) and self._worth(p, belief)]
        if reachable:
            entity = min(sorted({p.entity for p in reachable}), key=lambda e: self._cost(e, reachable, belief))
            return entity, self._focus([p for p in reachable if p.entity == entity], belief)
        sought = self._search(belief)
        if sought:
            nearest = min(sought, key=lambda p: self._turn(p.centre, belief))
            return nearest.entity, nearest.centre
        return self._watch(belief)

    def _focus(self, patches: list[Patch], belief: Belief) -> Float64:
        """The middle of patches if they fit into one image, else the one that is nearest to the view."""
        eye, middle = belief.T_map_camera[:3, 3], _middle(patches)
        rays = np.array([p.centre - eye for p in patches])
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        axis = (middle - eye) / np.linalg.norm(middle - eye)
        if float(np.min(rays @ axis)) > np.cos(self.config.half_view):
            return middle
        return min(patches, key=lambda p: self._turn(p.centre, belief)).centre

    def _watch(self, belief: Belief) -> tuple[str, Float64 | None]:
        """Follow what moves; else look again at what was not looked at for long; else at where most objects are."""
        moving = [t for t in belief.tracks if t.moving and t.believed]
        if moving:
            focus = np.mean([t.T_map_object[:3, 3] for t in moving], axis=0)
            around = self._near(focus, belief.tracks)
            return self._entity_at(focus), 0.65 * focus + 0.35 * around
        stale = self.config.memory * NANOSECONDS
        overdue = [p for p in self._patches if belief.stamp - p.last_seen > stale and self._occupied(p, belief.tracks)]
        if overdue:
            oldest = min(overdue, key=lambda p: p.last_seen)
            return oldest.entity, _middle([p for p in overdue if p.entity == oldest.entity])
        home = [p for p in self._patches if p.entity == self._home]
        if not home:
            return "", None
        centre = _middle(home)
        return home[0].entity, 0.5 * centre + 0.5 * self._near(centre, belief.tracks)

    def _search(self, belief: Belief) -> list[Patch]:
        """Patches around the places of lost objects that have not been seen since the loss."""
        patience, reach = self.config.search_time * NANOSECONDS, self.config.search_radius
        losses = [(stamp, place) for stamp, place in self._lost_at.values() if belief.stamp - stamp < patience]
        return [
            p
            for p in self._patches
            if any(p.last_seen < stamp and np.linalg.norm(p.centre - place) < reach for stamp, place in losses)
        ]

    def _worth(self, patch: Patch, belief: Belief) -> bool:
        """Whether a patch lies near enough for the trip to pay."""
        return float(np.linalg.norm(patch.centre[:2] - belief.T_map_camera[:2, 3])) < 5.0

    def _cost(self, entity: str, patches: list[Patch], belief: Belief) -> float:
        """Seconds or so until an entity's unexplored patches are in view."""
        mine = [p for p in patches if p.entity == entity]
        centre = _middle(mine)
        distance = float(np.linalg.norm(centre[:2] - belief.T_map_camera[:2, 3]))
        started = 0.5 if any(p.seen_for > 0.0 for p in mine) else 1.0
        ahead = self._turn(centre, belief)
        return started * (ahead + max(0.0, distance - self.config.view_distance[1]) / self.config.max_linear)

    def _turn(self, target: Float64, belief: Belief) -> float:
        """Angle from the camera's axis to a map point, rad."""
        forward = belief.T_map_camera[:3, 2]
        direction = target - belief.T_map_camera[:3, 3]
        cosine = float(forward @ direction) / max(float(np.linalg.norm(direction)), 1e-9)
        return float(np.arccos(np.clip(cosine, -1.0, 1.0)))

    def _near(self, point: Float64, tracks: tuple[Track, ...]) -> Float64:
        """Mean position of the believed objects within 1.2 m of a point; the point itself if there is none."""
        close = [
            t.T_map_object[:3, 3] for t in tracks if t.believed and np.linalg.norm(t.T_map_object[:3, 3] - point) < 1.2
        ]
        return np.mean(close, axis=0) if close else point

    def _occupied(self, patch: Patch, tracks: tuple[Track, ...]) -> bool:
        return any(t.believed and np.linalg.norm(t.T_map_object[:3, 3] - patch.centre) < 0.4 for t in tracks)

    def _entity_at(self, point: Float64) -> str:
        return min(self._patches, key=lambda p: float(np.linalg.norm(p.centre - point))).entity if self._patches else ""

    # --------------------------------------------------------------------------------------------------------- motion

    def _aim(self, entity: str, belief: Belief) -> None:
        """Choose a place to stand from which an entity can be seen, unless the present goal is one."""
        if self._goal is not None and self._goal.entity == entity:
            return
        mine = [p for p in self._patches if p.entity == entity]
        here = belief.localization.T_map_base[:2, 3]
        far = self.config.view_distance[1] if entity == self._home else self.config.explore_distance
        if not mine or self._sees_all(here, mine, far):
            self._goal = _Viewpoint(entity, None)
            return
        self._goal = _Viewpoint(entity, self._route(here, mine, far))

    def _sees_all(self, place: Float64, patches: list[Patch], far: float) -> bool:
        near = self.config.view_distance[0]
        offsets = np.array([place - p.centre[:2] for p in patches])
        distances = np.linalg.norm(offsets, axis=1)
        facing = np.einsum("ij,ij->i", offsets, np.array([p.front for p in patches])) / np.maximum(distances, 1e-9)
        return bool(distances.max() < far and distances.min() > 0.5 * near and facing.min() > 0.3)

    def _route(self, here: Float64, patches: list[Patch], far: float) -> Float64 | None:
        """Shortest path (N, 2) to a free place from which all patches can be seen; None if there is none."""
        centre, front = _middle(patches)[:2], patches[0].front
        side = np.array([-front[1], front[0]])
        places = []
        for distance in np.arange(self.config.view_distance[0] + 0.2, far, 0.2):
            for angle in np.linspace(-1.0, 1.0, 9):
                place = centre + distance * (np.cos(angle) * front + np.sin(angle) * side)
                if self._plan.free(float(place[0]), float(place[1])) and self._sees_all(place, patches, far):
                    places.append(place)
        places.sort(key=lambda p: float(np.linalg.norm(p - here)))
        for place in places[:3]:
            path = self._plan.plan(here, place)
            if path is not None and len(path) > 0:
                return path
        return None

    def _move(self, belief: Belief, target: Float64) -> Command:
        """Drive along the path to the viewpoint, if there is one, and keep the camera on the target."""
        T_map_base = belief.localization.T_map_base
        pan, tilt = head_angles(target, T_map_base, belief.T_map_camera[:3, 3])
        linear, angular = 0.0, 0.0
        path = self._goal.path if self._goal is not None else None
        if self._goal is not None and path is not None and np.linalg.norm(path[-1] - T_map_base[:2, 3]) < 0.25:
            self._goal, path = _Viewpoint(self._goal.entity, None), None  # arrived
        if path is not None:
            linear, angular = self._follow(path, T_map_base)
        elif abs(pan) > 0.9:
            angular = float(
                np.clip(1.5 * (pan - np.sign(pan) * 0.5), -self.config.max_angular, self.config.max_angular)
            )
        return Command(linear, angular, *clipped(pan, tilt), self._posture.torso)

    def _follow(self, path: Float64, T_map_base: Float64) -> tuple[float, float]:
        """Pure pursuit of a path (N, 2): forward speed m/s and yaw rate rad/s."""
        here, heading = T_map_base[:2, 3], yaw_of(T_map_base)
        nearest = int(np.argmin(np.linalg.norm(path - here, axis=1)))
        ahead = path[nearest:]
        far = np.flatnonzero(np.linalg.norm(ahead - here, axis=1) > 0.35)
        goal = ahead[far[0]] if len(far) else path[-1]
        bearing = float(np.arctan2(goal[1] - here[1], goal[0] - here[0])) - heading
        bearing = float(np.arctan2(np.sin(bearing), np.cos(bearing)))
        angular = float(np.clip(2.0 * bearing, -self.config.max_angular, self.config.max_angular))
        remaining = float(np.linalg.norm(path[-1] - here))
        speed = min(self.config.max_linear, 0.15 + 0.9 * remaining)
        linear = speed * max(0.0, np.cos(bearing)) ** 2 if abs(bearing) < 1.2 else 0.0
        return float(linear), angular


@dataclass(frozen=True, slots=True)
class _Viewpoint:
    """Where to stand for an entity."""

    entity: str
    path: Float64 | None
    """(N, 2) in the map; None where turning on the spot is enough or no place was found."""


def _middle(patches: list[Patch]) -> Float64:
    return np.mean([p.centre for p in patches], axis=0)
