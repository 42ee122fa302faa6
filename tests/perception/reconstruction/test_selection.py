"""Global check: what cannot carry, stands in a wall or in others, is not taken."""

import numpy as np
import pytest
from corner import at, block, corner, table_mesh, table_model

from simtrack.errors import InvalidValueError
from simtrack.geometry.meshes import concatenate
from simtrack.geometry.transforms import exp_so3, transform
from simtrack.objects.cad.builder import ModelBuilder
from simtrack.objects.cad.materials import OAK
from simtrack.perception.reconstruction.candidates import CadCandidate
from simtrack.perception.reconstruction.selection import SelectionConfig, place_of, select
from simtrack.perception.reconstruction.solids import solid_of
from simtrack.perception.scene_graph.contact import ContactGraph

WIDE, NARROW = table_model("table-wide", (1.0, 0.6, 0.7)), table_model("table-narrow", (0.3, 0.6, 0.7))


def laid_table() -> ContactGraph:
    """A table with a box near its end."""
    return corner(
        table=("table", table_mesh((1.0, 0.6, 0.7), (0.0, 0.0, 0.0))),
        box=("box", block((0.2, 0.2, 0.1), (0.35, 0.0, 0.7))),
    )


def test_a_table_that_ends_before_what_stands_on_it_is_discarded() -> None:
    offered = [CadCandidate(NARROW, at(0.0, 0.0, 0.35), 1.0), CadCandidate(WIDE, at(0.0, 0.0, 0.35), 1.0)]
    selection = select(laid_table(), {"table": offered})
    assert selection.chosen == {"table": 1}
    assert "cannot support box (Eq. 2)" in selection.rejected["table"][0].reason
    assert selection.lost == {}


def test_if_none_carries_all_the_one_that_carries_most_is_kept_and_said() -> None:
    selection = select(laid_table(), {"table": [CadCandidate(NARROW, at(0.0, 0.0, 0.35), 1.0)]})
    assert selection.chosen == {"table": 0}
    assert selection.lost == {"table": ["box"]}


def test_what_stands_in_a_wall_is_discarded() -> None:
    graph = corner(table=("table", table_mesh((1.0, 0.6, 0.7), (0.0, 1.7, 0.0))))
    offered = [CadCandidate(WIDE, at(0.0, 1.81, 0.35), 1.0), CadCandidate(WIDE, at(0.0, 1.69, 0.35), 1.0)]
    selection = select(graph, {"table": offered})
    assert selection.chosen == {"table": 1}
    assert "in layout" in selection.rejected["table"][0].reason


def test_candidates_are_selected_to_stay_out_of_each_other() -> None:
    graph = corner(
        first=("table", table_mesh((0.9, 0.6, 0.7), (-0.5, 0.0, 0.0))),
        second=("table", table_mesh((0.9, 0.6, 0.7), (0.5, 0.0, 0.0))),
    )
    offered = {
        "first": [CadCandidate(WIDE, at(-0.45, 0.0, 0.35), 1.0), CadCandidate(WIDE, at(-0.55, 0.0, 0.35), 1.0)],
        "second": [CadCandidate(WIDE, at(0.45, 0.0, 0.35), 1.0)],
    }
    selection = select(graph, offered)
    assert selection.chosen == {"first": 1, "second": 0}
    assert selection.conflicts == []
    only = select(graph, {**offered, "first": offered["first"][:1]})
    assert [(first, second) for first, second, _ in only.conflicts] == [("first", "second")]


def test_one_in_a_wall_is_no_better_than_one_from_which_a_child_moves_a_little() -> None:
    graph = corner(
        table=("table", table_mesh((1.0, 0.6, 0.7), (0.0, 1.69, 0.0))),
        box=("box", block((0.1, 0.1, 0.1), (0.0, 1.93, 0.7))),
    )
    inside, clear = CadCandidate(WIDE, at(0.0, 1.81, 0.35), 1.0), CadCandidate(WIDE, at(0.0, 1.55, 0.35), 1.0)
    selection = select(graph, {"table": [inside, clear]})
    assert selection.chosen == {"table": 1}
    assert selection.lost == {"table": ["box"]}
    assert selection.homeless == {"table": []}


def test_barred_candidates_are_taken_only_where_nothing_else_is_left() -> None:
    graph = laid_table()
    offered = {"table": [CadCandidate(WIDE, at(x, 0.0, 0.35), 1.0) for x in (0.0, 0.01)]}
    assert select(graph, offered, barred={"table": {0}}).chosen == {"table": 1}
    assert select(graph, offered, barred={"table": {0, 1}}).chosen == {"table": 0}


def test_a_candidate_that_is_aligned_far_worse_is_not_taken_to_keep_out_of_others() -> None:
    graph = corner(
        first=("table", table_mesh((0.9, 0.6, 0.7), (-0.5, 0.0, 0.0))),
        second=("table", table_mesh((0.9, 0.6, 0.7), (0.5, 0.0, 0.0))),
    )
    offered = {
        "first": [CadCandidate(WIDE, at(x, 0.0, 0.35), 1.0, alignment_error=error)
                  for x, error in ((-0.45, 0.01), (-0.55, 0.2))],
        "second": [CadCandidate(WIDE, at(0.45, 0.0, 0.35), 1.0, alignment_error=0.01)],
    }  # fmt: skip
    selection = select(graph, offered)
    assert selection.chosen == {"first": 0, "second": 0}
    assert [(r.rank, "far worse" in r.reason) for r in selection.rejected["first"]] == [(1, True)]
    assert select(graph, offered, SelectionConfig(far_worse=30.0)).chosen["first"] == 1


@pytest.mark.parametrize("tipped", [False, True])
def test_a_bottle_does_not_stand_on_its_head_to_keep_out_of_others(tipped: bool) -> None:
    """What lies on a side may be turned to the opposite one; what stands stays upright."""
    graph = corner(
        first=("table", table_mesh((0.9, 0.6, 0.7), (-0.5, 0.0, 0.0))),
        second=("table", table_mesh((0.9, 0.6, 0.7), (0.5, 0.0, 0.0))),
    )
    side = transform(exp_so3(np.array([np.pi / 2, 0.0, 0.0]))) if tipped else np.eye(4)
    over = transform(exp_so3(np.array([0.0, 0.0, np.pi]) if tipped else np.array([np.pi, 0.0, 0.0])))
    offered = {
        "first": [CadCandidate(WIDE, at(-0.45, 0.0, 0.35) @ side, 1.0),
                  CadCandidate(WIDE, at(-0.55, 0.0, 0.35) @ over @ side, 1.0)],
        "second": [CadCandidate(WIDE, at(0.45, 0.0, 0.35) @ side, 1.0)],
    }  # fmt: skip
    selection = select(graph, offered)
    assert selection.chosen["first"] == (1 if tipped else 0)
    reasons = [r.reason for r in selection.rejected.get("first", ())]
    assert any("another side" in reason for reason in reasons) != tipped


def test_what_is_taller_than_the_room_above_a_board_has_no_place_there() -> None:
    """The board above is thin: of the volume of a bottle it takes next to nothing."""
    shelf = [block((0.6, 0.3, 0.01), (0.0, 0.0, z)) for z in (0.0, 0.2, 0.4)]
    graph = corner(
        shelf=("cabinet", concatenate([*shelf, block((0.6, 0.01, 0.41), (0.0, 0.15, 0.0))])),
        cup=("cup", block((0.08, 0.08, 0.1), (0.0, -0.02, 0.01))),
    )
    assert graph.parent("cup") == "shelf"
    for clearance, kept in ((0.19, [0]), (0.08, [])):
        builder = ModelBuilder("cabinet", "boards")
        part = builder.part()
        for z in (0.0, 0.01 + clearance, 0.4):
            part.block((-0.3, -0.15, z), (0.3, 0.15, z + 0.01), OAK)
        builder.hollow(part, (-0.3, -0.15, 0.01), (0.3, 0.15, 0.01 + clearance))
        candidate = CadCandidate(builder.finish("shelf-test"), at(0.0, 0.0, 0.205), 1.0)
        place = place_of(candidate, solid_of(candidate), graph, "cup", 0.05, 0.5)
        assert (place is not None) == bool(kept)


@pytest.mark.parametrize("field", [{"contact_area": 0.0}, {"steps": -1}, {"height": float("nan")}])
def test_settings_out_of_range_are_refused(field: dict) -> None:
    with pytest.raises(InvalidValueError, match=next(iter(field))):
        SelectionConfig(**field)
