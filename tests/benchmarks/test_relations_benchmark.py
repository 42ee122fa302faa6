"""The relations benchmark's world and its peer."""

import math
from pathlib import Path

import numpy as np
import pytest

from simtrack.benchmarks.harness import Options
from simtrack.benchmarks.relations import (
    BENCHES,
    CLASSES,
    COLUMNS,
    MOVING,
    QUICK_SIZES,
    ROWS,
    boxes,
    build_world,
    directions,
    run,
)
from simtrack.objects import ObjectModel, load_object
from simtrack.perception.scene_graph import DIRECTIONS, RELATIONS, RelationConfig, SceneGraph, relation_margins


@pytest.fixture(scope="module")
def models() -> dict[str, ObjectModel]:
    return {name: load_object(name) for name in CLASSES}


def test_every_object_stands_on_its_bench_apart_from_the_others(models: dict[str, ObjectModel]) -> None:
    world = build_world(50, models, seed=1)
    graph = SceneGraph(world.static_map, models)
    graph.update(1, world.tracks(0, moving=0))
    on = graph.query("on")
    room = BENCHES * ROWS * COLUMNS
    for number, name in enumerate(world.classes):
        bench = f"room{number // room}/bench{number % room // (ROWS * COLUMNS)}"
        assert [r.reference for r in on if r.subject == f"{name}-{number + 1}"] == [bench]
    objects = {f"{name}-{number + 1}" for number, name in enumerate(world.classes)}
    assert not [r for r in graph.query("intersects") if r.subject in objects and r.reference in objects]


def test_only_the_movers_move(models: dict[str, ObjectModel]) -> None:
    world = build_world(30, models, seed=1)
    steps = [
        np.linalg.norm(b.T_map_object[:3, 3] - a.T_map_object[:3, 3])
        for a, b in zip(world.tracks(3), world.tracks(4), strict=True)
    ]
    assert steps[:MOVING] == pytest.approx([0.2 * math.sin(0.05)] * MOVING)
    assert steps[MOVING:] == [0.0] * (30 - MOVING)


def test_the_peer_finds_the_same_directions(models: dict[str, ObjectModel]) -> None:
    world, config = build_world(40, models, seed=2), RelationConfig()
    graph = SceneGraph(None, models)
    graph.update(1, world.tracks(7))
    bodies = [graph.body(name) for name in graph.entities]
    margins = relation_margins(bodies, config)[:, :, [RELATIONS.index(name) for name in DIRECTIONS]]
    theirs = directions(*boxes([(body.T_map, body.shape.extents) for body in bodies]), config)
    clear = np.abs(margins) > 1e-9
    np.testing.assert_array_equal(theirs[clear], (margins >= 0.0)[clear])


def test_the_quick_benchmark_measures_every_size(tmp_path: Path) -> None:
    result = run(Options(quick=True))
    assert result.series["objects"] == list(QUICK_SIZES)
    for name in ("ten move", "all move", "numpy"):
        assert len(result.series[name]) == len(QUICK_SIZES)
        assert min(result.series[name]) > 0.0
    for file, draw in result.plots.items():
        draw(tmp_path / file)
        assert (tmp_path / file).stat().st_size > 1000
