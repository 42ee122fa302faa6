"""Planted mistakes are the ones that their names say, and the answers stay answers."""

from pathlib import Path

import numpy as np
import pytest

from simtrack.contracts import CameraIntrinsics, Float64, PoseHypothesis, RgbdFrame, TrackerResult
from simtrack.evaluation.instrument.planted import LateTracker, SwappedQuaternionTracker, TransposedTracker
from simtrack.geometry.transforms import quaternion_from_rotation, rotation_from_rpy, transform
from simtrack.objects import load_object
from simtrack.perception.foreign import StageContext, build_stage
from simtrack.perception.tracking.tracker import ObjectTracker
from simtrack.raycast import RayBundle, RayScene, TriangleMesh

K = CameraIntrinsics(320, 240, 280.0, 280.0, 159.5, 119.5)
MODELS = {"relay": load_object("relay")}
PERIOD = 33_333_333


def pose(k: int) -> Float64:
    return transform(rotation_from_rpy(0.4, -0.3, 0.5), (0.02 + 0.002 * k, -0.01, 0.6))


@pytest.fixture(scope="module")
def feed() -> list[tuple[RgbdFrame, list[PoseHypothesis]]]:
    bundle, out = RayBundle.from_camera(K), []
    with RayScene() as scene:
        mesh = MODELS["relay"].mesh
        instance = scene.add(TriangleMesh(mesh.vertices, mesh.faces))
        for k in range(16):
            scene.set_pose(instance, pose(k))
            hits = scene.cast(bundle, np.eye(4))
            depth = np.where(np.isfinite(hits.distances), hits.distances, 1.2).reshape(240, 320).astype(np.float32)
            frame = RgbdFrame(PERIOD * (k + 1), depth, None, K, np.eye(4))
            found = [PoseHypothesis("relay", frame.stamp, pose(k), 1e-4 * np.eye(6), 1.0, 0.9)]
            out.append((frame, found if k % 4 == 0 else []))
    return out


def last_two(tracker, feed) -> list[TrackerResult]:
    results = [tracker.update(frame, np.eye(4), 1e-8 * np.eye(6), found) for frame, found in feed]
    tracker.close()
    return results[-2:]


def test_each_mistake_is_the_one_that_it_is_called(feed, tmp_path: Path) -> None:
    before, truth = last_two(ObjectTracker(MODELS), feed)
    (own,) = truth.tracks
    (transposed,) = last_two(TransposedTracker(MODELS), feed)[1].tracks
    assert transposed.T_map_object[:3, :3] == pytest.approx(own.T_map_object[:3, :3].T)
    assert transposed.T_map_object[:3, 3] == pytest.approx(own.T_map_object[:3, 3])
    (swapped,) = last_two(SwappedQuaternionTracker(MODELS), feed)[1].tracks
    wxyz, read = (quaternion_from_rotation(t.T_map_object[:3, :3]) for t in (own, swapped))
    assert np.abs(np.roll(read, -1) @ wxyz) == pytest.approx(1.0)
    late = last_two(LateTracker(MODELS), feed)[1]
    assert late.tracks[0].T_map_object == pytest.approx(before.tracks[0].T_map_object)
    assert late.tracks[0].stamp == truth.stamp


def test_they_are_found_by_name() -> None:
    context = StageContext(MODELS, None, None, None)  # type: ignore[arg-type]
    for name in ("TransposedTracker", "SwappedQuaternionTracker", "LateTracker"):
        tracker = build_stage("tracker", f"simtrack.evaluation.instrument.planted:{name}", context)
        assert hasattr(tracker, "update")
