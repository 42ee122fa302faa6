"""The run's folder: refusals, lines on disk at once, formats."""

import csv
from pathlib import Path

import numpy as np
import pytest
import yaml

from simtrack.contracts import Belief, Localization, Relation, Status
from simtrack.errors import InvalidValueError, OutputExistsError
from simtrack.evaluation.record import Interval, RelationTimeline
from simtrack.evaluation.run_folder import POSES, EstimateTables, RunFolder, TruthTables
from simtrack.evaluation.tracking import TrackingEvaluator

SEEN = {"relay-a": 1.0, "relay-b": 0.5, "meter": 0.0}


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def belief(world, tracks) -> Belief:
    localization = Localization(5, np.eye(4), np.eye(6), Status.OK)
    return Belief(5, localization, world.T_map_camera, tuple(tracks), None, None, frozenset())


def test_lines_are_on_disk_before_the_tables_are_closed(tmp_path, world, scorers) -> None:
    tracks = [world.track("relay-a", 7)]
    frames = TrackingEvaluator(scorers).observe(tracks, world.truth(5), SEEN)
    folder = RunFolder(tmp_path / "run")
    folder.write_config({"seed": 3, "scene": {"name": "workbench"}})
    assert yaml.safe_load((folder.path / "config.yaml").read_text())["seed"] == 3
    with EstimateTables(folder.path) as estimates, TruthTables(folder.path, "lab_floor", ["relay", "meter"]) as truths:
        estimates.add(belief(world, tracks))
        truths.add(0, belief(world, tracks), np.eye(4), frames)
        poses = rows(folder.path / "poses.csv")
        assert [row["object"] for row in poses] == ["relay-a", "relay-b", "meter"]
        assert all(set(row) == set(POSES) and None not in row.values() for row in poses)
        assert float(poses[0]["translation_error"]) == 0.0
        assert poses[1]["status"] == "untracked"
        assert len(rows(folder.path / "trajectory.csv")) == len(rows(folder.path / "estimates.csv")) == 1
        assert [row["track"] for row in rows(folder.path / "tracks.csv")] == ["7"]
        (bop,) = rows(folder.path / "simtrack_labfloor-test.csv")
        assert bop["obj_id"] == "2"
        expected = 1000 * frames[0].T_camera_object[:3, 3]
        assert np.array(bop["t"].split(), dtype=float) == pytest.approx(expected, abs=1e-5)
        assert len(bop["R"].split()) == 9


def test_existing_folder_is_refused_unless_told_to_overwrite(tmp_path) -> None:
    RunFolder(tmp_path / "run")
    mine = tmp_path / "run" / "notes.txt"
    mine.write_text("keep me")
    (tmp_path / "run" / "report.html").write_text("old")
    with pytest.raises(OutputExistsError, match="--overwrite"):
        RunFolder(tmp_path / "run")
    RunFolder(tmp_path / "run", overwrite=True)
    assert mine.read_text() == "keep me"
    assert not (tmp_path / "run" / "report.html").exists()


def test_a_place_that_cannot_be_written_is_named(tmp_path) -> None:
    file = tmp_path / "file"
    file.write_text("")
    with pytest.raises(InvalidValueError, match="file"):
        RunFolder(file, overwrite=True)
    with pytest.raises(InvalidValueError, match="written"):
        RunFolder(file / "below")


def test_relations_become_intervals() -> None:
    on, near = Relation("a", "on", "b"), Relation("a", "near", "b")
    timeline = RelationTimeline()
    for stamp, held in enumerate([{on}, {on, near}, {near}, {near, on}]):
        timeline.observe(stamp, frozenset(held))
    assert timeline.intervals() == [Interval(on, 0, 2), Interval(near, 1, 3), Interval(on, 3, 3)]
