from pathlib import Path
from typing import Any

import numpy as np
import pytest

from simtrack.contracts import StaticMap
from simtrack.errors import InvalidValueError
from simtrack.geometry.meshes import Mesh, area, face_areas, face_normals, sample_surface
from simtrack.simulation.building.lab_room import lab_room
from simtrack.simulation.building.office_floor import OfficeFloorConfig, office_floor
from simtrack.simulation.building.parts import StaticWorld
from simtrack.simulation.retessellation import retessellated
from simtrack.simulation.survey import SurveyConfig, survey

UNCHANGED = SurveyConfig(moved=0.0, brought=0.0, removed=0.0)


@pytest.fixture(scope="module")
def lab() -> StaticWorld:
    return lab_room(np.random.default_rng(0))


def mesh_of(static_map: StaticMap) -> Mesh:
    return Mesh(static_map.vertices.astype(float), static_map.faces)


def distances(world: StaticWorld, static_map: StaticMap) -> np.ndarray:
    """Of points on the surveyed surface from the true one."""
    from simtrack.raycast import RayScene, TriangleMesh

    mesh = world.mesh()
    points, _ = sample_surface(mesh_of(static_map), 8000, np.random.default_rng(0))
    with RayScene() as scene:
        scene.add(TriangleMesh(mesh.vertices, mesh.faces))
        return np.asarray(scene.closest_points(points, 0.5).distances)


@pytest.mark.parametrize("noise", [0.002, 0.005, 0.01])
def test_the_surface_is_off_by_the_stated_noise(lab: StaticWorld, noise: float) -> None:
    config = SurveyConfig(noise=noise, moved=0.0, brought=0.0, removed=0.0)
    static_map = survey(lab, config, np.random.default_rng(1))
    assert static_map.noise == noise
    assert np.sqrt(np.mean(distances(lab, static_map) ** 2)) == pytest.approx(noise, rel=0.2)


def test_without_noise_and_changes_the_surface_is_the_same_but_the_mesh_is_not(lab: StaticWorld) -> None:
    static_map = survey(lab, SurveyConfig(noise=0.0, moved=0.0, brought=0.0, removed=0.0), np.random.default_rng(1))
    assert np.quantile(distances(lab, static_map), 0.99) < 1e-3
    walls = sum(area(part.mesh) for part in lab.parts if part.semantic_class in ("wall", "floor", "ceiling"))
    assert area(mesh_of(static_map)) > walls
    assert len(static_map.faces) != lab.triangles


def test_no_vertex_is_shared_and_no_face_is_degenerate(lab: StaticWorld) -> None:
    from scipy.spatial import KDTree

    static_map = survey(lab, None, np.random.default_rng(1))
    nearest, _ = KDTree(lab.mesh().vertices).query(static_map.vertices)
    assert nearest.min() > 1e-6
    assert np.isfinite(static_map.vertices).all()
    assert face_areas(mesh_of(static_map)).min() > 0.0


def test_the_same_generator_gives_the_same_survey(
    lab: StaticWorld, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SIMTRACK_CACHE", str(tmp_path / "a"))
    first = survey(lab, None, np.random.default_rng(4))
    monkeypatch.setenv("SIMTRACK_CACHE", str(tmp_path / "b"))
    again = survey(lab, None, np.random.default_rng(4))
    np.testing.assert_array_equal(first.vertices, again.vertices)
    np.testing.assert_array_equal(first.faces, again.faces)
    other = survey(lab, None, np.random.default_rng(5))
    assert other.vertices.shape != first.vertices.shape or np.abs(other.vertices - first.vertices).max() > 1e-4


def test_entities_are_where_the_surveyed_mesh_shows_them(lab: StaticWorld) -> None:
    entities = {entity.name: entity for entity in survey(lab, UNCHANGED, np.random.default_rng(1)).entities}
    assert set(entities) == {part.name for part in lab.parts if part.survey != "omitted"}
    for name in ("workbench", "shelf", "desk"):
        part, entity = lab.part(name), entities[name]
        np.testing.assert_allclose(entity.T_map_entity[:2, 3], part.T_map_part[:2, 3], atol=0.02)
        np.testing.assert_allclose(entity.extents[:2], part.extents[:2], atol=0.05)
        assert len(entity.supports) == len(part.supports)
        for (T_map_face, size), (T_part_face, true_size) in zip(entity.supports, part.supports, strict=True):
            true = part.T_map_part @ T_part_face
            assert abs(T_map_face[2, 3] - true[2, 3]) < 0.02
            assert T_map_face[2, 3] != true[2, 3]
            np.testing.assert_allclose(size, true_size)


def test_the_stated_shares_of_furniture_changed() -> None:
    world = office_floor(np.random.default_rng(0), OfficeFloorConfig(triangles=60_000, area=400.0))
    config = SurveyConfig(edge=0.6, moved=0.2, brought=0.1, removed=0.1)
    static_map = survey(world, config, np.random.default_rng(2))
    entities = {entity.name: entity for entity in static_map.entities}
    movable = [part for part in world.parts if part.survey == "movable"]
    missing = [part for part in movable if part.name not in entities]
    assert len(missing) == round(0.1 * len(movable))
    shifts = np.array(
        [
            np.linalg.norm((entities[part.name].T_map_entity - part.T_map_part)[:2, 3])
            for part in movable
            if part.name in entities
        ]
    )
    # some pieces have no free place to have been moved from
    assert 0.12 * len(movable) <= np.count_nonzero(shifts > 0.08) <= 0.2 * len(movable)
    assert shifts.max() < 0.7
    gone = set(entities) - {part.name for part in world.parts}
    assert 0 < len(gone) <= round(0.1 * len(movable))
    fixed = [part for part in world.parts if part.survey == "as-is" and part.group == "furniture"]
    assert all(np.linalg.norm((entities[p.name].T_map_entity - p.T_map_part)[:2, 3]) < 0.04 for p in fixed)


def test_planes_are_tessellated_anew_with_the_same_outline() -> None:
    # a plate with a hole, tessellated badly
    x = np.array([0.0, 1.0, 1.2, 3.0])
    cells = [(i, j) for i in range(3) for j in range(3) if (i, j) != (1, 1)]
    vertices = np.array([[a, b, 0.5] for a in x for b in x])
    quads = [(i * 4 + j, i * 4 + j + 4, i * 4 + j + 5, i * 4 + j + 1) for i, j in cells]
    faces = np.array([f for a, b, c, d in quads for f in ((a, b, c), (a, c, d))], dtype=np.int32)
    plate = Mesh(vertices, faces)
    again = retessellated(plate, 0.3, np.random.default_rng(0))
    assert area(again) == pytest.approx(area(plate))
    np.testing.assert_allclose(face_normals(again), np.tile([0.0, 0.0, 1.0], (len(again.faces), 1)), atol=1e-9)
    assert len(again.faces) > 100


@pytest.mark.parametrize(("name", "value"), [("noise", -1.0), ("moved", 1.5), ("correlation", 0.0), ("max_faces", 3)])
def test_impossible_surveys_are_refused(name: str, value: Any) -> None:
    with pytest.raises(InvalidValueError, match=name):
        SurveyConfig(**{name: value})
