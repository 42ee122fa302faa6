"""What a robot works out before it grasps or places, from what it believes: how to stand, and where there is room."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from simtrack.contracts import Belief, Float64, Relation, StaticMap, Track
from simtrack.envs.arm import ArmKinematics
from simtrack.geometry.kinematics import KinematicTree
from simtrack.geometry.transforms import apply, inverse, transform_planar, yaw_of
from simtrack.objects import ObjectModel
from simtrack.perception.scene_graph import MarginMeter, RelationConfig, map_entity_shape, model_shapes
from simtrack.raycast import RayScene, TriangleMesh

HOVER = 0.05
"""Metres above a place that must be within reach, too."""
TURNS = np.deg2rad([0, 8, -8, 16, -16, 24, -24, 32, -32, 40, -40])
"""Bearings of a place, seen from the base, that are tried: radians."""
RADII = np.arange(0.45, 0.66, 0.03)
"""Metres from the base where places are sought."""
BEARINGS = np.deg2rad(np.arange(-48.0, 49.0, 4.0))
"""Radians, base frame, where places are sought."""
HEADINGS = np.deg2rad(np.arange(0.0, 360.0, 30.0))
"""Turns about the vertical that are tried."""
FLAT = 0.012
"""Metres: largest difference of heights below something that is put down; the survey is rough."""
MARGINS = (0.008, 0.03)
"""Metres around it that must be, and should be, free."""
SAFE = 0.03
"""Metres by which a relation should hold."""


@dataclass(frozen=True, slots=True)
class Spot:
    """Where something could be put."""

    position: Float64
    """(3,) of its origin, map frame."""
    heading: float
    """Radians, map frame."""
    merit: float
    """The greater the better."""


class Reach:
    """Where the arm reaches, by the robot's own description."""

    def __init__(self, robot: KinematicTree) -> None:
        self._arm = ArmKinematics(robot)

    def covers(self, place: Float64, torso: float, hover: float = HOVER) -> bool:
        """Whether the cup gets to a place (3,) of the base frame, and that far above it."""
        low = self._arm.solve(place, torso)
        return low is not None and self._arm.solve(place + (0.0, 0.0, hover), torso, low) is not None

    def turn(self, place: Float64, T_map_base: Float64, torso: float, hover: float = HOVER) -> float | None:
        """By how much the base has to turn, radians, so that the cup gets to a place (3,) of the map; None: it cannot.

        The smallest turn that will do is chosen; 0 if none is needed.
        """
        x, y, z = apply(inverse(T_map_base), place[None])[0]
        radius, bearing = float(np.hypot(x, y)), float(np.arctan2(y, x))
        candidates = sorted((bearing - TURNS).tolist(), key=abs)
        for turn in (0.0, *candidates):
            seen = bearing - turn
            if abs(seen) < np.pi / 2 and self.covers(
                np.array([radius * np.cos(seen), radius * np.sin(seen), z]), torso, hover
            ):
                return float(turn)
        return None


class Places:
    """Where something can be put so that a relation holds, on what is known of the world."""

    def __init__(
        self, static_map: StaticMap, models: Mapping[str, ObjectModel], goals: Sequence[Relation] = ()
    ) -> None:
        """Look at map and models.

        Args:
            static_map: the survey.
            models: class name -> model.
            goals: relations between classes and furniture that places will be sought for.
        """
        self._models = models
        self._map = TriangleMesh(static_map.vertices, static_map.faces, "map")
        self._meshes = {n: TriangleMesh(m.mesh.vertices, m.mesh.faces, n) for n, m in models.items()}
        config, shapes = RelationConfig(), model_shapes(models)
        self._furniture = {entity.name: entity.T_map_entity for entity in static_map.entities}
        for entity in static_map.entities:
            if any(goal.reference == entity.name for goal in goals):
                shapes[entity.name] = map_entity_shape(entity, config.container_classes, config.layout_classes)
        self._meters = {g: MarginMeter(shapes[g.subject], g.name, shapes[g.reference], config) for g in goals}

    def margin(self, goal: Relation, belief: Belief) -> float:
        """Metres by which a goal is believed to hold, negative if it does not; -inf if a thing is not believed."""
        subject, reference = (self._pose(name, belief) for name in (goal.subject, goal.reference))
        if subject is None or reference is None:
            return -np.inf
        return self._meters[goal].margin(subject, reference)

    def _pose(self, name: str, belief: Belief) -> Float64 | None:
        """(4, 4) where a thing is believed to be."""
        if name not in self._models:
            return self._furniture[name]
        track = believed(belief, name)
        return None if track is None else track.T_map_object

    def spots(self, goal: Relation, belief: Belief, T_map_object: Float64) -> list[Spot]:
        """Where the goal's subject, once it is held, can be put down within reach so that the goal holds.

        Args:
            goal: its subject is held.
            belief: of now.
            T_map_object: (4, 4) of the subject, as it stood when it was grasped.

        Returns:
            The best first; none if the reference is not believed or there is no room.
        """
        reference = self._pose(goal.reference, belief)
        if reference is None:
            return []
        model = self._models[goal.subject]
        upright = transform_planar(0.0, 0.0, -yaw_of(T_map_object)) @ _about_origin(T_map_object)
        corners = apply(upright, np.asarray(model.mesh.vertices, dtype=float))
        half, bottom = np.abs(corners[:, :2]).max(axis=0), float(corners[:, 2].min())
        places = [(p, h) for p in self._around(belief.localization.T_map_base, reference) for h in HEADINGS.tolist()]
        found: list[Spot] = []
        with RayScene() as scene:
            self._furnish(scene, belief, goal.subject)
            heights = list(_heights(scene, places, half, float(belief.T_map_camera[2, 3])))
        for (place, heading), (under, near, far) in zip(places, heights, strict=True):
            level = float(np.median(under))
            if not np.isfinite(under).all() or np.ptp(under) > FLAT or near.max() > level + FLAT:
                continue
            position = np.array([*place, level - bottom])
            T = transform_planar(float(place[0]), float(place[1]), heading)
            T[2, 3] = position[2]
            margin = self._meters[goal].margin(T @ upright, reference)
            if margin >= 0.0:
                room = float(np.mean(far <= level + FLAT))
                found.append(Spot(position, heading, min(margin, SAFE) / SAFE + 0.5 * room))
        return sorted(found, key=lambda spot: -spot.merit)

    def _around(self, T_map_base: Float64, T_map_reference: Float64) -> Iterator[Float64]:
        """Places (2,) of the map that the arm may reach: a grid about the base, and the middle of the reference."""
        middle = T_map_reference[:2, 3]
        R, here = T_map_base[:2, :2], T_map_base[:2, 3]
        shifts = [np.array([dx, dy]) for dx in (0.0, 0.01, -0.01) for dy in (0.0, 0.01, -0.01)]
        yield from (middle + shift for shift in shifts)
        for radius in RADII.tolist():
            for bearing in BEARINGS.tolist():
                yield R @ (radius * np.array([np.cos(bearing), np.sin(bearing)])) + here

    def _furnish(self, scene: RayScene, belief: Belief, without: str) -> None:
        scene.add(self._map, np.eye(4), instance=0)
        for number, track in enumerate((t for t in belief.tracks if t.believed and t.class_name != without), 1):
            scene.add(self._meshes[track.class_name], track.T_map_object, instance=number)


def believed(belief: Belief, name: str) -> Track | None:
    """The track of a class that is most certain to be there; None if none is believed."""
    tracks = [track for track in belief.tracks if track.believed and track.class_name == name]
    return max(tracks, key=lambda track: (track.last_seen, track.score, -track.id), default=None)


def _about_origin(T: Float64) -> Float64:
    out = T.copy()
    out[:3, 3] = 0.0
    return out


def _heights(
    scene: RayScene, places: Sequence[tuple[Float64, float]], half: Float64, top: float
) -> Iterator[tuple[Float64, Float64, Float64]]:
    """For each place and heading: heights of the world below the footprint, close around it, and farther around."""
    grid = np.linspace(-1.0, 1.0, 5)
    inside = np.stack(np.meshgrid(grid, grid, indexing="ij"), axis=-1).reshape(-1, 2) * half
    border = inside[np.abs(inside / half).max(axis=1) > 0.99]
    rings = [border * (1.0 + margin / half) for margin in MARGINS]
    points = np.concatenate([inside, *rings])
    c, s = (f(np.array([heading for _, heading in places])) for f in (np.cos, np.sin))
    R = np.stack([np.stack([c, -s], axis=-1), np.stack([s, c], axis=-1)], axis=1)
    xy = np.einsum("nij,pj->npi", R, points) + np.array([place for place, _ in places])[:, None]
    origins = np.concatenate([xy.reshape(-1, 2), np.full((xy.shape[0] * xy.shape[1], 1), top)], axis=1)
    down = np.broadcast_to(np.array([0.0, 0.0, -1.0]), origins.shape)
    heights = top - scene.cast_rays(origins, down).distances.astype(float).reshape(len(places), -1)
    n, m = len(inside), len(border)
    for row in heights:
        yield row[:n], row[n : n + m], row[n + m :]
