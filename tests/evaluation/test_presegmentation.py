"""Pre-segmentation metrics on hand-made masks."""

import numpy as np
import pytest

from simtrack.contracts import LidarScan, Presegmentation
from simtrack.evaluation.presegmentation import (
    Measurements,
    ObjectsFoundEvaluator,
    PresegmentationEvaluator,
    lidar_measurements,
)
from simtrack.geometry.transforms import transform_planar

TENTH = 100_000_000
NAMES = ["wall", "relay", "clutter"]
MODELLED = [True, True, False]


class Plane:
    """Everything modelled is the plane z = 0."""

    def distances(self, points, limit):
        return np.abs(points[:, 2])


def result(unknown, labels=None, sensor="camera", valid=None):
    unknown = np.asarray(unknown, dtype=bool)
    labels = np.zeros(unknown.shape, dtype=np.int32) if labels is None else np.asarray(labels, dtype=np.int32)
    return Presegmentation(0, unknown, unknown.size if valid is None else valid, labels, (), sensor)


def score(unknown, ids, heights, valid=None, sigma=0.01):
    ids = np.array([ids], dtype=np.int32)
    points = np.zeros((*ids.shape, 3))
    points[..., 2] = heights
    valid = np.ones(ids.shape, dtype=bool) if valid is None else np.array([valid])
    evaluator = PresegmentationEvaluator("camera", Plane(), MODELLED)  # type: ignore[arg-type]
    presegmentation = result([unknown], valid=int(valid.sum()))
    evaluator.count(presegmentation)
    evaluator.observe(presegmentation, Measurements(valid, points, np.full(ids.shape, sigma), ids))
    return {name.rsplit(".", 1)[1]: metric.value for name, metric in evaluator.metrics().items()}


def test_shares_by_what_was_truly_hit() -> None:
    figures = score(unknown=[0, 0, 1, 1, 0], ids=[0, 1, 1, 2, 2], heights=[0, 0, 0, 0.2, 0.2])
    assert figures == pytest.approx({"known_rejected": 2 / 3, "unknown_recall": 1 / 2, "reduction": 3 / 5})


def test_unknown_points_too_close_to_a_model_do_not_count() -> None:
    assert score(unknown=[1, 0], ids=[2, 2], heights=[0.051, 0.049])["unknown_recall"] == 1.0
    assert score(unknown=[0, 0], ids=[2, 2], heights=[0.051, 0.049], sigma=0.02)["unknown_recall"] is None


def test_pixels_without_measurement_or_thing_do_not_count() -> None:
    figures = score(unknown=[0, 0, 0], ids=[0, 1, -1], heights=0, valid=[True, False, True])
    assert figures["known_rejected"] == 1.0
    assert figures["unknown_recall"] is None


def found(labels, ids, seconds=1.0):
    evaluator = ObjectsFoundEvaluator(NAMES, ["clutter"])
    for k in range(round(seconds * 10) + 1):
        evaluator.see(k * TENTH, {"clutter": 400})
    labels = np.asarray(labels, dtype=np.int32)
    evaluator.observe(result(labels > 0, labels), np.asarray(ids, dtype=np.int32), np.ones(labels.shape, dtype=bool))
    return evaluator.metrics()["presegmentation.objects_found"].value


def test_objects_are_found_by_one_cluster_that_covers_them() -> None:
    ids = np.zeros((40, 40), dtype=np.int32)
    ids[:20, :20] = 2
    exact = np.where(ids == 2, 3, 0)
    assert found(exact, ids) == 1.0
    swollen = np.zeros_like(ids)
    swollen[:30, :30] = 1
    assert found(swollen, ids) == 0.0
    halves = exact.copy()
    halves[:11, :20] = 4
    assert found(halves, ids) == 1.0
    assert found(np.zeros_like(ids), ids) == 0.0


def test_objects_seen_too_shortly_are_not_asked_for() -> None:
    ids = np.full((40, 40), 2, dtype=np.int32)
    assert found(np.zeros_like(ids), ids, seconds=0.5) is None


def test_shots_are_placed_by_the_sensor_pose_at_their_own_time() -> None:
    count = 1600
    scan = LidarScan(
        0,
        np.tile(np.array([[1.0, 0, 0]], dtype=np.float32), (count, 1)),
        np.full(count, 2.0, dtype=np.float32),
        np.linspace(0, 0.1, count, dtype=np.float32),
        np.zeros(count, dtype=np.uint8),
        np.zeros(count, dtype=np.float32),
        np.eye(4),
    )
    scan.ranges[0] = np.inf
    measured = lidar_measurements(scan, np.eye(4), transform_planar(0.1, 0.0, 0.0), np.zeros(count, dtype=np.int32))
    assert not measured.valid[0]
    assert np.abs(measured.points[1:, 0] - (2.0 + scan.times[1:])).max() < 0.1 / 32 + 1e-6
