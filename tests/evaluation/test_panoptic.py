"""Panoptic quality and average precision: what is perfect scores 1, and every kind of mistake costs what it should."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from simtrack.evaluation.mapping import MapScores, class_means
from simtrack.evaluation.panoptic import (
    PAPER_CLASSES,
    PanopticCount,
    PanopticEntity,
    ScoredClass,
    TrueSurface,
    box_iou,
    compare,
    mean_precision,
    panoptic_counts,
    predicted_entity,
    scored_classes,
)
from simtrack.evaluation.panoptic_rooms import (
    RoomMapTask,
    ordering,
    scores_from_json,
    scores_to_json,
    summed,
    tables_of,
    write_panoptic,
)
from simtrack.geometry.meshes import Mesh, box_mesh, sample_surface
from simtrack.raycast import RayScene, TriangleMesh


def entity(name: str, x: float, size: float = 0.4, score: float = 1.0) -> PanopticEntity:
    """A cube at a place; its class is its name without digits."""
    mesh = box_mesh((size, size, size))
    return predicted_entity(name, name.rstrip("0123456789"), score, Mesh(mesh.vertices + [x, 0.0, 0.0], mesh.faces))


def truth(*entities: PanopticEntity, void: tuple[str, ...] = ()) -> TrueSurface:
    return TrueSurface(entities, np.array([e.name in void for e in entities]))


TRUE = truth(entity("chair1", 0.0), entity("chair2", 1.0), entity("table1", 2.0))


def test_the_truth_itself_is_perfect() -> None:
    found = compare(TRUE.entities, TRUE)
    assert class_means(panoptic_counts(found)) == (1.0, 1.0, 1.0)
    assert np.allclose(found.iou, np.eye(3)) and found.accuracy.max() == 0.0
    assert mean_precision(scored_classes(TRUE.entities, TRUE, found.iou)) == 1.0
    assert np.allclose(box_iou(TRUE.entities, TRUE), np.eye(3))


def test_means_over_the_papers_classes_leave_the_others_out() -> None:
    counts = {
        "chair": ScoredClass(((0.9, True),), 1),
        "cup": ScoredClass((), 4),
        "lamp": ScoredClass(((0.5, False),), 0),
    }
    assert mean_precision(counts) == 0.5 and mean_precision(counts, only=PAPER_CLASSES) == 1.0
    assert mean_precision(counts, only=("bed",)) is None


def test_the_true_meshes_are_perfect_however_small_and_close_they_are() -> None:
    sizes = {
        "table1": (1.0, 0.6, 0.5),
        "book1": (0.15, 0.03, 0.2),
        "book2": (0.15, 0.025, 0.2),
        "cup1": (0.07, 0.07, 0.09),
    }
    places = {
        "table1": (0.0, 0.0, 0.25),
        "book1": (0.0, 0.0, 0.6),
        "book2": (0.0, 0.0275, 0.6),
        "cup1": (0.2, 0.1, 0.545),
    }
    meshes = {n: Mesh(box_mesh(s).vertices + np.array(places[n]), box_mesh(s).faces) for n, s in sizes.items()}
    entities = [predicted_entity(n, n[:-1], 1.0, mesh) for n, mesh in meshes.items()]
    # Seen from above and the sides: another sample, not of the faces that lie on each other.
    rng, seen = np.random.default_rng(1), []
    for mine, mesh in zip(entities, meshes.values(), strict=True):
        points = sample_surface(mesh, 4000, rng)[0]
        with RayScene() as others:
            for number, (name, other) in enumerate(meshes.items()):
                if name != mine.name:
                    others.add(TriangleMesh(other.vertices, other.faces), instance=number)
            free = others.closest_points(points).distances > 1e-3
        seen.append(replace(mine, points=points[free], mesh=None))
    assert np.diag(compare(entities, truth(*seen)).iou).min() > 0.999


def test_missing_wrong_and_renamed_entities_are_counted() -> None:
    guess = [entity("chair1", 0.0), entity("sofa1", 1.0), entity("table1", 2.0), entity("table2", 5.0)]
    counts = panoptic_counts(compare(guess, TRUE))
    assert (counts["chair"].matched, counts["chair"].wrong, counts["chair"].missed) == (1, 0, 1)
    assert (counts["sofa"].wrong, counts["table"].wrong) == (1, 1)
    assert counts["chair"].rq == pytest.approx(2 / 3) and counts["table"].rq == pytest.approx(2 / 3)


def test_surface_where_there_is_none_costs_overlap_and_leniently_does_too() -> None:
    near = entity("table1", 2.0)
    ghost = np.concatenate([near.points, near.points[: len(near.points) // 2] + [0.0, 0.0, 3.0]])
    guess = [PanopticEntity("table1", "table", 1.0, ghost, near.box)]
    assert compare(guess, TRUE).iou[0, 2] == pytest.approx(1 / 1.5, abs=0.01)


def test_unseen_surface_counts_but_not_leniently() -> None:
    part = entity("table1", 2.0)
    half = PanopticEntity("table1", "table", 1.0, part.points[part.points[:, 2] > 0.05], part.box)
    alone = truth(part)
    assert compare([half], alone).iou[0, 0] < 0.6
    assert compare([half], alone, lenient=True).iou[0, 0] == 1.0


def test_what_was_hardly_seen_is_neither_missed_nor_wrong() -> None:
    actual = truth(entity("chair1", 0.0), entity("table1", 2.0), void=("table1",))
    assert "table" not in panoptic_counts(compare([entity("chair1", 0.0)], actual))
    assert panoptic_counts(compare([entity("sofa1", 2.0)], actual)) == {"chair": PanopticCount(missed=1)}


def test_an_empty_map_finds_nothing() -> None:
    found = compare([], TRUE)
    assert class_means(panoptic_counts(found)) == (0.0, 0.0, 0.0) and not np.isfinite(found.completeness).any()


def test_one_hit_of_four_is_worth_what_the_definition_says() -> None:
    one = ScoredClass(((0.9, True),), true=4)
    assert one.average_precision() == pytest.approx(3 / 11) and one.average_precision(lenient=True) == 1.0
    assert ScoredClass((), true=4).average_precision() == 0.0
    assert ScoredClass((), true=4).average_precision(lenient=True) is None


def test_a_true_thing_is_found_once_by_the_surest() -> None:
    guess = [entity("table1", 2.0, score=0.4), entity("table2", 2.0, score=0.9)]
    iou = np.array([[0.0, 0.0, 0.9], [0.0, 0.0, 0.8]])
    assert scored_classes(guess, TRUE, iou)["table"].hits == ((0.9, True), (0.4, False))


def scores(matched: int) -> MapScores:
    counts = {"chair": PanopticCount(matched, 1, 0, 0.8 * matched)}
    hits = {"chair": ScoredClass(((0.5, True),), 2)}
    return MapScores(counts, counts, counts, hits, hits, hits, (0.001, 0.004), 0.9, 4, 10)


def test_scores_of_rooms_add_up_and_survive_their_file() -> None:
    assert scores_from_json(scores_to_json(scores(3))) == scores(3)
    both = summed([scores(1), scores(3)])
    chair = both.panoptic["chair"]
    assert (chair.matched, chair.wrong, chair.missed) == (4, 2, 0) and chair.overlap == pytest.approx(3.2)
    assert both.nodes == 20
    assert both.instances["chair"].true == 4


def test_tables_name_every_room_and_method() -> None:
    task = RoomMapTask(7, False, ("full", "voxbloxpp"), 1.0, 10, 0.02)
    done = {task: {"full": scores(3), "voxbloxpp": scores(1)}}
    tables = tables_of(done, done[task])
    assert tables["Table 1: PQ, SQ, RQ, mAP@0.5 by room"][1][0][0] == "rooms:7"
    assert all(len(row) == len(columns) for columns, rows in tables.values() for row in rows)
    assert ordering(done, "full", "voxbloxpp") == (1, 1)


def test_files_tell_what_segmented_the_images_and_whose_poses_they_are(tmp_path: Path) -> None:
    task = RoomMapTask(7, False, ("full",), 1.0, 10, 0.02)
    assert task.variant == ""
    assert replace(task, strength=0.0).variant == "_strength-0"
    assert replace(task, segmenter="learned", poses="estimated").variant == "_learned_estimated"
    assert replace(task, segmenter="nets/mine.onnx").variant == "_nets-mine-onnx"
    files = {replace(task, segmenter=name).file for name in ("oracle", "learned", "nets/mine.onnx")}
    assert len(files) == 3
    done = {replace(task, segmenter="learned"): {"full": scores(3)}}
    assert write_panoptic(done, tmp_path) == ["panoptic_learned.json", "panoptic_learned.txt"]
    assert "segmenter learned" in (tmp_path / "panoptic_learned.txt").read_text(encoding="utf-8")


def test_results_of_another_network_are_not_carried_on(tmp_path: Path) -> None:
    network = tmp_path / "segments.onnx"
    network.write_bytes(b"one")
    task = RoomMapTask(7, False, ("full",), 1.0, 10, 0.02, segmenter=str(tmp_path))
    before = task.code()
    network.write_bytes(b"another")
    assert task.code() != before
    assert replace(task, segmenter="oracle").code() not in (before, task.code())
