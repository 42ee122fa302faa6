"""Laws of the pose errors, and agreement with bop_toolkit where its reference values are at hand."""

import json
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from simtrack.contracts import CameraIntrinsics, Float64
from simtrack.evaluation import pose_errors
from simtrack.geometry.transforms import exp_so3, transform


@dataclass(frozen=True)
class Axis:
    axis: Float64
    offset: Float64


@dataclass(frozen=True)
class Symmetries:
    discrete: Float64
    axes: tuple[Axis, ...] = ()


Z = np.array([0.0, 0.0, 1.0])
HALF_TURN = transform(exp_so3(np.pi * Z))
NONE = Symmetries(np.eye(4)[None])
TWO_FOLD = Symmetries(np.stack([np.eye(4), HALF_TURN]))
CONTINUOUS = Symmetries(np.eye(4)[None], (Axis(Z, np.zeros(3)),))

vectors = st.tuples(*[st.floats(-1.0, 1.0)] * 3).map(np.array)


def reference() -> dict:
    root = os.environ.get("SIMTRACK_REFERENCE", str(Path(__file__).parents[3] / "shared" / "reference"))
    path = Path(root) / "bop_pose_errors.json"
    if not path.is_file():
        pytest.skip("the reference values of bop_toolkit are not at hand (SIMTRACK_REFERENCE)")
    return json.loads(path.read_text())


def test_equals_bop_toolkit() -> None:
    data = reference()
    k = data["K"]
    intrinsics = CameraIntrinsics(640, 480, k[0], k[4], k[2], k[5])
    models = {}
    for key, model in data["models"].items():
        info = model["info"]
        discrete = [np.eye(4), *(np.reshape(s, (4, 4)) for s in info.get("symmetries_discrete", []))]
        axes = [Axis(np.array(a["axis"]), np.array(a["offset"])) for a in info.get("symmetries_continuous", [])]
        symmetries = Symmetries(np.stack(discrete).astype(float), tuple(axes))
        models[int(key)] = np.array(model["points"]), pose_errors.equivalents(symmetries, 0.01)
    assert len(data["cases"]) == 60
    for case in data["cases"]:
        points, equivalents = models[case["obj_id"]]
        T_est = transform(np.reshape(case["R_est"], (3, 3)), tuple(np.ravel(case["t_est"])))
        T_true = transform(np.reshape(case["R_gt"], (3, 3)), tuple(np.ravel(case["t_gt"])))
        ours = {
            "add": pose_errors.add(T_est, T_true, points),
            "adi": pose_errors.add_s(T_est, T_true, points),
            "mssd": pose_errors.mssd(T_est, T_true, points, equivalents),
            "mspd": pose_errors.mspd(T_est, T_true, points, equivalents, intrinsics),
            "re_deg": np.degrees(pose_errors.rotation_error(T_est, T_true)),
            "te": pose_errors.translation_error(T_est, T_true),
        }
        for name, value in ours.items():
            assert value == pytest.approx(case[name], rel=1e-6), (name, case["obj_id"])


@settings(max_examples=50)
@given(vectors, vectors, vectors)
def test_symmetric_equivalents_have_no_error(phi: Float64, t: Float64, turn: Float64) -> None:
    T = transform(exp_so3(3.0 * phi), tuple(t))
    assert pose_errors.rotation_error(T @ HALF_TURN, T, TWO_FOLD) == pytest.approx(0.0, abs=1e-7)
    spun = T @ transform(exp_so3(turn[0] * 3.0 * Z))
    assert pose_errors.rotation_error(spun, T, CONTINUOUS) == pytest.approx(0.0, abs=1e-7)
    sphere = Symmetries(np.eye(4)[None], (Axis(Z, np.zeros(3)), Axis(np.array([1.0, 0, 0]), np.zeros(3))))
    assert pose_errors.rotation_error(T @ transform(exp_so3(turn)), T, sphere) == pytest.approx(0.0, abs=1e-7)


@settings(max_examples=30)
@given(vectors, vectors)
def test_continuous_axis_is_not_worse_than_a_fine_search(phi: Float64, psi: Float64) -> None:
    T_true, T_est = transform(exp_so3(2.0 * phi)), transform(exp_so3(2.0 * psi))
    exact = pose_errors.rotation_error(T_est, T_true, CONTINUOUS)
    searched = min(pose_errors.rotation_error(T_est, T_true @ S) for S in pose_errors.equivalents(CONTINUOUS, 0.01))
    assert exact <= searched + 1e-9
    assert searched - exact < 0.011


def test_axis_beside_the_origin_moves_the_origin_with_the_turn() -> None:
    offset = np.array([0.1, 0.0, 0.0])
    symmetries = Symmetries(np.eye(4)[None], (Axis(Z, offset),))
    turned = pose_errors.equivalents(symmetries)[40]
    scorer = pose_errors.PoseScorer(np.random.default_rng(0).normal(size=(50, 3)), symmetries, 1.0)
    assert scorer.errors(turned, np.eye(4)) == pytest.approx((0.0, 0.0), abs=1e-7)


def test_add_s_never_exceeds_add() -> None:
    rng = np.random.default_rng(1)
    points = rng.normal(size=(300, 3))
    for _ in range(10):
        T_est, T_true = (transform(exp_so3(rng.normal(size=3)), tuple(rng.normal(size=3))) for _ in range(2))
        assert pose_errors.add_s(T_est, T_true, points) <= pose_errors.add(T_est, T_true, points) + 1e-12


def test_scorer_takes_add_or_add_s_by_symmetry() -> None:
    points = np.random.default_rng(2).normal(size=(500, 3))
    plain, symmetric = (pose_errors.PoseScorer(points, s, 1.0) for s in (NONE, TWO_FOLD))
    T = transform(exp_so3(0.3 * Z), (0.1, 0.0, 0.0))
    assert plain.add(T, np.eye(4)) == pytest.approx(pose_errors.add(T, np.eye(4), points))
    assert symmetric.add(T, np.eye(4)) == pytest.approx(pose_errors.add_s(T, np.eye(4), points))


def test_area_under_the_curve() -> None:
    assert pose_errors.auc(np.array([0.0, 0.05, 0.1, np.inf])) == pytest.approx((1.0 + 0.5 + 0.0 + 0.0) / 4)
    with pytest.raises(ValueError, match="at least one"):
        pose_errors.auc(np.empty(0))
