"""A small true world to test against: dataclasses of the shape of the simulation's ground truth."""

from dataclasses import dataclass, field

import numpy as np
import pytest

from simtrack.contracts import Float64, Track, TrackStatus
from simtrack.evaluation.pose_errors import PoseScorer
from simtrack.geometry.transforms import inverse, look_at, perturb, transform


@dataclass(frozen=True)
class Symmetries:
    discrete: Float64 = field(default_factory=lambda: np.eye(4)[None])
    axes: tuple = ()


@dataclass(frozen=True)
class ObjectTruth:
    name: str
    class_name: str
    T_map_object: Float64
    velocity: Float64
    kind: str = "catalogue"


@dataclass(frozen=True)
class Truth:
    stamp: int
    T_map_base: Float64
    T_map_camera: Float64
    objects: dict[str, ObjectTruth]
    contacts: frozenset[tuple[str, str]] = frozenset()

    @property
    def T_map_lidar(self) -> Float64:
        return self.T_map_base @ transform(translation=(0.0, 0.0, 1.2))


class World:
    """Two relays and a meter on a bench; poses can be set, time goes in tenths of a second."""

    def __init__(self) -> None:
        self.poses = {
            "relay-a": transform(translation=(1.0, 0.0, 0.8)),
            "relay-b": transform(translation=(1.0, 0.3, 0.8)),
            "meter": transform(translation=(1.2, -0.3, 0.8)),
        }
        self.velocities = {name: np.zeros(6) for name in self.poses}
        self.T_map_camera = look_at(np.array([0.0, 0.0, 1.4]), np.array([1.0, 0.0, 0.8]))

    def truth(self, stamp: int) -> Truth:
        objects = {
            name: ObjectTruth(name, name.split("-")[0], T, self.velocities[name]) for name, T in self.poses.items()
        }
        return Truth(stamp, np.eye(4), self.T_map_camera, objects)

    def track(self, name: str, number: int, stamp: int = 0, xi: tuple[float, ...] = (0.0,) * 6, **changes) -> Track:
        """A track of an object, off by `xi` in the map."""
        T_map_object = perturb(self.poses[name], np.array(xi))
        values = {
            "id": number, "class_name": name.split("-")[0], "status": TrackStatus.CONFIRMED, "stamp": stamp,
            "T_map_object": T_map_object, "covariance": np.eye(6) * 1e-6,
            "T_camera_object": inverse(self.T_map_camera) @ T_map_object, "velocity": np.zeros(6), "last_seen": stamp,
            "visible_fraction": 1.0, "moving": False, "residual": 1e-3, "score": 0.9,
        }  # fmt: skip
        return Track(**(values | changes))


@pytest.fixture
def world() -> World:
    return World()


@pytest.fixture(scope="session")
def scorers() -> dict[str, PoseScorer]:
    points = np.random.default_rng(0).uniform(-0.05, 0.05, (200, 3))
    return {name: PoseScorer(points, Symmetries(), 0.17) for name in ("relay", "meter")}
