import importlib.util
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from simtrack.errors import InvalidValueError
from simtrack.geometry.transforms import angle_between, inverse, look_at
from simtrack.objects import load_object
from simtrack.perception.tracking.association import nearest_equivalent
from simtrack.perception.tracking.registration import Registration, RegistrationConfig, Step
from simtrack.perception.tracking.target import tracked_model
from simtrack.raycast import TriangleMesh
from simtrack.sensors.depth_noise import PRESETS, apply_depth_noise

spec = importlib.util.spec_from_file_location("bench_scenes", Path(__file__).with_name("scenes.py"))
assert spec is not None and spec.loader is not None
scenes = importlib.util.module_from_spec(spec)
spec.loader.exec_module(scenes)


def _errors(T: np.ndarray, T_true: np.ndarray, name: str) -> tuple[float, float]:
    T = nearest_equivalent(T, T_true, load_object(name))
    return float(np.linalg.norm(T[:3, 3] - T_true[:3, 3])), angle_between(T[:3, :3], T_true[:3, :3])


@pytest.mark.parametrize("name", ["multimeter", "powerdrill", "materialbox", "screwdriver"])
@pytest.mark.parametrize("seed", range(2))
def test_exact_data_is_registered_exactly(name: str, seed: int) -> None:
    """Noise off, exact models, start 2 cm and 5 degrees off: at most 0.1 mm and 0.05 degrees remain."""
    rng = np.random.default_rng([seed, len(name)])
    model, world = load_object(name), scenes.BenchWorld()
    T = scenes.on_bench(model, rng.uniform(-0.2, 0.2), rng.uniform(-0.1, 0.2), rng.uniform(-3, 3))
    world.add(model, T)
    T_true = scenes.in_camera(T)
    result = scenes.register(name, world.depth(), scenes.displaced(T_true, 0.02, 5.0, rng))
    translation, rotation = _errors(result.T_camera_object, T_true, name)
    assert translation <= 1e-4
    assert rotation <= np.deg2rad(0.05)
    assert result.support > 0.98
    assert result.misfit < 0.05


def test_noise_leaves_millimetres_and_the_covariance_tells() -> None:
    rng = np.random.default_rng(5)
    model, world = load_object("powerdrill"), scenes.BenchWorld()
    T = scenes.on_bench(model, 0.0, 0.0, 0.7)
    world.add(model, T)
    exact, T_true = world.depth(), scenes.in_camera(T)
    errors, sigmas = [], []
    for _ in range(8):
        depth = apply_depth_noise(exact, None, scenes.INTRINSICS, PRESETS["xtion"], rng)
        result = scenes.register("powerdrill", depth, scenes.displaced(T_true, 0.005, 2.0, rng))
        errors.append(result.T_camera_object[:3, 3] - T_true[:3, 3])
        sigmas.append(np.sqrt(np.diag(result.covariance)[:3]))
    rms = np.sqrt(np.mean(np.square(errors)))
    assert rms < 0.0025
    assert 0.2 < rms / np.mean(sigmas) < 2.5


def test_an_occluder_does_not_move_what_it_hides() -> None:
    rng = np.random.default_rng(6)
    model, world = load_object("multimeter"), scenes.BenchWorld()
    T = scenes.on_bench(model, 0.0, 0.1, 0.4)
    world.add(model, T)
    depth = world.depth()
    T_true = scenes.in_camera(T)
    free = scenes.register("multimeter", depth, T_true)
    rows, columns = np.nonzero(np.abs(depth - T_true[2, 3]) < 0.05)
    depth[:, : int(np.median(columns[np.abs(rows - np.median(rows)) < 20]))] -= np.float32(0.15)
    result = scenes.register("multimeter", depth, scenes.displaced(T_true, 0.005, 1.0, rng))
    translation, rotation = _errors(result.T_camera_object, T_true, "multimeter")
    assert result.occluded > 0.2 * result.rays
    assert result.supported < free.supported
    assert translation < 0.001
    assert rotation < np.deg2rad(0.5)


def test_fingers_before_a_thing_draw_it_less_than_what_stood_behind_it_would() -> None:
    """Two fingers lie across a relay, two metres away: their readings are near enough to be taken for its own."""
    model, eye = load_object("relay"), look_at(np.array([0.0, -2.0, 1.85]), np.array([0.0, 0.1, scenes.BENCH]))
    errors: dict[float, list[float]] = {0.5: [], 1.0: []}
    for seed in range(8):
        rng = np.random.default_rng(seed)
        world, T = scenes.BenchWorld(), scenes.on_bench(model, rng.uniform(-0.1, 0.1), 0.0, rng.uniform(-3, 3))
        world.add(model, T)
        for x in (-0.012, 0.012):
            finger = trimesh.creation.box((0.018, 0.14, 0.016))
            finger.apply_translation(T[:3, 3] + (x, 0.0, 0.5 * model.extents[2] + 0.008))
            world.scene.add(TriangleMesh(finger.vertices, finger.faces))
        depth = apply_depth_noise(world.depth(eye), None, scenes.INTRINSICS, PRESETS["xtion"], rng)
        T_true = inverse(eye) @ T
        start = scenes.displaced(T_true, 0.006, 3.0, rng)
        for front, found in errors.items():
            result = scenes.register("relay", depth, start, RegistrationConfig(front=front))
            found.append(float(np.linalg.norm(result.T_camera_object[:3, 3] - T_true[:3, 3])))
    assert np.median(errors[0.5]) < 0.6 * np.median(errors[1.0])
    with pytest.raises(InvalidValueError, match="front"):
        RegistrationConfig(front=0.0)


def test_a_model_where_nothing_stands_is_seen_through() -> None:
    world = scenes.BenchWorld()
    T = scenes.in_camera(scenes.on_bench(load_object("powerdrill"), 0.0, 0.0, 0.0))
    registration = Registration()
    registration.add(1, tracked_model(load_object("powerdrill")))
    result = registration.assess(world.depth(), scenes.INTRINSICS, {1: T})[1]
    registration.close()
    assert result.missing > 0.7 * result.rays
    assert result.support < 0.3
    np.testing.assert_allclose(result.T_camera_object, T, atol=1e-12)


def test_umeyama_converges_too_but_more_slowly() -> None:
    rng = np.random.default_rng(7)
    model, world = load_object("powerdrill"), scenes.BenchWorld()
    T = scenes.on_bench(model, 0.0, 0.0, 0.5)
    world.add(model, T)
    T_true = scenes.in_camera(T)
    start = scenes.displaced(T_true, 0.01, 2.0, rng)
    schedule = (Step(gate=0.03, kernel=8.0, edge_reach=8, silhouettes="never", repeats=3),)
    kept = {}
    for config in (
        RegistrationConfig(solver="gauss-newton", schedule=schedule, inner_iterations=3),
        RegistrationConfig(solver="umeyama", schedule=schedule, inner_iterations=10),
    ):
        kept[config.solver] = _errors(
            scenes.register("powerdrill", world.depth(), start, config).T_camera_object, T_true, "powerdrill"
        )
    assert kept["umeyama"][0] < 0.008
    assert kept["gauss-newton"][0] < kept["umeyama"][0]


def test_nothing_in_view_gives_no_result_and_bad_settings_are_refused() -> None:
    behind = np.eye(4)
    behind[2, 3] = -1.0
    registration = Registration()
    registration.add(1, tracked_model(load_object("relay")))
    assert registration.register(np.ones((240, 320), np.float32), scenes.INTRINSICS, {1: behind}) == {}
    registration.close()
    with pytest.raises(InvalidValueError, match="gauss-newton, umeyama"):
        RegistrationConfig(solver="magic")  # type: ignore[arg-type]
    with pytest.raises(InvalidValueError, match="schedule"):
        RegistrationConfig(schedule=())


def test_fine_casts_that_would_have_no_rays_are_refused() -> None:
    fine = Step(gate=0.006, kernel=3.0, edge_reach=5, fine=True)
    with pytest.raises(InvalidValueError, match="only as `finish`"):
        RegistrationConfig(near=fine)
    with pytest.raises(InvalidValueError, match="repeats=1"):
        RegistrationConfig(finish=Step(gate=0.006, kernel=3.0, edge_reach=5, fine=True, repeats=2))


def test_who_has_no_patience_gets_what_the_finish_would_have_started_from() -> None:
    rng = np.random.default_rng(9)
    model, world = load_object("relay"), scenes.BenchWorld()
    T = scenes.on_bench(model, 0.0, 0.1, 0.4)
    world.add(model, T)
    depth = apply_depth_noise(world.depth(), None, scenes.INTRINSICS, PRESETS["xtion"], rng)
    T_start = scenes.displaced(scenes.in_camera(T), 0.004, 1.0, rng)

    def tracked(**changes: object) -> np.ndarray:
        registration = Registration(replace(RegistrationConfig(), **changes))
        registration.add(0, tracked_model(model))
        result = registration.track(depth, scenes.INTRINSICS, {0: T_start})[0]
        registration.close()
        return result.T_camera_object

    assert np.array_equal(tracked(patience=0.0), tracked(finish=None))
    assert np.array_equal(tracked(patience=60.0), tracked())
    assert not np.array_equal(tracked(patience=0.0), tracked())
    with pytest.raises(InvalidValueError, match="patience"):
        RegistrationConfig(patience=-1.0)
