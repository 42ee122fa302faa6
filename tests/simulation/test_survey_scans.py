"""A survey of simulated scans: its surface is the world's, its entities are known, files keep it, damage is refused."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from simtrack.contracts import Articulation, StaticMap
from simtrack.errors import FileFormatError, InvalidValueError
from simtrack.geometry.meshes import Mesh, area, face_normals, sample_surface
from simtrack.perception.mapping.static_entities import face_owners
from simtrack.raycast import RayScene, TriangleMesh
from simtrack.simulation.building.lab_room import lab_room
from simtrack.simulation.building.parts import StaticWorld
from simtrack.simulation.survey import SurveyConfig, survey
from simtrack.simulation.survey_files import FILE, read_survey, write_survey
from simtrack.simulation.survey_scans import ScanSurveyConfig, stations

CONFIG = SurveyConfig(method="scans", moved=0.0, brought=0.0, removed=0.0, max_faces=60_000)


@pytest.fixture(scope="module")
def lab() -> StaticWorld:
    return lab_room(np.random.default_rng(0))


@pytest.fixture(scope="module")
def surveyed(lab: StaticWorld, tmp_path_factory: pytest.TempPathFactory) -> StaticMap:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SIMTRACK_CACHE", str(tmp_path_factory.mktemp("cache")))
        return survey(lab, CONFIG, np.random.default_rng(1))


def test_the_surface_is_the_worlds(lab: StaticWorld, surveyed: StaticMap) -> None:
    mesh, true = Mesh(surveyed.vertices.astype(float), surveyed.faces), lab.mesh()
    points, faces = sample_surface(mesh, 8000, np.random.default_rng(0))
    with RayScene() as scene:
        scene.add(TriangleMesh(true.vertices, true.faces))
        found = scene.closest_points(points, 0.5)
    off = np.asarray(found.distances)
    assert np.median(off) < 0.005 and np.quantile(off, 0.95) < 0.03
    facing = np.einsum("ij,ij->i", face_normals(mesh)[faces], face_normals(true)[np.maximum(found.faces, 0)])
    assert np.mean(facing[off < 0.01] > 0.7) > 0.9
    assert 0.6 * area(true) < area(mesh) and len(surveyed.faces) < 1.05 * CONFIG.max_faces


def test_large_entities_are_told_apart_and_own_their_faces(lab: StaticWorld, surveyed: StaticMap) -> None:
    names = {entity.name for entity in surveyed.entities}
    assert {part.name for part in lab.parts if part.survey != "omitted" and max(part.extents) > 1.0} <= names
    assert np.mean(face_owners(surveyed) >= 0) > 0.98
    bench = next(entity for entity in surveyed.entities if entity.semantic_class == "workbench")
    part = next(part for part in lab.parts if part.name == bench.name)
    np.testing.assert_allclose(bench.extents, part.extents, atol=0.08)
    assert bench.supports


def test_stations_stand_clear_in_their_rooms(lab: StaticWorld) -> None:
    config, true = ScanSurveyConfig(), lab.mesh()
    with RayScene() as scene:
        scene.add(TriangleMesh(true.vertices, true.faces))
        found = stations(lab, scene, config, np.random.default_rng(0))
        clear = np.asarray(scene.closest_points(np.array(found), 5.0).distances)
    assert len(found) >= 3 and clear.min() > config.clearance


def test_a_survey_survives_its_files(surveyed: StaticMap, tmp_path: Path) -> None:
    square = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
    door = Articulation(
        "door", "fridge", "revolute", np.zeros(3), np.array([0.0, 0.0, 1.0]), 0.0, 1.5, square,
        np.array([[0, 1, 2]], np.int32),
    )  # fmt: skip
    write_survey(replace(surveyed, articulations=(door,)), tmp_path)
    again = read_survey(tmp_path)
    np.testing.assert_array_equal(again.vertices, surveyed.vertices)
    np.testing.assert_array_equal(again.faces, surveyed.faces)
    assert [e.name for e in again.entities] == [e.name for e in surveyed.entities] and again.noise == surveyed.noise
    assert (again.articulations[0].name, again.articulations[0].upper) == ("door", 1.5)
    with np.load(tmp_path / FILE) as data:
        arrays = dict(data)
    for name, values in (("faces", arrays["faces"] + 10**6), ("vertices", arrays["vertices"] * np.nan)):
        np.savez(tmp_path / FILE, **{**arrays, name: values})
        with pytest.raises(FileFormatError, match=name):
            read_survey(tmp_path)
    (tmp_path / FILE).write_bytes(b"nonsense")
    with pytest.raises(FileFormatError, match="simtrack survey"):
        read_survey(tmp_path)


def test_other_methods_are_refused() -> None:
    with pytest.raises(InvalidValueError, match="displaced, scans"):
        SurveyConfig(method="guessed")  # type: ignore[arg-type]
    with pytest.raises(InvalidValueError, match=r"ScanSurveyConfig\.pixels"):
        ScanSurveyConfig(pixels=2)
