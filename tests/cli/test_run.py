"""Runs from the command line: what lies in their folder, that they repeat, that a stop keeps what was measured."""

import csv
import json
import math
import signal
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from simtrack.evaluation.metrics import read_metrics
from tests.cli.commands import Done, refused, simtrack_command, simtrack_process, start

SECONDS = 1.2
ASKED_FOR = """
localization.ate_rmse localization.rotation_rmse
tracking.static.translation_error.median tracking.static.translation_error.p95
tracking.moving.translation_error.median tracking.moving.translation_error.p95
tracking.rotation_error.median tracking.floor_ratio tracking.map.translation_error.median
tracking.add_s_auc tracking.recall tracking.false_tracks tracking.id_switches tracking.reacquisition_time.p95
world.known_share loop.gaze_gain
presegmentation.camera.known_rejected presegmentation.camera.unknown_recall presegmentation.camera.reduction
presegmentation.lidar.known_rejected presegmentation.lidar.unknown_recall presegmentation.lidar.reduction
presegmentation.objects_found relations.f1 relations.f1.on relations.f1.left-of
speed.frames_per_second speed.stage.tracking.median speed.peak_memory
""".split()  # noqa: SIM905

pytestmark = pytest.mark.slow


def command(*arguments: object, run: Callable[..., Done] = simtrack_command) -> str:
    done = run(*arguments)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A short run with a log of its feed beside it."""
    path = tmp_path_factory.mktemp("runs") / "first"
    log = path.with_suffix(".mcap")
    said = command("run", "--duration", SECONDS, "--renderer", "embree", "--out", path, "--log", log)
    assert "detector: keypoints (the networks that come along know all objects of the scene)" in said
    return path


def test_folder_is_complete(folder: Path) -> None:
    names = {path.name for path in folder.iterdir()}
    assert names == {
        "config.yaml", "estimates.csv", "tracks.csv", "trajectory.csv", "poses.csv", "simtrack_workbench-test.csv",
        "graph.json", "map.npz", "metrics.json", "moments", "report.html",
    }  # fmt: skip
    with (folder / "trajectory.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert len(lines) == math.floor(SECONDS * 30)
    report = (folder / "report.html").read_text()
    assert "workbench" in report
    assert "detector keypoints (the networks that come along know all objects" in report
    assert "Partial" not in report


def test_metrics_have_values_or_reasons(folder: Path) -> None:
    json.loads((folder / "metrics.json").read_text(), parse_constant=lambda name: pytest.fail(f"{name} in the metrics"))
    metrics = read_metrics(folder / "metrics.json")
    assert set(ASKED_FOR) <= set(metrics)
    assert all(metric.unit for metric in metrics.values())
    assert all(metric.reason for metric in metrics.values() if metric.value is None)
    assert metrics["run.partial"].value is False
    assert metrics["localization.ate_rmse"].value is not None
    assert metrics["loop.gaze_gain"].value is None


def test_graph_answers_queries(folder: Path) -> None:
    assert "workbench" in command("query", folder, "on workbench")
    assert "relation" in command("query", folder, "? left-of multimeter")


def test_replay_of_the_log_repeats_the_estimates(folder: Path, tmp_path: Path) -> None:
    command("replay", folder.with_suffix(".mcap"), "--out", tmp_path / "replay")
    for name in ("estimates.csv", "tracks.csv"):
        assert (tmp_path / "replay" / name).read_bytes() == (folder / name).read_bytes(), name


def test_same_seed_gives_the_same_with_one_thread_and_two(folder: Path, tmp_path: Path) -> None:
    again = tmp_path / "again"
    arguments = "run", "--duration", SECONDS, "--renderer", "embree", "--out", again, "--threads", 1
    command(*arguments, run=simtrack_process)  # another process: nothing that this one holds may matter
    ours, theirs = (read_metrics(path / "metrics.json") for path in (folder, again))
    assert set(ours) == set(theirs)
    assert {n: m for n, m in ours.items() if theirs[n] != m and not n.startswith("speed.")} == {}
    for name in ("estimates.csv", "tracks.csv", "trajectory.csv", "poses.csv", "simtrack_workbench-test.csv"):
        assert (again / name).read_bytes() == (folder / name).read_bytes(), name


FALTERS = """
from simtrack.contracts import Status, TrackerResult


class Falters:
    calls = 0

    def update(self, frame, T_map_camera, covariance, hypotheses=()):
        self.calls += 1
        if self.calls in (3, 4):
            raise RuntimeError("no memory")
        return TrackerResult(0 if self.calls == 6 else frame.stamp, (), Status.OK)
"""


def test_a_tracker_of_others_that_falters_misses_its_frames(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "falters.py").write_text(FALTERS)
    monkeypatch.syspath_prepend(tmp_path)
    out = tmp_path / "run"
    arguments = "run", "--duration", 0.4, "--renderer", "embree", "--tracker", "falters:Falters", "--out", out
    done = simtrack_command(*arguments)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "the tracker missed 3 frames: frames 2-3, 5" in " ".join(done.stderr.split())
    metrics = read_metrics(out / "metrics.json")
    assert (metrics["foreign.tracker.frames"].value, metrics["run.images"].value) == (12, 12)
    assert (metrics["foreign.tracker.raised"].value, metrics["foreign.tracker.invalid"].value) == (2, 1)
    with (out / "faults.csv").open() as file:
        rows = [(row["frame"], row["kind"], row["message"]) for row in csv.DictReader(file)]
    told = "RuntimeError: no memory (falters.py:11, in update)"
    assert rows[:2] == [("2", "raised", told), ("3", "raised", told)]
    assert "falters:Falters" in (out / "config.yaml").read_text()


def test_a_tracker_that_cannot_be_loaded_is_refused(tmp_path: Path) -> None:
    told = refused("run", "--tracker", "no_such_module_at_all:Tracker", "--out", tmp_path / "run")
    assert "tracker 'no_such_module_at_all:Tracker': no module 'no_such_module_at_all'" in told
    assert not (tmp_path / "run").exists()
    assert "allowed" in refused("run", "--stage-limit", 0, "--out", tmp_path / "run")


def test_conditions_reach_the_scene_and_are_refused_if_unknown(tmp_path: Path) -> None:
    import yaml

    short = "--duration", "0.1", "--renderer", "embree", "--out", tmp_path / "run"
    command("run", "workbench", "--given", "noise=0,latency=0.25", *short)
    config = yaml.safe_load((tmp_path / "run" / "config.yaml").read_text(encoding="utf-8"))
    assert (config["detector"], config["oracle"]["latency"]) == ("oracle", 0.25)
    assert "conditions" in config["detector_reason"]
    assert config["scene_file"]["sensors"]["lidar_noise"]["sigma"] == 0.0
    told = refused("run", "workbench", "--given", "fog=1")
    assert "fog" in told and "noise" in told


def test_a_stop_keeps_what_was_measured(tmp_path: Path) -> None:
    path = tmp_path / "stopped"
    process = start("run", "--duration", 600, "--renderer", "embree", "--out", path)
    for _ in range(3000):
        file = path / "trajectory.csv"
        if file.is_file() and len(file.read_bytes().splitlines()) > 20:  # errors count from 0.5 s
            break
        assert process.poll() is None, process.communicate()
        time.sleep(0.1)
    process.send_signal(signal.SIGINT)
    _, stderr = process.communicate(timeout=120)
    assert process.returncode == 130, stderr
    assert "partial" in stderr
    metrics = read_metrics(path / "metrics.json")
    assert metrics["run.partial"].value is True
    assert metrics["localization.ate_rmse"].value is not None
    assert "Partial" in (path / "report.html").read_text()
