"""The truth in the shape of a belief: what ideal perception would report, and what is really the case."""

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from simtrack.contracts import Belief, Float64, JointEstimate, Localization, Relation, Status, Track, TrackStatus
from simtrack.geometry.meshes import sample_surface
from simtrack.geometry.transforms import apply, inverse
from simtrack.sensors.camera import CameraModel
from simtrack.simulation.ground_truth import ObjectTruth, Truth

if TYPE_CHECKING:
    from simtrack.simulation.simulation import Simulation

POINTS = 24
"""Points on the surface of each object by which it is seen or not."""
SEEN = 0.1
"""Share of these points in clear view from which on an object counts as seen (about half of them face away)."""
_CERTAIN = np.zeros((6, 6))


def _track(number: int, thing: ObjectTruth, stamp: int, seen: int, visible: float, T_camera_map: Float64) -> Track:
    return Track(
        id=number,
        class_name=thing.class_name,
        status=TrackStatus.CONFIRMED if seen == stamp else TrackStatus.OUT_OF_VIEW,
        stamp=stamp,
        T_map_object=thing.T_map_object,
        covariance=_CERTAIN,
        T_camera_object=T_camera_map @ thing.T_map_object,
        velocity=thing.velocity,
        last_seen=seen,
        visible_fraction=visible,
        moving=bool(np.linalg.norm(thing.velocity[:3]) > 0.01),
        residual=0.0,
        score=1.0,
    )


def true_belief(truth: Truth, visible: Mapping[str, float] | None = None) -> Belief:
    """The truth as a belief without any doubt: every object of the catalogue is known where it is.

    Args:
        truth: of one moment.
        visible: object name -> share of it in clear view; 0 for those that are not named.
    """
    T_camera_map = inverse(truth.T_map_camera)
    things = [thing for thing in truth.objects.values() if thing.kind == "catalogue"]
    numbers = {thing.name: k for k, thing in enumerate(things, 1)}
    share = visible or {}
    tracks = tuple(
        _track(numbers[thing.name], thing, truth.stamp, truth.stamp, share.get(thing.name, 0.0), T_camera_map)
        for thing in things
    )
    names = {thing.name: f"{thing.class_name}-{numbers[thing.name]}" for thing in things}
    relations = frozenset(
        Relation(names[above], "on", names.get(below, below)) for above, below in truth.contacts if above in names
    )
    return _belief(truth, tracks, relations)


def _belief(truth: Truth, tracks: tuple[Track, ...], relations: frozenset[Relation]) -> Belief:
    where = Localization(truth.stamp, truth.T_map_base, _CERTAIN, Status.OK, 1.0)
    joints = tuple(
        JointEstimate(name, truth.stamp, position, 0.0, 0.0, truth.stamp, TrackStatus.CONFIRMED)
        for name, position in truth.joints.items()
    )
    return Belief(truth.stamp, where, truth.T_map_camera, tracks, None, None, relations, joints=joints)


class IdealPerception:
    """Sees what the camera can see, exactly and at once; remembers where it saw the rest last. Needs no stack.

    It stands in for the stack where none runs, so that a task that rewards knowledge means the same in every mode.
    """

    def __init__(self, simulation: "Simulation", camera: CameraModel) -> None:
        """Choose the points by which objects are seen."""
        self._simulation, self._camera = simulation, camera
        world = simulation.world
        self._names = [name for name in world.objects if world.is_catalogue(name)]
        rng = np.random.default_rng(0)
        self._points = [sample_surface(world.objects[name].mesh, POINTS, rng)[0] for name in self._names]
        self._owners = np.repeat([world.names.index(name) for name in self._names], POINTS)
        self._last: dict[str, Track] = {}

    def reset(self) -> None:
        """Forget everything."""
        self._last.clear()

    def visible(self, truth: Truth) -> dict[str, float]:
        """Object name -> share of its points that the camera has in clear view and range."""
        if not self._names:
            return {}
        T_camera_map, K = inverse(truth.T_map_camera), self._camera.intrinsics
        points = np.concatenate(
            [apply(truth.objects[n].T_map_object, p) for n, p in zip(self._names, self._points, strict=True)]
        )
        x, y, z = apply(T_camera_map, points).T
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v = K.fx * x / z + K.cx, K.fy * y / z + K.cy
        inside = (z > self._camera.min_range) & (z < self._camera.max_range)
        inside &= (u >= 0) & (u <= K.width - 1) & (v >= 0) & (v <= K.height - 1)
        clear = np.zeros(len(points), bool)
        if inside.any():
            eye = truth.T_map_camera[:3, 3]
            rays = points[inside] - eye
            rays /= np.linalg.norm(rays, axis=1, keepdims=True)
            world = self._simulation.truth.rays(truth.stamp)
            hits = world.scene.cast_rays(np.broadcast_to(eye, rays.shape), rays, min_distance=0.03)
            clear[inside] = world.ids(hits) == self._owners[inside]
        shares = clear.reshape(-1, POINTS).mean(axis=1)
        return dict(zip(self._names, shares.tolist(), strict=True))

    def process(self, truth: Truth, visible: Mapping[str, float]) -> Belief:
        """The belief after looking once."""
        T_camera_map = inverse(truth.T_map_camera)
        for number, name in enumerate(self._names, 1):
            if visible[name] >= SEEN:
                thing = truth.objects[name]
                self._last[name] = _track(number, thing, truth.stamp, truth.stamp, visible[name], T_camera_map)
            elif name in self._last:
                last = self._last[name]
                self._last[name] = replace(
                    last, status=TrackStatus.OUT_OF_VIEW, stamp=truth.stamp, visible_fraction=0.0,
                    T_camera_object=T_camera_map @ last.T_map_object,
                )  # fmt: skip
        return _belief(truth, tuple(self._last[name] for name in self._names if name in self._last), frozenset())
