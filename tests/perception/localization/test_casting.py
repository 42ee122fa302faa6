"""What happens around a cast: thinning, aiming, shots that reach through, correspondences, the kernel's scale."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from simtrack.geometry.transforms import apply, exp_so3, log_so3, perturb, transform, transform_planar
from simtrack.perception.localization.assessment import assess
from simtrack.perception.localization.config import MotionConfig, RegistrationConfig
from simtrack.perception.localization.correspondences import ROWS, kernel_scale
from simtrack.perception.localization.kernels import BLOCK, rotation_vector, thinned_count, turn
from simtrack.perception.localization.measurement import Measurement, deskew
from simtrack.perception.localization.motion import OdometryTrack
from simtrack.perception.localization.registration import register
from simtrack.perception.localization.surface import MapSurface

TRUE = transform_planar(3.0, 2.5, 0.3)


@pytest.fixture(scope="module")
def shots(lab_world) -> Measurement:
    scan = lab_world.scan(lambda t: TRUE, 0.0, np.random.default_rng(0))
    return deskew(scan, OdometryTrack(MotionConfig()), 0.008, 0.3, 100.0)


@pytest.fixture(scope="module")
def surface(lab_world) -> MapSurface:
    return MapSurface(lab_world.static_map)


def rows(count: int, stride: int) -> np.ndarray:
    return np.flatnonzero((np.arange(count) // BLOCK) % stride == 0)


@given(st.integers(0, 300), st.integers(1, 9))
def test_thinning_takes_whole_blocks(count: int, stride: int) -> None:
    assert thinned_count(count, stride) == len(rows(count, stride))


@pytest.mark.parametrize("stride", [1, 3])
def test_a_view_is_what_rays_from_the_pose_meet(surface: MapSurface, shots: Measurement, stride: int) -> None:
    T = perturb(TRUE, np.array([0.03, -0.02, 0.01, 0.01, -0.01, 0.04]))
    view, take = surface.cast(T, shots, stride, reach=np.inf), rows(len(shots), stride)
    assert len(view) == len(take)
    assert np.array_equal(view.ranges, shots.ranges[take])
    assert view.origins == pytest.approx(apply(T, shots.origins[take]), abs=1e-5)
    assert view.directions == pytest.approx(shots.directions[take] @ T[:3, :3].T, abs=1e-6)
    hits = surface.scene.cast_rays(view.origins, view.directions)
    facing = np.einsum("ij,ij->i", hits.normals, view.directions) < 0.0
    assert facing.mean() > 0.99
    assert np.array_equal(view.hits.faces[facing], hits.faces[facing])
    assert view.hits.distances[facing] == pytest.approx(hits.distances[facing], abs=1e-5)
    assert not view.passed.any()


def test_a_smaller_view_after_a_larger_one_is_the_same_as_before_it(surface: MapSurface, shots: Measurement) -> None:
    """Casts share their arrays."""
    few = shots.thinned(7)
    before = surface.cast(TRUE, few)
    kept = before.hits.distances.copy(), before.passed.copy()
    surface.cast(transform_planar(1.0, 1.0, 2.0), shots)
    after = surface.cast(TRUE, few)
    assert np.array_equal(after.hits.distances, kept[0])
    assert np.array_equal(after.passed, kept[1])


def test_correspondences_are_whitened_by_the_sensor_and_by_what_a_patch_shares(
    surface: MapSurface, shots: Measurement
) -> None:
    T = perturb(TRUE, np.array([0.02, 0.01, 0.0, 0.0, 0.0, 0.01]))
    view = surface.cast(T, shots, 5)
    pairs, count = surface.pair(T, view, 0.1, 0.001)
    assert 0.8 * len(view) < count <= len(view)
    q, normals, e, weights, shared = pairs[:3, :count].T, pairs[3:6, :count].T, *pairs[6:9, :count]
    assert np.linalg.norm(normals, axis=1) == pytest.approx(np.ones(count), abs=1e-5)
    assert np.abs(e).max() <= 0.1
    ends = view.origins + view.ranges[:, None] * view.directions - T[:3, 3]
    assert min(np.abs(ends - point).max(axis=1).min() for point in q[::500]) < 1e-5
    rays = surface.patch_variance * shared  # 1 / n, as the weight of the map alone is 1 / (n variance)
    assert np.abs(1.0 / rays - np.round(1.0 / rays)).max() < 1e-2
    assert (weights < shared).all()
    own = 1.0 / weights - 1.0 / shared
    assert own.min() > 0.0
    assert own.max() < 1.2 * (0.008**2 + (0.001 * view.ranges.max()) ** 2)


@given(st.integers(0, 2**32 - 1), st.floats(0.005, 0.3))
def test_scale_of_the_kernel_is_three_medians(seed: int, spread: float) -> None:
    rng = np.random.default_rng(seed)
    pairs = np.zeros((ROWS, 4000), np.float32)
    pairs[3], pairs[6] = 1.0, spread * rng.standard_normal(4000)
    pairs[:, 3000:] = np.nan
    shift = np.array([0.01, 0.5, -0.5])  # the planes face x
    median = float(np.median(np.abs(pairs[6, :3000:2] + 0.01)))
    found = kernel_scale(pairs, 3000, np.zeros((3, 3)), shift, 0.02, 1.0)
    assert found == pytest.approx(min(max(3.0 * median, 0.02), 1.0), abs=1.0 / 500 + 0.01 * median)


@given(st.lists(st.floats(-1.0, 1.0), min_size=6, max_size=6))
def test_compiled_rotations_are_those_of_the_geometry(numbers: list[float]) -> None:
    phi, psi = np.array(numbers[:3]), np.array(numbers[3:])
    R, out = exp_so3(psi), np.empty((3, 3))
    turn(phi[0], phi[1], phi[2], R, out)
    assert out == pytest.approx(exp_so3(phi) @ R, abs=1e-12)
    assert rotation_vector(transform(out), transform(R)) == pytest.approx(log_so3(out @ R.T), abs=1e-9)


def test_registration_judges_its_pose_as_a_cast_of_its_own_would(surface: MapSurface, shots: Measurement) -> None:
    start = perturb(TRUE, np.array([0.01, -0.01, 0.0, 0.0, 0.0, 0.005]))
    covariance = np.diag(np.square([0.02, 0.02, 0.01, 0.01, 0.01, 0.01]))
    found = register(shots, surface, start, covariance, RegistrationConfig(), assessed=True)
    again = assess(shots, surface, found.T_map_base)
    assert found.assessment is not None
    assert found.assessment.explained == pytest.approx(again.explained, abs=0.02)
    assert found.assessment.structure == pytest.approx(again.structure, abs=0.02)
    same = register(shots, surface, start, covariance, RegistrationConfig(), assessed=True)
    assert same.T_map_base.tobytes() == found.T_map_base.tobytes()
    assert same.covariance.tobytes() == found.covariance.tobytes()
