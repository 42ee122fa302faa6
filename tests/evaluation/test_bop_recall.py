"""BOP's average recall: VSD by its definition, laws of the recall over its thresholds."""

from collections.abc import Iterator

import numpy as np
import pytest

from simtrack.contracts import CameraIntrinsics, Float64, RgbdFrame, Track
from simtrack.evaluation.bop_recall import THRESHOLDS, BopRecall, vsd
from simtrack.evaluation.evaluator import pose_scorers
from simtrack.evaluation.tracking import ObjectFrame
from simtrack.geometry.transforms import perturb
from simtrack.objects import load_object
from simtrack.perception.foreign import track_at

K = CameraIntrinsics(160, 120, 140.0, 140.0, 79.5, 59.5)
MODELS = {name: load_object(name) for name in ("multimeter", "screwdriver")}
SCORERS = pose_scorers(MODELS)
T_TRUE = perturb(np.eye(4), np.array([0.02, 0.01, 0.6, 0.7, 0.4, 0.2]))
NAMES = ("tracking.bop.ar_vsd", "tracking.bop.ar_mssd", "tracking.bop.ar_mspd", "tracking.bop.ar")


def vsd_pixel_by_pixel(est: Float64, true: Float64, test: Float64, tau: float, delta: float) -> float:
    """Equation 1 of the paper, one pixel after the other."""
    costs = []
    for e, t, d in zip(est.ravel(), true.ravel(), test.ravel(), strict=True):
        in_true = t > 0 and (d == 0 or t - d <= delta)
        in_est = e > 0 and (d == 0 or e - d <= delta or in_true)
        if in_true or in_est:
            costs.append(0.0 if in_true and in_est and abs(e - t) < tau else 1.0)
    return float(np.mean(costs)) if costs else 1.0


def test_vsd_is_its_definition() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        est, true, test = (rng.uniform(0.95, 1.05, (6, 7)) * (rng.random((6, 7)) < 0.7) for _ in range(3))
        taus = np.array([0.005, 0.02, 0.06])
        found = vsd(est, true, test, taus, 0.015)
        assert found == pytest.approx([vsd_pixel_by_pixel(est, true, test, tau, 0.015) for tau in taus], abs=1e-12)


def test_vsd_of_nothing_is_one() -> None:
    assert np.array_equal(vsd(np.zeros(3), np.zeros(3), np.ones(3), THRESHOLDS), np.ones(10))


@pytest.fixture
def recall() -> Iterator[BopRecall]:
    built = BopRecall(MODELS, SCORERS)
    yield built
    built.close()


def image() -> RgbdFrame:
    return RgbdFrame(0, np.zeros((120, 160), np.float32), None, K, np.eye(4))


def seen(name: str, T_estimated: Float64 | None, visible: float = 1.0) -> ObjectFrame:
    track: Track | None = None if T_estimated is None else track_at(image(), np.eye(4), 1, name, T_estimated)
    return ObjectFrame(0, name, name, visible, False, T_TRUE, track)


def ar(recall: BopRecall, *frames: ObjectFrame) -> list[float]:
    recall._recalls.clear()
    recall.observe(image(), frames)
    return [float(recall.metrics()[name].value or 0.0) for name in NAMES]


@pytest.mark.parametrize("name", MODELS)
def test_the_true_pose_has_recall_one_and_a_miss_none(name: str, recall: BopRecall) -> None:
    assert ar(recall, seen(name, T_TRUE)) == pytest.approx([1.0] * 4)
    assert ar(recall, seen(name, None)) == [0.0] * 4
    assert ar(recall, seen(name, T_TRUE), seen(name, None)) == pytest.approx([0.5] * 4)
    assert ar(recall, seen(name, None, visible=0.1), seen(name, T_TRUE)) == pytest.approx([1.0] * 4)


def test_a_shift_keeps_the_thresholds_above_it(recall: BopRecall) -> None:
    diameter = MODELS["multimeter"].diameter
    shifted = T_TRUE.copy()
    shifted[2, 3] += 0.22 * diameter
    found = ar(recall, seen("multimeter", shifted))
    assert found[1] == pytest.approx(0.6), "of 0.05 to 0.5 of the diameter, those from 0.25 on"
    assert found[3] == pytest.approx(np.mean(found[:3]))
    worse = shifted.copy()
    worse[0, 3] += 0.3 * diameter
    assert all(w <= f for w, f in zip(ar(recall, seen("multimeter", worse)), found, strict=True))


def test_a_pose_behind_the_camera_is_a_miss_and_no_error(recall: BopRecall) -> None:
    behind = T_TRUE.copy()
    behind[2, 3] = -1.0
    assert ar(recall, seen("multimeter", behind)) == [0.0] * 4


def test_nothing_seen_has_a_reason(recall: BopRecall) -> None:
    assert recall.metrics()["tracking.bop.ar"].reason == "no object was visible enough"
