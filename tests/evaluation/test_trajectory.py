"""Trajectory errors: nothing is aligned away, and metrics survive the disk."""

import json

import numpy as np
import pytest

from simtrack.contracts import Localization, Status
from simtrack.errors import FileFormatError
from simtrack.evaluation.metrics import Metric, measured, quantile, read_metrics, write_metrics
from simtrack.evaluation.trajectory import TrajectoryEvaluator
from simtrack.geometry.transforms import perturb, transform_planar

TENTH = 100_000_000


def drive(offset: tuple[float, float, float], frames: int = 30) -> TrajectoryEvaluator:
    evaluator = TrajectoryEvaluator()
    for k in range(frames):
        true = transform_planar(0.05 * k, 0.0, 0.0)
        estimated = transform_planar(0.05 * k + offset[0], offset[1], offset[2])
        evaluator.observe(k * TENTH, Localization(k * TENTH, estimated, np.eye(6), Status.OK), true)
    return evaluator


def test_a_constant_shift_is_an_absolute_error_and_no_relative_one() -> None:
    metrics = drive((0.03, 0.04, 0.0)).metrics()
    assert metrics["localization.ate_rmse"].value == pytest.approx(0.05)
    assert metrics["localization.rotation_rmse"].value == pytest.approx(0.0, abs=1e-9)
    assert metrics["localization.rpe.translation.median"].value == pytest.approx(0.0, abs=1e-9)
    assert metrics["localization.distance_driven"].value == pytest.approx(29 * 0.05)


def test_a_wrong_heading_is_a_rotation_error() -> None:
    assert drive((0.0, 0.0, 0.02)).metrics()["localization.rotation_rmse"].value == pytest.approx(0.02)


def test_what_was_believed_before_the_first_scans_were_matched_is_no_error() -> None:
    evaluator = TrajectoryEvaluator(since=5 * TENTH)
    for k in range(30):
        status, off = (Status.DEGRADED, 0.5) if k < 3 else (Status.OK, 0.01)
        evaluator.observe(k * TENTH, Localization(k * TENTH, transform_planar(off, 0, 0), np.eye(6), status), np.eye(4))
    metrics = evaluator.metrics()
    assert metrics["localization.ate_max"].value == pytest.approx(0.01)
    assert metrics["localization.rpe.translation.rmse"].value == pytest.approx(0.0, abs=1e-9)
    assert metrics["localization.first_trusted"].value == pytest.approx(0.3)
    assert metrics["localization.trusted_share"].value == pytest.approx(0.9)


def test_short_runs_say_why_something_is_missing() -> None:
    metrics = drive((0.0, 0.0, 0.0), frames=3).metrics()
    assert metrics["localization.rpe.translation.median"].value is None
    assert "shorter" in metrics["localization.rpe.translation.median"].reason
    assert drive((0.0, 0.0, 0.0), frames=0).metrics()["localization.ate_rmse"].value is None


def test_metrics_come_back_from_the_disk_and_are_never_nan(tmp_path) -> None:
    metrics = {"a": measured(1.5, "m"), "b": measured(np.int64(3), "1"), "c": measured(float("nan"), "s")}
    metrics["d"] = quantile([], 0.5, "m", "nothing there")
    path = tmp_path / "metrics.json"
    write_metrics(path, metrics)
    assert read_metrics(path) == metrics
    assert json.loads(path.read_text())["a"] == {"value": 1.5, "unit": "m"}
    assert metrics["c"].value is None
    assert metrics["d"] == Metric(None, "m", "nothing there")
    assert [p.name for p in tmp_path.iterdir()] == ["metrics.json"]


@pytest.mark.parametrize("text", ["", "[]", '{"a": 1}', '{"a": {"value": 1}}'])
def test_broken_metrics_name_the_file(tmp_path, text: str) -> None:
    path = tmp_path / "metrics.json"
    path.write_text(text)
    with pytest.raises(FileFormatError, match=r"metrics\.json"):
        read_metrics(path)


def test_errors_are_those_of_evo() -> None:
    """Values of evo 1.38.1: APE without alignment; RPE over 10 frames, all pairs (`evo_rpe -d 10 -u f --all_pairs`)."""
    rng = np.random.default_rng(7)
    true = [np.eye(4)]
    for _ in range(39):
        true.append(true[-1] @ perturb(np.eye(4), rng.normal(0, [0.05, 0.02, 0.01, 0.02, 0.02, 0.1])))
    evaluator = TrajectoryEvaluator()
    for k, T in enumerate(true):
        estimated = perturb(T, rng.normal(0, [0.004, 0.004, 0.002, 0.003, 0.003, 0.01]))
        evaluator.observe(k * TENTH, Localization(k * TENTH, estimated, np.eye(6), Status.OK), T)
    metrics = evaluator.metrics()
    evo = {
        "ate_rmse": 0.0058277654602230415, "ate_max": 0.010575264290463, "rotation_rmse": 0.009822227519871777,
        "rotation_max": 0.020421262878750887, "rpe.translation.rmse": 0.00813936843809109,
        "rpe.translation.median": 0.00734686874279447, "rpe.rotation.rmse": 0.013106419396914818,
        "rpe.rotation.median": 0.01037320729759826,
    }  # fmt: skip
    for name, value in evo.items():
        assert metrics[f"localization.{name}"].value == pytest.approx(value, rel=1e-9), name
