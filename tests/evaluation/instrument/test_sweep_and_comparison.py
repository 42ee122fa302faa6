"""Sweeps are read and averaged as they say; comparisons pair what belongs together."""

import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from simtrack.errors import FileFormatError, InvalidValueError, UnknownNameError
from simtrack.evaluation.instrument.cases import Case
from simtrack.evaluation.instrument.comparison import compare, more_is_better, read_run
from simtrack.evaluation.instrument.statistics import difference, estimate
from simtrack.evaluation.instrument.sweep import Axis, parse_axes, sweep
from simtrack.evaluation.metrics import Metrics, measured
from simtrack.report.instrument_pages import write_comparison, write_sweep
from tests.cli.commands import simtrack_command
from tests.evaluation.instrument.fakes import FormulaRunner


def test_axes_are_walked_as_written() -> None:
    assert parse_axes("noise=0:2:3,latency=0.1;0.4") == (
        Axis("noise", (0.0, 1.0, 2.0)),
        Axis("latency", (0.1, 0.4)),
    )
    assert parse_axes("noise=0:3")[0].values == (0.0, 0.75, 1.5, 2.25, 3.0)
    assert parse_axes("occlusion=0:3")[0].values == (0.0, 1.0, 2.0, 3.0)


@pytest.mark.parametrize("text", ["noise", "noise=3:0", "noise=0:2:1", "noise=a", "noise=0;20", "noise=1,noise=2"])
def test_axes_that_cannot_be_are_refused(text: str) -> None:
    with pytest.raises(InvalidValueError):
        parse_axes(text)


def test_an_unknown_axis_is_named() -> None:
    with pytest.raises(UnknownNameError, match="occlusion"):
        parse_axes("weather=0:1")


def recall_of(case: Case) -> Metrics:
    value = 1.0 - 0.1 * case.conditions.noise - 0.01 * case.seed
    return {"tracking.recall": measured(value, "1"), "speed.luck": measured(float("nan"), "s")}


def test_a_point_is_the_median_over_seeds_and_files_have_all_of_it(tmp_path: Path) -> None:
    found = sweep(Case("workbench", seed=1), parse_axes("noise=0:2:3"), 3, FormulaRunner(formula=recall_of))
    (curve,) = found.curves
    assert [point.median for point in curve.points if point] == pytest.approx([0.98, 0.88, 0.78])
    assert all(point is not None and point.low <= point.median <= point.high for point in curve.points)
    write_sweep(Case("workbench"), found, ["tracking.recall"], tmp_path)
    rows = (tmp_path / "sweep.csv").read_text().splitlines()
    assert rows[0].startswith("axis,value,metric") and rows[2].startswith("noise,1,tracking.recall,1,0.88")
    assert json.loads((tmp_path / "sweep.json").read_text())["curves"][0]["axis"] == "noise"
    assert "tracking.recall over noise" in (tmp_path / "sweep.html").read_text()


@given(st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=12))
def test_an_interval_holds_the_median_and_stays_within_the_sample(values: list[float]) -> None:
    found = estimate(values)
    assert found is not None and min(values) <= found.low <= found.high <= max(values)
    assert found.median == pytest.approx(np.median(values))


def test_a_difference_is_significant_where_pairs_agree_and_not_where_they_do_not() -> None:
    rng = np.random.default_rng(0)
    seeds = 10.0 * rng.standard_normal(10)
    gap = difference(seeds + 0.5 + 0.1 * rng.standard_normal(10), seeds)
    assert gap is not None and gap.significant and gap.mean == pytest.approx(0.5, abs=0.1)
    noise = difference(seeds + rng.standard_normal(10), seeds)
    assert noise is not None and noise.low < 0.0 < noise.high and not noise.significant
    few = difference([2.0, 2.0, 2.0], [1.0, 1.0, 1.0])
    assert few is not None and not few.significant


def write_run(
    folder: Path, seed: int, tracker: str | None, recall: float, partial: bool = False, duration: float = 10.0
) -> Path:
    folder.mkdir(parents=True)
    config = {"scene": "workbench", "seed": seed, "duration": duration, "tracker": tracker, "localizer": None,
              "detector": "oracle"}  # fmt: skip
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    rows = {
        "tracking.recall": {"value": recall, "unit": "1"},
        "localization.ate_rmse": {"value": 0.01 * recall, "unit": "m"},
        "run.partial": {"value": partial, "unit": "1"},
    }
    (folder / "metrics.json").write_text(json.dumps(rows))
    return folder


def test_methods_are_paired_by_seed_and_better_is_what_the_metric_says(tmp_path: Path) -> None:
    paths = [write_run(tmp_path / f"own-{seed}", seed, None, 0.9 + 0.01 * seed) for seed in range(6)]
    paths += [write_run(tmp_path / f"icp-{seed}", seed, "icp:Tracker", 0.7 + 0.01 * seed) for seed in range(6)]
    found = compare([read_run(path) for path in paths])
    assert found.methods == ("simtrack", "icp:Tracker")
    recall, error = (
        {row.metric: row for row in found.rows}[name] for name in ("tracking.recall", "localization.ate_rmse")
    )
    gap = recall.cells[1].difference
    assert gap is not None and gap.mean == pytest.approx(-0.2) and recall.cells[1].better is False
    assert error.cells[1].better is True and recall.cells[0].difference is None
    write_comparison(found, ["tracking.recall"], tmp_path / "out")
    assert "icp:Tracker" in (tmp_path / "out" / "comparison.html").read_text()
    assert found.remarks == ()


def test_what_weakens_a_comparison_is_told(tmp_path: Path) -> None:
    own = write_run(tmp_path / "own", 0, None, 0.9)
    icp = write_run(tmp_path / "icp", 0, "icp:Tracker", 0.7, duration=8.0)
    done = simtrack_command("compare", own, icp, "--out", tmp_path / "out", "--metrics", "localization.ate_rmse")
    assert done.returncode == 0, done.stderr
    for text in (
        "runs of workbench are of different duration (8, 10 s)",
        "nothing can be significant between icp:Tracker and simtrack: 1 pair of scene and seed, 5 are needed",
        "simtrack: 1 run\n",
    ):
        assert text in done.stdout
    assert "Runs of workbench are of different duration" in (tmp_path / "out" / "comparison.html").read_text()
    unknown = simtrack_command("compare", own, icp, "--out", tmp_path / "out", "--metrics", "tracking.recal")
    assert unknown.returncode == 2 and "such as tracking.recall" in unknown.stderr
    nothing = simtrack_command("compare")
    assert nothing.returncode == 2 and "RUN_DIR is required: folders of `simtrack run`" in nothing.stderr


def test_what_is_no_run_or_twice_the_same_is_refused(tmp_path: Path) -> None:
    path = write_run(tmp_path / "a", 0, None, 0.9)
    with pytest.raises(InvalidValueError, match="every scene and seed once"):
        compare([read_run(path), read_run(path)])
    with pytest.raises(FileFormatError, match=r"config\.yaml"):
        read_run(tmp_path)
    with pytest.raises(FileFormatError, match="stopped"):
        read_run(write_run(tmp_path / "b", 0, None, 0.9, partial=True))
    with pytest.raises(InvalidValueError):
        compare([])


def test_the_direction_of_known_metrics() -> None:
    assert more_is_better("tracking.add_s_auc") and more_is_better("relations.f1.on")
    assert not more_is_better("tracking.id_switches") and not more_is_better("localization.ate_rmse")
