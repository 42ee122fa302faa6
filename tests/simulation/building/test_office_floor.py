from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from simtrack.errors import InvalidValueError
from simtrack.geometry.meshes import area, face_areas
from simtrack.simulation.building.layout import draw_layout
from simtrack.simulation.building.office_floor import OfficeFloorConfig, office_floor
from simtrack.simulation.building.parts import StaticWorld


@pytest.fixture(scope="module")
def floor() -> StaticWorld:
    return office_floor(np.random.default_rng(0))


def test_triangles_and_area_are_those_asked_for(floor: StaticWorld) -> None:
    assert floor.triangles == 411_698
    assert floor.area == pytest.approx(2986.0, rel=0.02)
    floors = sum(area(part.mesh) for part in floor.parts if part.semantic_class == "floor")
    assert floors == pytest.approx(floor.area)
    assert face_areas(floor.mesh()).min() > 1e-9


def test_rooms_differ_in_size_and_no_furniture_repeats(floor: StaticWorld) -> None:
    sizes = {tuple(np.round(np.ptp(room.polygon, axis=0), 3)) for room in floor.rooms}
    assert len(sizes) == len(floor.rooms) > 60
    for kind in ("desk", "shelf", "workbench", "table"):
        pieces = [tuple(np.round(part.extents, 6)) for part in floor.parts if part.semantic_class == kind]
        assert len(set(pieces)) == len(pieces) > 10


def test_furniture_of_a_room_does_not_overlap(floor: StaticWorld) -> None:
    import shapely

    by_room: dict[str, list[shapely.Polygon]] = {}
    for part in floor.parts:
        if part.survey == "movable" and part.T_map_part[2, 3] - part.extents[2] / 2 < 0.05:
            by_room.setdefault(part.room, []).append(shapely.Polygon(part.footprint()))
    for footprints in by_room.values():
        for k, a in enumerate(footprints):
            for b in footprints[k + 1 :]:
                assert a.intersection(b).area < 0.03


@pytest.mark.parametrize(("seed", "triangles"), [(1, 60_000), (2, 60_001)])
def test_any_count_is_met_from_any_seed_and_repeats(
    seed: int, triangles: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = OfficeFloorConfig(triangles=triangles, area=400.0)
    monkeypatch.setenv("SIMTRACK_CACHE", str(tmp_path / "a"))
    first = office_floor(np.random.default_rng(seed), config)
    monkeypatch.setenv("SIMTRACK_CACHE", str(tmp_path / "b"))
    again = office_floor(np.random.default_rng(seed), config)
    assert first.triangles == triangles
    for a, b in zip(first.parts, again.parts, strict=True):
        assert a.name == b.name
        np.testing.assert_array_equal(a.mesh.vertices, b.mesh.vertices)


@settings(max_examples=30)
@given(seed=st.integers(0, 2**32 - 1), width=st.floats(20.0, 80.0), depth=st.floats(20.0, 80.0))
def test_layouts_fill_the_floor_and_join_every_space(seed: int, width: float, depth: float) -> None:
    import networkx as nx

    layout = draw_layout(np.random.default_rng(seed), width, depth)
    assert sum(cell.area for cell in layout.spaces) == pytest.approx(width * depth)
    graph = nx.Graph()
    graph.add_nodes_from(range(len(layout.spaces)))
    graph.add_edges_from(passage.spaces for passage in layout.doors + layout.junctions)
    assert nx.is_connected(graph)
    for door in layout.doors:
        assert door.end - door.start >= 0.9


def test_too_few_triangles_are_refused() -> None:
    with pytest.raises(InvalidValueError, match="triangles"):
        OfficeFloorConfig(triangles=1000)
