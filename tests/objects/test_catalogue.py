"""The procedural catalogue: true shapes, true symmetries, sound physics, the same every time."""

import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from simtrack.errors import UnknownNameError
from simtrack.geometry import meshes
from simtrack.geometry.transforms import apply
from simtrack.objects import BUILT_IN, CLUTTER, SEMANTIC_CLASSES, ObjectModel, catalogue, load_object, registry
from simtrack.objects.registry import build_procedural
from tests.objects.distances import surface_distances
from tests.objects.physics import stand_on_plane

NAMES = (*BUILT_IN, *CLUTTER)
TABLE_I = {"multimeter": 100338, "screwdriver": 26682, "materialbox": 13617, "klt3147": 14124, "relay": 9312}
HALF_TURNS = {"x": np.diag([1.0, -1, -1, 1]), "y": np.diag([-1.0, 1, -1, 1]), "z": np.diag([-1.0, -1, 1, 1])}


@pytest.fixture(params=NAMES)
def model(request: pytest.FixtureRequest) -> ObjectModel:
    return load_object(request.param)


def test_the_catalogue_lists_all_and_only_its_designs() -> None:
    from simtrack.objects.designs import DESIGNS

    assert set(catalogue()) == set(NAMES) == set(DESIGNS)
    assert len(CLUTTER) >= 7


def test_unknown_names_are_answered_with_the_known_ones() -> None:
    with pytest.raises(UnknownNameError, match=r"unknown object 'hammer'. Known: .*klt3147.*thermos"):
        load_object("hammer")


def test_meshes_are_closed_and_wind_outwards(model: ObjectModel) -> None:
    for mesh in (model.mesh, model.visual, *model.collision):
        meshes.validate(mesh, model.name)
        assert meshes.is_closed(mesh)
        assert meshes.volume(mesh) > 0.0


def test_face_counts(model: ObjectModel) -> None:
    assert len(model.visual.faces) <= 3100
    assert model.visual.face_colors is not None and model.mesh.face_colors is not None
    assert len(np.unique(model.visual.face_colors, axis=0)) >= 2
    if model.name in TABLE_I:
        assert len(model.mesh.faces) == pytest.approx(TABLE_I[model.name], rel=1e-3)
    if model.name == "powerdrill":
        assert 2000 <= len(model.mesh.faces) <= 20_000


def test_light_and_full_mesh_are_one_surface(model: ObjectModel) -> None:
    points, _ = meshes.sample_surface(model.mesh, 60, np.random.default_rng(0))
    assert surface_distances(points, model.visual).max() < 1e-7
    assert meshes.volume(model.mesh) == pytest.approx(meshes.volume(model.visual), rel=1e-9)
    assert meshes.area(model.mesh) == pytest.approx(meshes.area(model.visual), rel=1e-9)


def test_frame_and_box(model: ObjectModel) -> None:
    np.testing.assert_allclose(model.mesh.bounds.sum(axis=0), 0.0, atol=1e-9)
    np.testing.assert_allclose(model.extents, model.mesh.extents)
    np.testing.assert_allclose(np.abs(model.keypoints[:8]), np.tile(0.5 * model.extents, (8, 1)))
    assert model.extents.max() < model.diameter <= np.linalg.norm(model.extents) + 1e-12
    assert model.semantic_class in SEMANTIC_CLASSES


def test_clutter_is_large_enough_to_be_found_and_not_trackable(model: ObjectModel) -> None:
    assert model.trackable == (model.name in BUILT_IN)
    if not model.trackable:
        assert model.extents[2] >= 0.07


def test_declared_symmetries_map_the_surface_onto_itself(model: ObjectModel) -> None:
    points, _ = meshes.sample_surface(model.visual, 30 if model.symmetries.trivial else 150, np.random.default_rng(1))
    poses = model.symmetries.poses(np.pi / 3.5)
    for T in poses:
        # a body of revolution is true up to its facets
        tolerance = 4e-4 if model.symmetries.axes else 1e-6
        assert surface_distances(apply(T, points), model.visual).max() < tolerance


@pytest.mark.parametrize("axis", HALF_TURNS)
def test_no_half_turn_is_nearly_a_symmetry(model: ObjectModel, axis: str) -> None:
    turn = HALF_TURNS[axis]
    if np.abs(model.symmetries.poses(np.pi / 8) - turn).max(axis=(1, 2)).min() < 1e-9:
        pytest.skip("declared")
    points, _ = meshes.sample_surface(model.visual, 120, np.random.default_rng(2))
    distances = surface_distances(apply(turn, points), model.visual)
    assert np.sqrt(np.mean(distances**2)) > (4e-3 if model.trackable else 2e-3)
    assert distances.max() > 5e-3


def test_inertia_is_that_of_a_body(model: ObjectModel) -> None:
    assert 0.05 <= model.mass <= 5.0 and 0.2 <= model.friction <= 1.0
    principal = np.linalg.eigvalsh(model.inertia)
    assert principal[0] > 0.0 and principal[0] + principal[1] > principal[2]
    assert 150.0 < model.mass / meshes.volume(model.visual) < 3000.0
    assert (np.abs(model.centre_of_mass) < 0.5 * model.extents).all()


def test_collision_parts_are_convex_and_within_the_body(model: ObjectModel) -> None:
    for part in model.collision:
        assert len(part.faces) <= 600
        assert meshes.volume(meshes.convex_hull(part.vertices)) == pytest.approx(meshes.volume(part), rel=1e-6)
    corners = np.concatenate([part.vertices for part in model.collision])
    assert (np.abs(corners) <= 0.5 * model.extents + 2e-3).all()
    assert corners[:, 2].min() == pytest.approx(-0.5 * model.extents[2], abs=5e-4)


@pytest.mark.parametrize("name", ["klt3147", "materialbox", "cardboard_box", "mug"])
def test_containers_are_hollow_in_physics(name: str) -> None:
    model = load_object(name)
    inside = np.array([0.0, 0.0, 0.2 * model.extents[2]])
    if name == "mug":
        inside[0] = -0.5 * model.extents[0] + 0.042
    for part in model.collision:
        heights = np.einsum("fd,fd->f", meshes.face_normals(part), inside - part.triangles[:, 0])
        assert heights.max() > 0.01


def test_objects_stand(model: ObjectModel) -> None:
    position, rotation = stand_on_plane(model)
    assert rotation[2, 2] > np.cos(np.deg2rad(0.3))
    assert position[2] == pytest.approx(0.5 * model.extents[2], abs=1e-3)
    assert np.abs(position[:2]).max() < 2e-3


def same(a: ObjectModel, b: ObjectModel) -> bool:
    pairs = [(a.mesh, b.mesh), (a.visual, b.visual), *zip(a.collision, b.collision, strict=True)]
    arrays = [(p.vertices, q.vertices) for p, q in pairs] + [(p.faces, q.faces) for p, q in pairs]
    arrays += [(p.face_colors, q.face_colors) for p, q in pairs if p.face_colors is not None]
    arrays += [(a.inertia, b.inertia), (a.symmetries.discrete, b.symmetries.discrete), (a.keypoints, b.keypoints)]
    return all(np.array_equal(p, q) for p, q in arrays if p is not None and q is not None) and (
        (a.name, a.mass, a.diameter, a.trackable) == (b.name, b.mass, b.diameter, b.trackable)
    )


def test_building_twice_gives_the_same_and_fast() -> None:
    start = time.process_time()
    first = {name: build_procedural(name) for name in NAMES}
    assert time.process_time() - start < 10.0
    for name in NAMES:
        assert same(build_procedural(name), first[name])
        assert same(load_object(name), first[name])


def test_another_process_builds_the_same_to_the_bit() -> None:
    code = (
        "from hashlib import sha256\nfrom simtrack.objects.registry import build_procedural\n"
        "m = build_procedural('powerdrill').mesh\nprint(sha256(m.vertices.tobytes() + m.faces.tobytes()).hexdigest())"
    )
    hashes = {
        subprocess.run(
            [sys.executable, "-c", code], env=os.environ | extra, capture_output=True, text=True, check=True
        ).stdout
        for extra in ({"PYTHONHASHSEED": "1"}, {"PYTHONHASHSEED": "2", "OMP_NUM_THREADS": "1", "TBB_NUM_THREADS": "1"})
    }
    assert len(hashes) == 1


def fresh(name: str) -> ObjectModel:
    registry._procedural.cache_clear()
    return load_object(name)


def test_disk_cache_is_used_repaired_and_dispensable(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    built = build_procedural("mug")
    monkeypatch.setenv("SIMTRACK_CACHE", str(tmp_path))
    assert same(fresh("mug"), built)
    (file,) = (tmp_path / "objects").iterdir()
    assert file.name.startswith("mug-") and file.suffix == ".npz"
    with monkeypatch.context() as patch:
        patch.setattr(registry, "build_procedural", lambda name: pytest.fail("not read from the cache"))
        assert same(fresh("mug"), built)
    for damage in (b"", b"not an archive", file.read_bytes()[:1000]):
        file.write_bytes(damage)
        assert same(fresh("mug"), built)
        assert file.stat().st_size > 10_000
    file.unlink()
    (tmp_path / "objects").rmdir()
    (tmp_path / "objects").write_text("a file where the folder should be")
    assert same(fresh("mug"), built)


def test_thermos_and_crate_declare_their_symmetry() -> None:
    assert len(load_object("klt3147").symmetries.discrete) == 2
    assert len(load_object("thermos").symmetries.axes) == 1
    assert [n for n in BUILT_IN if not load_object(n).symmetries.trivial] == ["klt3147"]
