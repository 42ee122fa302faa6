"""Snapping: Eq. 1 holds exactly, what stands on a model comes along, nothing stays in a wall."""

import numpy as np
import pytest
from corner import at, block, corner, cupboard_model, table_mesh, table_model

from simtrack.objects.cad.builder import ModelBuilder
from simtrack.objects.cad.materials import CERAMIC
from simtrack.objects.cad.model import CadModel
from simtrack.perception.reconstruction.candidates import CadCandidate
from simtrack.perception.reconstruction.selection import OVERHANG
from simtrack.perception.reconstruction.snapping import eq1_residuals, snap
from simtrack.perception.reconstruction.solids import overlap, solid_of

TABLE = table_model("table-test", (1.0, 0.6, 0.7))


def slab(size: tuple[float, float, float]) -> CadModel:
    builder = ModelBuilder("box", "slab")
    builder.part().block((0.0, 0.0, 0.0), size, CERAMIC)
    return builder.finish("box-slab")


def cube(side: float) -> CadModel:
    return slab((side, side, side))


def test_heights_follow_the_models_from_the_floor_upwards() -> None:
    graph = corner(
        table=("table", table_mesh((1.0, 0.6, 0.73), (0.0, 0.0, 0.0))),
        box=("box", block((0.2, 0.2, 0.2), (0.2, 0.0, 0.73))),
        cup=("cup", block((0.08, 0.08, 0.1), (0.2, 0.0, 0.93))),
    )
    small = cube(0.1)
    snapped = snap(
        graph,
        {  # all of them float or stand in what is below them
            "table": CadCandidate(TABLE, at(0.0, 0.0, 0.37), 1.0),
            "box": CadCandidate(small, at(0.2, 0.0, 0.85), 2.0),
            "cup": CadCandidate(small, at(0.2, 0.0, 0.95), 0.8),
        },
    )
    bottoms = {name: solid_of(candidate).bottom for name, candidate in snapped.candidates.items()}
    assert bottoms == pytest.approx({"table": 0.0, "box": 0.7, "cup": 0.9}, abs=1e-6)
    residuals = eq1_residuals(graph, snapped.candidates)
    assert set(residuals) == {"table", "box", "cup"}
    assert max(abs(residual) for residual in residuals.values()) < 1e-6
    assert snapped.afloat == [] and snapped.stuck == []


def test_what_has_no_place_beside_another_is_laid_on_it() -> None:
    """Models are wider than what was seen: both do not fit on the stool."""
    graph = corner(
        stool=("table", block((0.3, 0.3, 0.5), (0.0, 0.0, 0.0))),
        first=("box", block((0.13, 0.2, 0.05), (-0.07, 0.0, 0.5))),
        second=("box", block((0.13, 0.2, 0.05), (0.07, 0.0, 0.5))),
    )
    wide = slab((0.25, 0.2, 0.05))
    chosen = {
        "stool": CadCandidate(slab((0.3, 0.3, 0.5)), at(0.0, 0.0, 0.25), 1.0),
        "first": CadCandidate(wide, at(-0.06, 0.0, 0.525), 1.0),
        "second": CadCandidate(wide, at(0.06, 0.0, 0.525), 1.0),
    }
    snapped = snap(graph, chosen)
    assert snapped.stuck == []
    bottoms = sorted(solid_of(snapped.candidates[name]).bottom for name in ("first", "second"))
    assert bottoms == pytest.approx([0.5, 0.55], abs=1e-4)


def test_what_is_far_above_its_guessed_support_rests_on_what_is_right_below() -> None:
    """A book whose edge alone is on a post: the graph guesses the floor."""
    graph = corner(
        post=("box", block((0.04, 0.04, 1.4), (0.08, 0.0, 0.0))),
        book=("book", block((0.2, 0.15, 0.03), (0.0, 0.0, 1.405))),
        tome=("book", block((0.2, 0.15, 0.03), (1.0, 0.0, 1.405))),
    )
    assert (graph.parent("book"), graph.parent("tome")) == ("floor", "floor")
    book = slab((0.2, 0.15, 0.03))
    chosen = {
        "post": CadCandidate(slab((0.04, 0.04, 1.4)), at(0.08, 0.0, 0.7), 1.0),
        "book": CadCandidate(book, at(0.0, 0.0, 1.42), 1.0),
        "tome": CadCandidate(book, at(1.0, 0.0, 1.42), 1.0),
    }
    snapped = snap(graph, chosen)
    assert snapped.resting == {"book"}
    bottoms = {name: solid_of(snapped.candidates[name]).bottom for name in ("book", "tome")}
    assert bottoms == pytest.approx({"book": 1.4, "tome": 1.405}, abs=1e-6)


def test_what_stands_on_a_model_is_carried_out_of_the_wall_with_it() -> None:
    graph = corner(
        table=("table", table_mesh((1.0, 0.6, 0.7), (0.0, 1.69, 0.0))),
        box=("box", block((0.2, 0.2, 0.2), (0.2, 1.7, 0.7))),
    )
    chosen = {
        "table": CadCandidate(TABLE, at(0.0, 1.72, 0.35), 1.0),
        "box": CadCandidate(cube(0.2), at(0.2, 1.72, 0.8), 1.0),
    }
    snapped = snap(graph, chosen)
    assert snapped.candidates["table"].T_map_model[1, 3] == pytest.approx(1.7, abs=2e-3)
    np.testing.assert_allclose(snapped.shifts["box"], snapped.shifts["table"], atol=1e-6)


def test_neighbours_are_pushed_apart_the_lighter_one_more() -> None:
    graph = corner(
        table=("table", table_mesh((1.0, 0.6, 0.7), (0.0, 0.0, 0.0))),
        box=("box", block((0.2, 0.2, 0.2), (0.1, 0.0, 0.7))),
        cup=("cup", block((0.08, 0.08, 0.08), (0.25, 0.0, 0.7))),
    )
    chosen = {
        "table": CadCandidate(TABLE, at(0.0, 0.0, 0.35), 1.0),
        "box": CadCandidate(cube(0.2), at(0.1, 0.0, 0.8), 1.0),
        "cup": CadCandidate(cube(0.1), at(0.23, 0.0, 0.74), 0.8),
    }
    snapped = snap(graph, chosen)
    solids = {name: solid_of(candidate) for name, candidate in snapped.candidates.items()}
    assert overlap(solids["box"], solids["cup"])[1] < 1.5e-3
    assert np.abs(snapped.shifts["box"]).max() < np.abs(snapped.shifts["cup"]).max()


def test_things_inside_stand_on_the_floor_of_the_hollow() -> None:
    model = cupboard_model()
    candidate = CadCandidate(model, at(0.0, 0.0, 0.5 * float(model.extents[2])), 1.0)
    graph = corner(cabinet=("cabinet", candidate.mesh()), cup=("cup", block((0.08, 0.08, 0.1), (0.0, 0.0, 0.02))))
    assert graph.parent("cup") == "cabinet"
    larger = CadCandidate(model, at(0.0, 0.0, 0.55 * float(model.extents[2])), 1.1)
    snapped = snap(graph, {"cabinet": larger, "cup": CadCandidate(cube(0.1), at(0.0, 0.0, 0.07), 0.8)})
    assert solid_of(snapped.candidates["cup"]).bottom == pytest.approx(1.1 * 0.02, abs=1e-6)


def test_what_hangs_touches_its_wall() -> None:
    graph = corner(picture=("picture", block((0.6, 0.03, 0.4), (0.0, 1.97, 1.4))))
    assert graph.parent("picture") == "wall"
    snapped = snap(graph, {"picture": CadCandidate(cube(0.3), at(0.0, 1.8, 1.5), 1.0)})
    assert solid_of(snapped.candidates["picture"]).high[:, 1].max() == pytest.approx(2.0, abs=1e-3)


def test_what_stood_on_top_of_another_stands_on_top_of_its_thicker_model() -> None:
    """A book across two: the models of the lower ones differ in height by more than half of the upper one's."""
    graph = corner(
        left=("book", block((0.15, 0.2, 0.03), (-0.1, 0.0, 0.0))),
        right=("book", block((0.15, 0.2, 0.03), (0.1, 0.0, 0.0))),
        upper=("book", block((0.3, 0.2, 0.02), (0.0, 0.0, 0.03))),
    )
    assert set(graph.supporters("upper")) == {"left", "right"}
    chosen = {
        name: CadCandidate(slab((0.15, 0.2, height)), at(x, 0.0, height / 2), 1.0)
        for name, x, height in (("left", -0.1, 0.02), ("right", 0.1, 0.05))
    }
    chosen["upper"] = CadCandidate(slab((0.3, 0.2, 0.02)), at(0.0, 0.0, 0.04), 1.0)
    snapped = snap(graph, chosen)
    assert solid_of(snapped.candidates["upper"]).bottom == pytest.approx(0.05, abs=1e-6)
    assert snapped.stuck == []


def test_neighbours_at_an_edge_are_not_pushed_off_it() -> None:
    graph = corner(
        table=("table", table_mesh((1.0, 0.6, 0.7), (0.0, 0.0, 0.0))),
        box=("box", block((0.2, 0.2, 0.2), (0.25, 0.0, 0.7))),
        cup=("cup", block((0.08, 0.08, 0.08), (0.42, 0.0, 0.7))),
    )
    chosen = {
        "table": CadCandidate(TABLE, at(0.0, 0.0, 0.35), 1.0),
        "box": CadCandidate(cube(0.2), at(0.35, 0.0, 0.8), 1.0),
        "cup": CadCandidate(cube(0.1), at(0.46, 0.0, 0.74), 0.8),
    }
    snapped = snap(graph, chosen)
    solids = {name: solid_of(candidate) for name, candidate in snapped.candidates.items()}
    assert overlap(solids["box"], solids["cup"])[1] < 1.5e-3
    assert snapped.candidates["cup"].T_map_model[0, 3] < 0.5 - OVERHANG * 0.08 + 1e-3
