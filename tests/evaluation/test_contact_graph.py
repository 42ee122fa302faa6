import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from simtrack.errors import InvalidValueError
from simtrack.evaluation.contact_graph import (
    SupportTree,
    contact_graph_errors,
    match_by_overlap,
    optimal_edit_distance,
    upright_iou,
)
from simtrack.geometry.transforms import transform_planar

TRUE = SupportTree(
    {"floor": "floor", "table": "table", "cup": "cup", "book": "book"},
    {"floor": ("",), "table": ("floor",), "cup": ("table",), "book": ("table",)},
)


@st.composite
def trees(draw: st.DrawFn) -> SupportTree:
    """Trees of up to six nodes; every parent comes before its children."""
    names = [f"n{i}" for i in range(draw(st.integers(0, 6)))]
    classes = {name: draw(st.sampled_from(["cup", "table"])) for name in names}
    return SupportTree(classes, {n: (draw(st.sampled_from(["", *names[:i]])),) for i, n in enumerate(names)})


@given(trees())
def test_a_graph_is_at_no_distance_from_itself(tree: SupportTree) -> None:
    errors = contact_graph_errors(tree, tree)
    assert (errors.total, errors.general) == (0, 0)


@given(trees(), trees())
def test_the_distances_are_symmetric(a: SupportTree, b: SupportTree) -> None:
    matches = {name: name for name in a.classes if name in b.classes}
    there, back = contact_graph_errors(a, b, matches), contact_graph_errors(b, a, matches)
    assert there.general == back.general
    assert there.missing == back.extra


@settings(max_examples=40)
@given(trees(), trees())
def test_no_matching_beats_the_optimal_one(a: SupportTree, b: SupportTree) -> None:
    if max(len(a.classes), len(b.classes)) <= 4:
        best = optimal_edit_distance(a, b)
        assert best is not None
        assert best <= contact_graph_errors(a, b).general


def test_a_wrong_edge_costs_two_and_the_edges_of_missing_and_extra_nodes_nothing() -> None:
    moved = SupportTree(TRUE.classes, {**TRUE.parents, "cup": ("floor",)})
    assert contact_graph_errors(moved, TRUE).total == 2
    lost = SupportTree({"floor": "floor", "cup": "cup"}, {"floor": ("",), "cup": ("floor",)})
    errors = contact_graph_errors(lost, TRUE)
    assert errors.missing == ("table", "book")
    assert errors.total == 2, "the cup's true parent is missing: its edge is free"
    assert errors.general == 2 + 4, "two nodes; floor-table, table-cup, table-book go, floor-cup comes"
    more = SupportTree({**TRUE.classes, "ghost": "cup"}, {**TRUE.parents, "ghost": ("table",)})
    assert (contact_graph_errors(more, TRUE).total, contact_graph_errors(more, TRUE).general) == (1, 2)


def test_any_of_several_supporters_is_right() -> None:
    parents = {"floor": ("",), "a": ("floor",), "b": ("floor",), "plank": ("a", "b")}
    truth = SupportTree({name: name for name in parents}, parents)
    other = SupportTree(truth.classes, {**parents, "plank": ("b",)})
    assert contact_graph_errors(other, truth).general == 0
    assert contact_graph_errors(other, truth).total == 0


def test_a_wrong_class_is_one_substitution_and_two_where_nodes_are_matched_by_class() -> None:
    named = SupportTree({**TRUE.classes, "cup": "bowl"}, TRUE.parents)
    errors = contact_graph_errors(named, TRUE)
    assert errors.wrong_class == ("cup",) and (errors.total, errors.general) == (1, 1)
    by_class = contact_graph_errors(named, TRUE, {name: name for name in TRUE.classes if name != "cup"})
    assert (by_class.missing, by_class.extra, by_class.total) == (("cup",), ("cup",), 2)
    assert optimal_edit_distance(named, TRUE) == 1.0


def test_overlap_matches_turned_boxes_and_leaves_strangers_out() -> None:
    box = transform_planar(1.0, 2.0, 0.3), np.array([0.4, 0.2, 0.1])
    turned = transform_planar(1.0, 2.0, 0.3 + np.pi / 2), np.array([0.2, 0.4, 0.1])
    far = transform_planar(5.0, 2.0, 0.3), box[1]
    assert upright_iou(*box, *turned) == pytest.approx(1.0)
    half = transform_planar(1.0 + 0.2 * np.cos(0.3), 2.0 + 0.2 * np.sin(0.3), 0.3), box[1]
    assert upright_iou(*box, *half) == pytest.approx(1 / 3)
    assert match_by_overlap({"x": far, "y": turned}, {"a": box, "b": half}) == {"a": "y"}


def test_bad_trees_and_matches_are_refused() -> None:
    with pytest.raises(InvalidValueError, match="parents"):
        SupportTree({"cup": "cup"}, {})
    with pytest.raises(InvalidValueError, match="cup"):
        SupportTree({"cup": "cup"}, {"cup": ("table",)})
    with pytest.raises(InvalidValueError, match="one-to-one"):
        contact_graph_errors(TRUE, TRUE, {"cup": "cup", "book": "cup"})
