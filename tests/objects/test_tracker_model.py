"""The tracker's copy of an object differs from it, within stated bounds."""

import numpy as np
import pytest

from simtrack.errors import InvalidValueError
from simtrack.geometry import meshes
from simtrack.objects import EXACT, TrackerModelConfig, load_object, tracker_model
from simtrack.objects.model import box_keypoints
from tests.objects.distances import surface_distances


def test_default_model_is_a_decimated_noisy_scan() -> None:
    true = load_object("relay")
    model = tracker_model(true, TrackerModelConfig(max_scale_error=0.0), np.random.default_rng(3))
    assert len(model.mesh.faces) == pytest.approx(0.5 * len(true.mesh.faces), rel=0.02)
    points, _ = meshes.sample_surface(model.mesh, 400, np.random.default_rng(4))
    distances = surface_distances(points, true.visual)
    assert 0.00015 < np.sqrt(np.mean(distances**2)) < 0.00045
    assert distances.max() < 0.003
    assert model.collision == ()


def test_noise_has_the_stated_deviation_along_the_normals_and_is_smooth() -> None:
    true = load_object("klt3147")
    deviations = []
    for seed in range(5):
        config = TrackerModelConfig(noise=0.0005, max_scale_error=0.0, face_share=1.0)
        model = tracker_model(true, config, np.random.default_rng(seed))
        normals = meshes.vertex_normals(true.mesh)
        offsets = np.einsum("ij,ij->i", model.mesh.vertices - true.mesh.vertices, normals)
        np.testing.assert_allclose(model.mesh.vertices, true.mesh.vertices + offsets[:, None] * normals, atol=1e-9)
        deviations.append(offsets.std())
        ends = true.mesh.faces[:, :2]
        near = np.linalg.norm(np.diff(true.mesh.vertices[ends], axis=1)[:, 0], axis=1) < 0.001
        assert np.abs(np.diff(offsets[ends[near]], axis=1)).mean() < 0.3 * offsets.std()
    assert np.mean(deviations) == pytest.approx(0.0005, rel=0.15)


def test_scale_error_stays_within_its_bound_and_is_used() -> None:
    true = load_object("mug")
    config = TrackerModelConfig(noise=0.0, face_share=1.0)
    scales = [tracker_model(true, config, np.random.default_rng(s)).extents / true.extents for s in range(15)]
    errors = np.array(scales) - 1.0
    np.testing.assert_allclose(errors, errors[:, :1] * np.ones(3), atol=1e-12)
    assert np.abs(errors).max() <= 0.003
    assert errors.min() < -0.001 and errors.max() > 0.001


def test_box_and_keypoints_are_the_models_own() -> None:
    true = load_object("multimeter")
    model = tracker_model(true, TrackerModelConfig(), np.random.default_rng(0))
    assert not np.array_equal(model.extents, true.extents)
    np.testing.assert_array_equal(model.extents, model.mesh.extents)
    np.testing.assert_array_equal(model.keypoints, box_keypoints(model.extents))
    assert model.diameter == meshes.diameter(model.mesh)
    np.testing.assert_allclose(model.mesh.bounds.mean(axis=0), 0.0, atol=0.002)


def test_same_generator_same_model_and_exact_is_exact() -> None:
    true = load_object("mug")
    a, b = (tracker_model(true, TrackerModelConfig(), np.random.default_rng(9)) for _ in range(2))
    np.testing.assert_array_equal(a.mesh.vertices, b.mesh.vertices)
    exact = tracker_model(true, EXACT, np.random.default_rng(9))
    np.testing.assert_array_equal(exact.mesh.vertices, true.mesh.vertices)
    np.testing.assert_array_equal(exact.keypoints, true.keypoints)


def test_settings_do_not_change_what_else_is_drawn() -> None:
    states = []
    for config in (TrackerModelConfig(), EXACT):
        rng = np.random.default_rng(5)
        tracker_model(load_object("mug"), config, rng)
        states.append(rng.random())
    assert states[0] == states[1]


@pytest.mark.parametrize(
    ("field", "value"),
    [("noise", -1.0), ("noise", np.nan), ("max_scale_error", 2.0), ("face_share", 0.0), ("correlation_length", 0.0)],
)
def test_values_outside_their_domain_are_refused(field: str, value: float) -> None:
    with pytest.raises(InvalidValueError, match=f"TrackerModelConfig.{field}"):
        TrackerModelConfig(**{field: value})  # pyright: ignore[reportArgumentType]
