"""Assertions on runs fail when they should, say why, and read their expressions strictly."""

from pathlib import Path

import pytest

from simtrack.errors import FileFormatError, InvalidValueError
from simtrack.evaluation.instrument.cases import Case
from simtrack.evaluation.metrics import Metrics, measured, unmeasured
from simtrack.testing import Runs, assert_metrics, assert_no_regression
from simtrack.testing.assertions import Bound
from tests.evaluation.instrument.fakes import FormulaRunner


def runs(offset: float = 0.0) -> Runs:
    def formula(case: Case) -> Metrics:
        return {
            "tracking.recall": measured(0.9 + 0.01 * case.seed + offset, "1"),
            "localization.ate_rmse": measured(0.004 + 0.001 * case.seed - 0.01 * offset, "m"),
            "loop.gaze_gain": unmeasured("1", "not run"),
        }

    return Runs(Case("workbench"), FormulaRunner(formula=formula))


def test_bounds_hold_over_seeds_in_their_units() -> None:
    assert_metrics(runs(), "tracking.recall >= 0.92", "worst tracking.recall >= 0.9", seeds=5)
    assert_metrics(runs(), "localization.ate_rmse <= 6 mm", "worst localization.ate_rmse <= 8 mm", seeds=5)
    assert_metrics(runs(), "mean tracking.recall > 0.899", "tracking.recall == 0.9")


def test_a_broken_bound_tells_every_seed() -> None:
    with pytest.raises(AssertionError, match=r"worst is 0\.9 \(seed 0: 0\.9, seed 1: 0\.91\)"):
        assert_metrics(runs(), "worst tracking.recall >= 0.95", seeds=2)
    with pytest.raises(AssertionError, match="not measured"):
        assert_metrics(runs(), "loop.gaze_gain > 0")


def test_a_unit_has_to_fit_its_metric_and_values_are_told_in_it() -> None:
    with pytest.raises(InvalidValueError, match=r"tracking\.recall without a unit"):
        assert_metrics(runs(), "tracking.recall >= 5 mm")
    with pytest.raises(InvalidValueError, match="in mm or cm"):
        assert_metrics(runs(), "localization.ate_rmse <= 1 deg")
    with pytest.raises(AssertionError, match=r"median is 4 mm \(seed 0: 4 mm\)"):
        assert_metrics(runs(), "localization.ate_rmse <= 1 mm")


@pytest.mark.parametrize("text", ["tracking.recall", "tracking.recall => 1", "recall >= many", "best recall > 1"])
def test_an_expression_that_is_none_is_refused(text: str) -> None:
    with pytest.raises(InvalidValueError, match="METRIC"):
        Bound.of(text)


def test_an_unknown_metric_is_named_with_those_there_are() -> None:
    with pytest.raises(InvalidValueError, match=r"tracking\.recall"):
        assert_metrics(runs(), "tracking.luck > 0")


def test_results_are_stored_once_and_then_compared(tmp_path: Path) -> None:
    stored = tmp_path / "bands" / "workbench.json"
    names = ("tracking.recall", "localization.ate_rmse")
    assert_no_regression(runs(), stored, *names, seeds=6)
    assert_no_regression(runs(), stored, seeds=6)
    assert_no_regression(runs(0.02), stored, seeds=6)
    with pytest.raises(AssertionError, match=r"tracking\.recall: .* significantly worse"):
        assert_no_regression(runs(-0.02), stored, seeds=6)
    with pytest.raises(AssertionError, match="by more than 5%"):
        assert_no_regression(runs(-0.1), stored, seeds=3)
    assert_no_regression(runs(-0.1), stored, *names, seeds=6, store=True)
    assert_no_regression(runs(-0.1), stored, seeds=6)
    with pytest.raises(FileFormatError, match=r"relations\.f1"):
        assert_no_regression(runs(), stored, "relations.f1")
    stored.write_text("[]")
    with pytest.raises(FileFormatError):
        assert_no_regression(runs(), stored)
