import importlib.util
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from simtrack.contracts import NANOSECONDS, PoseHypothesis, Status, TrackStatus
from simtrack.errors import UnknownNameError
from simtrack.objects import load_object
from simtrack.perception.tracking.birth import Prober
from simtrack.perception.tracking.claims import BEHIND
from simtrack.perception.tracking.follow_up import Candidate
from simtrack.perception.tracking.target import TrackerConfig
from simtrack.perception.tracking.tracker import ObjectTracker
from simtrack.sensors.depth_noise import PRESETS, apply_depth_noise

spec = importlib.util.spec_from_file_location("bench_scenes", Path(__file__).with_name("scenes.py"))
assert spec is not None and spec.loader is not None
scenes = importlib.util.module_from_spec(spec)
spec.loader.exec_module(scenes)

PERIOD = NANOSECONDS // 30
COVARIANCE = np.diag([0.03**2] * 3 + [0.2**2] * 3)


class Film:
    """Feeds a tracker with noisy frames of a bench and detections that come five frames late."""

    def __init__(self, *names: str, seed: int = 0, config: TrackerConfig | None = None) -> None:
        self.models = {name: load_object(name) for name in names}
        self.tracker = ObjectTracker(self.models, config)
        self.world = scenes.BenchWorld()
        self.rng = np.random.default_rng(seed)
        self.step = 0
        self.poses: dict[int, tuple[str, np.ndarray]] = {}
        self.visible: set[int] = set()
        self.believed = scenes.T_MAP_CAMERA
        self._waiting: list[tuple[int, list[PoseHypothesis]]] = []

    def put(self, name: str, x: float, y: float, yaw: float) -> int:
        T = scenes.on_bench(self.models[name], x, y, yaw)
        instance = self.world.add(self.models[name], T)
        self.poses[instance] = (name, T)
        self.visible.add(instance)
        return instance

    def move(self, instance: int, T: np.ndarray) -> None:
        self.world.scene.set_pose(instance, T)
        self.poses[instance] = (self.poses[instance][0], T)

    def hide(self, instance: int) -> None:
        self.world.scene.set_enabled(instance, False)
        self.visible.discard(instance)

    def run(self, frames: int, cover: tuple[slice, slice] | None = None):
        result = None
        for _ in range(frames):
            self.step += 1
            stamp = self.step * PERIOD
            depth = apply_depth_noise(self.world.depth(), None, scenes.INTRINSICS, PRESETS["xtion"], self.rng)
            if cover is not None:
                depth[cover] = np.float32(0.5)
            if self.step % 5 == 1:
                seen = [self._hypothesis(i, stamp) for i in sorted(self.visible)] if cover is None else []
                self._waiting.append((self.step + 5, seen))
            due = [h for when, seen in self._waiting if when <= self.step for h in seen]
            self._waiting = [w for w in self._waiting if w[0] > self.step]
            frame = self.world.frame(stamp, depth)
            result = self.tracker.update(frame, self.believed, scenes.COVARIANCE, due)
        assert result is not None
        return result

    def _hypothesis(self, instance: int, stamp: int) -> PoseHypothesis:
        name, T = self.poses[instance]
        T = scenes.displaced(scenes.in_camera(T), 0.01, 8.0, self.rng)
        T[:3, 3] *= 1.0 + 0.03 * self.rng.standard_normal()
        return PoseHypothesis(name, stamp, T, COVARIANCE, 1.0, 0.9)

    def error(self, track, instance: int) -> float:
        return float(np.linalg.norm(track.T_map_object[:3, 3] - self.poses[instance][1][:3, 3]))


def test_what_is_new_outlives_a_correction_of_where_the_robot_is() -> None:
    """As at the start of a run: the first image is taken before the first scan tells where the robot stands."""
    film = Film("multimeter")
    multimeter = film.put("multimeter", 0.05, 0.0, 0.7)
    film.believed = scenes.displaced(scenes.T_MAP_CAMERA, 0.05, 3.0, film.rng)
    film.run(4)
    film.believed = scenes.T_MAP_CAMERA
    (track,) = film.run(6).tracks  # the next detection comes after them
    assert track.status is TrackStatus.CONFIRMED
    assert film.error(track, multimeter) < 0.003


def test_birth_tracking_and_identity_of_two_of_a_class() -> None:
    film = Film("powerdrill", "relay")
    drills = [film.put("powerdrill", x, 0.0, yaw) for x, yaw in ((-0.2, 0.5), (0.2, 2.0))]
    relay = film.put("relay", 0.0, -0.1, 1.0)
    result = film.run(15)
    assert result.status is Status.OK
    assert [t.status for t in result.tracks] == [TrackStatus.CONFIRMED] * 3
    for instance in (*drills, relay):
        nearest = min(result.tracks, key=lambda t: film.error(t, instance))
        assert film.error(nearest, instance) < 0.003
    ids = {t.id for t in result.tracks}
    later = film.run(10)
    assert {t.id for t in later.tracks} == ids
    assert not any(t.moving for t in later.tracks)
    film.tracker.close()


def test_detections_of_one_of_two_side_by_side_leave_the_other_its_track() -> None:
    """Of two screwdrivers 8 cm apart the detector finds one at first, then for long the other alone."""
    film = Film("screwdriver")
    first, second = film.put("screwdriver", 0.0, 0.0, 1.7), film.put("screwdriver", 0.08, 0.0, 1.7)
    film.visible = {first}
    (before,) = film.run(15).tracks
    film.visible = {second}
    tracks = {track.id: track for track in film.run(60).tracks}
    assert len(tracks) == 2
    assert tracks[before.id].status is TrackStatus.CONFIRMED
    (other,) = (track for track in tracks.values() if track.id != before.id)
    for track, instance in ((tracks[before.id], first), (other, second)):
        assert np.linalg.norm(track.T_map_object[:3, 3] - film.poses[instance][1][:3, 3]) < 0.01


def test_occluded_is_kept_and_gone_is_lost_and_found_again() -> None:
    film = Film("powerdrill")
    drill = film.put("powerdrill", 0.0, 0.0, 0.5)
    track = film.run(30).tracks[0]
    hidden = film.run(20, cover=(slice(None), slice(None)))
    assert hidden.tracks[0].status is TrackStatus.OCCLUDED
    np.testing.assert_allclose(hidden.tracks[0].T_map_object, track.T_map_object, atol=5e-3)
    film.hide(drill)
    gone = film.run(15)
    assert not any(t.believed for t in gone.tracks)
    film.world.scene.set_enabled(drill, True)
    film.visible.add(drill)
    film.move(drill, scenes.on_bench(film.models["powerdrill"], 0.25, 0.1, -1.0))
    found = [t for t in film.run(20).tracks if t.believed]
    assert [t.id for t in found] == [track.id]
    assert film.error(found[0], drill) < 0.003
    film.tracker.close()


def test_a_carried_object_is_followed() -> None:
    film = Film("multimeter")
    meter = film.put("multimeter", -0.2, 0.0, 0.3)
    track = film.run(12).tracks[0]
    for k in range(30):
        T = film.poses[meter][1].copy()
        T[:3, 3] += [0.4 / 30, 0.0, 0.1 / 30]
        film.move(meter, T)
        track = film.run(1).tracks[0]
        assert track.status is TrackStatus.CONFIRMED
        assert film.error(track, meter) < 0.012, k
    assert track.moving
    assert abs(track.velocity[0] - 0.4) < 0.08
    film.tracker.close()


def test_detections_of_nothing_are_not_believed() -> None:
    film = Film("powerdrill", "relay")
    film.put("powerdrill", 0.0, 0.0, 0.5)
    film.run(12)
    ghosts = [
        PoseHypothesis("relay", film.step * PERIOD, scenes.in_camera(T), COVARIANCE, 1.0, 0.9)
        for T in (
            scenes.on_bench(film.models["relay"], 0.3, 0.2, 0.0),
            scenes.on_bench(film.models["relay"], 0.0, 0.0, 0.0),
        )
    ]
    frame = film.world.frame((film.step + 1) * PERIOD)
    result = film.tracker.update(frame, scenes.T_MAP_CAMERA, scenes.COVARIANCE, ghosts)
    assert [t.class_name for t in result.tracks if t.believed] == ["powerdrill"]
    film.tracker.close()


def test_unusable_frames_are_statuses() -> None:
    film = Film("relay")
    film.put("relay", 0.0, 0.0, 0.0)
    before = film.run(15).tracks
    stamp = film.step * PERIOD
    stale = film.tracker.update(film.world.frame(stamp), scenes.T_MAP_CAMERA, scenes.COVARIANCE)
    assert stale.status is Status.STALE
    for value in (0.0, np.nan, np.inf, -1.0):
        stamp += PERIOD
        empty = film.world.frame(stamp, np.full((240, 320), value, np.float32))
        result = film.tracker.update(empty, scenes.T_MAP_CAMERA, scenes.COVARIANCE)
        assert result.status is Status.NO_DATA
        assert [t.id for t in result.tracks] == [t.id for t in before]
        assert all(np.isfinite(t.T_map_object).all() and np.isfinite(t.covariance).all() for t in result.tracks)
    with pytest.raises(UnknownNameError, match="relay"):
        h = PoseHypothesis("teapot", stamp, np.eye(4), np.eye(6), 1.0, 1.0)
        film.tracker.update(film.world.frame(stamp + PERIOD), scenes.T_MAP_CAMERA, scenes.COVARIANCE, [h])
    film.tracker.close()


def test_what_turns_up_before_its_loss_is_seen_keeps_its_identity() -> None:
    film = Film("relay")
    relay = film.put("relay", -0.15, 0.0, 0.5)
    (before,) = film.run(30).tracks
    assert before.status is TrackStatus.CONFIRMED
    film.move(relay, scenes.on_bench(film.models["relay"], 0.15, 0.0, 0.5))
    old, tracks = film.tracker._targets[0], ()
    for _ in range(30):
        old.missing_since = None  # not yet: something may have been in the way
        tracks = film.run(1).tracks
        if len(tracks) == 2:
            break
    assert [t.status for t in tracks] != [TrackStatus.CONFIRMED] * 2
    film.tracker._lose(old)
    (after,) = film.run(10).tracks
    assert (after.id, after.status) == (before.id, TrackStatus.CONFIRMED)
    assert film.error(after, relay) < 0.003
    film.tracker.close()


def test_live_births_leave_the_frames_little_to_catch_up_with(monkeypatch: pytest.MonkeyPatch) -> None:
    film = Film("relay", config=TrackerConfig(wait=False))
    relay = film.put("relay", 0.1, -0.1, 1.0)
    frames, gate, follow = threading.current_thread(), threading.Event(), Candidate.follow
    followed: list[tuple[bool, int]] = []

    def noted(candidate: Candidate, prober: Prober, views: Sequence, config: TrackerConfig) -> None:
        by_frame = threading.current_thread() is frames
        followed.append((by_frame, len(views)))
        if not by_frame:
            assert gate.wait(60.0)
        follow(candidate, prober, views, config)

    monkeypatch.setattr(Candidate, "follow", noted)
    while not film.tracker._claims._working:
        film.run(1)
    film.run(10)  # meanwhile the thread cannot go on
    gate.set()
    result = film.run(1)
    for _ in range(5):
        while not all(work._ended for _, _, work in film.tracker._claims._working):
            time.sleep(0.002)
        result = film.run(1)
    assert min(film.error(t, relay) for t in result.tracks) < 0.005
    by_thread = [count for by_frame, count in followed if not by_frame]
    assert by_thread[1] >= 10, "what came while it was stuck"
    assert all(count <= BEHIND for by_frame, count in followed if by_frame)
    film.tracker.close()


RAISES = """
from tests.perception.tracking.test_tracker import Film
film = Film("relay")
film.put("relay", 0.0, 0.0, 0.0)
while not film.tracker._claims._working:
    film.run(1)
raise RuntimeError("in the middle")
"""


def test_a_script_that_raises_ends_though_a_claim_is_worked_at() -> None:
    root = Path(__file__).resolve().parents[3]
    done = subprocess.run([sys.executable, "-c", RAISES], cwd=root, capture_output=True, text=True, timeout=300)
    assert done.returncode == 1
    assert done.stderr.endswith("RuntimeError: in the middle\n")
