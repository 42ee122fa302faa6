"""A waterfall's bars sum to the error, and each is what the error loses by its stage."""

from dataclasses import replace

import pytest

from simtrack.errors import UnknownNameError
from simtrack.evaluation.instrument.attribution import MEASURES, REST, STAGES, attribute, variants
from simtrack.evaluation.instrument.cases import Case
from simtrack.evaluation.instrument.conditions import Conditions
from simtrack.evaluation.metrics import Metrics, measured
from simtrack.evaluation.run_config import ORACLE
from tests.evaluation.instrument.fakes import FormulaRunner

BASE = Case("workbench", seed=3, conditions=Conditions(noise=2.0, extrinsics=1.0, detector_bias=0.1))


def error_of(case: Case) -> Metrics:
    """An error to which every stage adds a part of its own."""
    c = case.conditions
    parts = {
        "calibration": 0.02 * abs(c.extrinsics) + 0.001 * c.calibration,
        "noise": 0.0005 * c.noise,
        "models": 0.0002 * c.model_error,
        "latency": 0.0 if c.latency == 0.0 else 0.001,
        "detection": 0.002 * c.detection + 0.1 * c.detector_bias,
        "localization": 0.0 if case.localizer == ORACLE else 0.003,
        REST: 0.0004,
    }
    return {
        "tracking.map.translation_error.median": measured(sum(parts.values()), "m"),
        "tracking.add_s_auc": measured(1.0 - sum(parts.values()), "1"),
    }


def test_bars_are_the_parts_that_the_stages_add() -> None:
    waterfalls = attribute(BASE, FormulaRunner(formula=error_of))
    assert [w.measure for w in waterfalls] == ["tracking.map.translation_error.median", "tracking.add_s_auc"]
    for waterfall in waterfalls:
        assert sum(waterfall.shares.values()) == pytest.approx(waterfall.total)
        assert waterfall.shares == pytest.approx(
            {"calibration": 0.021, "noise": 0.001, "models": 0.0002, "latency": 0.001, "detection": 0.012,
             "localization": 0.003, REST: 0.0004}
        )  # fmt: skip
        lost = {stage: waterfall.total - left for stage, left in waterfall.alone.items()}
        assert lost == pytest.approx({stage: waterfall.shares[stage] for stage in STAGES})
        assert waterfall.largest == "calibration"


def test_all_variants_go_the_way_of_the_measured_run() -> None:
    after, alone = variants(BASE)
    assert all(case.follows == BASE for case in (*after.values(), *alone.values()))
    last = after["localization"]
    assert last.localizer == ORACLE and last.conditions.noise == last.conditions.detection == 0.0
    assert alone["noise"] == replace(BASE, follows=BASE, conditions=replace(BASE.conditions, noise=0.0))


def test_unknown_stages_and_measures_are_named() -> None:
    with pytest.raises(UnknownNameError, match="latency"):
        variants(BASE, ("speed",))
    with pytest.raises(UnknownNameError, match=next(iter(MEASURES))):
        attribute(BASE, FormulaRunner(formula=error_of), measures=("tracking.luck",))
