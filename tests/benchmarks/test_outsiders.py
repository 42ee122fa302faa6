"""ICP trackers of other make: what a detection missed by a centimetre is found to millimetres, what left is dropped."""

import numpy as np
import pytest

from simtrack.benchmarks.outsiders import IcpTracker, Open3dTracker, SmallGicpTracker
from simtrack.contracts import PoseHypothesis, TrackStatus
from simtrack.objects import load_object
from simtrack.perception.foreign import GuardedTracker
from tests.perception.tracking.scenes import COVARIANCE, T_MAP_CAMERA, BenchWorld, displaced, in_camera, on_bench

MODELS = {name: load_object(name) for name in ("multimeter", "relay")}
PERIOD = 33_333_333


@pytest.mark.parametrize(("kind", "package"), [(SmallGicpTracker, "small_gicp"), (Open3dTracker, "open3d")])
def test_an_object_is_found_kept_and_dropped(kind: type[IcpTracker], package: str) -> None:
    pytest.importorskip(package, reason=f"{package} (extra bench) is not installed")
    world, name = BenchWorld(), "multimeter"
    T_map_object = on_bench(MODELS[name], 0.05, 0.05, 0.6)
    empty = world.depth()
    world.add(MODELS[name], T_map_object)
    depth = world.depth()
    hidden = np.where(depth > 0.0, np.float32(0.3), depth)
    guarded = GuardedTracker(kind(MODELS), MODELS, limit=120.0)

    def update(number: int, image: np.ndarray, *hypotheses: PoseHypothesis):
        frame = world.frame(number * PERIOD, image)
        return guarded.update(frame, T_MAP_CAMERA, COVARIANCE, hypotheses).tracks

    def detection(number: int) -> PoseHypothesis:
        rng = np.random.default_rng(number)
        T = displaced(in_camera(T_map_object), 0.01, 4.0, rng)
        return PoseHypothesis(name, number * PERIOD, T, 1e-4 * np.eye(6), 1.0, 0.9)

    assert update(0, depth) == ()
    (born,) = update(1, depth, detection(0))
    assert born.status is TrackStatus.TENTATIVE, "one detection alone may be a mistake"
    (found,) = update(2, depth, detection(1))
    assert found.status is TrackStatus.CONFIRMED
    assert np.linalg.norm(found.T_camera_object[:3, 3] - in_camera(T_map_object)[:3, 3]) < 0.004
    (behind,) = update(3, hidden)
    assert (behind.status, behind.id) == (TrackStatus.OCCLUDED, found.id)
    assert np.allclose(behind.T_map_object, found.T_map_object)
    (again,) = update(4, depth)
    assert again.status is TrackStatus.CONFIRMED
    assert update(5, empty)[0].status is TrackStatus.LOST
    assert update(5 + 30, empty) == ()
    guarded.close()
    assert guarded.watch.faults == []
