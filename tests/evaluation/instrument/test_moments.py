"""The worst moments are kept, and one of them done again gives the same to the bit."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from simtrack.contracts import NANOSECONDS, CameraIntrinsics, PoseHypothesis, Track, TrackStatus
from simtrack.errors import FileFormatError, InvalidValueError
from simtrack.evaluation.instrument.examination import examine
from simtrack.evaluation.instrument.moments import KEPT, MomentKeeper, kept_frames, read_moment, stored_frames
from simtrack.evaluation.tracking import ObjectFrame
from simtrack.geometry.transforms import perturb, rotation_from_rpy, transform
from simtrack.objects import load_object
from simtrack.perception.tracking.registration import Registration
from simtrack.perception.tracking.registration_config import RegistrationConfig
from simtrack.perception.tracking.target import tracked_model
from simtrack.perception.tracking.trace import RegistrationTrace
from simtrack.raycast import RayBundle, RayScene, TriangleMesh
from simtrack.report.moment_page import caption, rows, told_error, write_picture
from tests.cli.commands import simtrack_command

K = CameraIntrinsics(160, 120, 140.0, 140.0, 79.5, 59.5)
TRUE = transform(rotation_from_rpy(0.4, -0.3, 0.5), (0.02, -0.01, 0.6))
MODELS = {"relay": load_object("relay")}


@pytest.fixture(scope="module")
def trace() -> RegistrationTrace:
    bundle = RayBundle.from_camera(K)
    with RayScene() as scene:
        mesh = MODELS["relay"].mesh
        scene.add(TriangleMesh(mesh.vertices, mesh.faces), TRUE)
        hits = scene.cast(bundle, np.eye(4))
    depth = np.where(np.isfinite(hits.distances), hits.distances, 1.2).reshape(120, 160).astype(np.float32)
    predicted = {4: perturb(TRUE, np.array([0.004, -0.003, 0.005, 0.02, 0.0, -0.03]))}
    registration = Registration(RegistrationConfig())
    registration.add(4, tracked_model(MODELS["relay"]))
    results = registration.track(depth, K, predicted)
    registration.close()
    hypothesis = PoseHypothesis("relay", NANOSECONDS, TRUE, np.eye(6), 1.0, 0.9)
    return RegistrationTrace(2 * NANOSECONDS, depth, K, np.eye(4), {4: "relay"}, predicted, results, (hypothesis,))


def seen(trace: RegistrationTrace, error: float) -> list[ObjectFrame]:
    track = Track(
        4, "relay", TrackStatus.CONFIRMED, trace.stamp, TRUE, np.eye(6), TRUE, np.zeros(6), trace.stamp, 1.0, False,
        0.001, 0.9,
    )  # fmt: skip
    return [ObjectFrame(trace.stamp, "relay", "relay", 1.0, False, TRUE, track, translation_error=error)]


def test_a_moment_done_again_is_the_same_and_near_the_truth(trace: RegistrationTrace, tmp_path: Path) -> None:
    keeper = MomentKeeper()
    keeper.see(60, trace, seen(trace, 0.003))
    keeper.save(tmp_path)
    moment = read_moment(tmp_path, 60)
    assert moment.worst == "relay" and moment.hypotheses[0][:2] == ("relay", NANOSECONDS)
    found = examine(moment, MODELS, RegistrationConfig())
    assert found.largest_change == 0.0
    (thing,) = found.objects
    assert thing.predicted is not None and thing.registered is not None
    assert thing.predicted[0] == pytest.approx(np.linalg.norm([0.004, 0.003, 0.005]), rel=1e-3)
    assert thing.registered[0] < 0.1 * thing.predicted[0]
    assert np.nanmedian(np.abs(found.residuals)) < 5e-4
    assert found.outlines["true"].any() and rows(found)[0][0] == "relay"
    assert caption(moment) == ""
    untracked = replace(moment, objects=tuple(replace(o, track=None) for o in moment.objects))
    assert "no object's: 4 (relay)" in caption(untracked) and told_error(untracked) == "is not tracked"
    write_picture(found, tmp_path / "60.png")
    assert (tmp_path / "60.png").stat().st_size > 10_000
    other = examine(moment, MODELS, replace(RegistrationConfig(), inner_iterations=1))
    assert other.largest_change > 0.0


def test_the_worst_are_kept_half_a_second_apart(trace: RegistrationTrace, tmp_path: Path) -> None:
    keeper, rng = MomentKeeper(), np.random.default_rng(0)
    errors = rng.uniform(0.001, 0.05, 300)
    for frame, error in enumerate(errors):
        at = replace(trace, stamp=frame * NANOSECONDS // 10)
        keeper.see(frame, at, seen(at, float(error)))
    assert len(keeper.moments) == KEPT and max(errors[10:]) == keeper.moments[0].error
    stamps = np.sort([m.trace.stamp for m in keeper.moments])
    assert np.diff(stamps).min() >= NANOSECONDS // 2
    assert min(m.frame for m in keeper.moments) >= 10  # nothing can have been detected before
    keeper.save(tmp_path)
    assert stored_frames(tmp_path) == sorted(m.frame for m in keeper.moments)
    keeper.moments = keeper.moments[:2]
    keeper.save(tmp_path)
    assert len(stored_frames(tmp_path)) == 2


def test_what_was_not_kept_or_cannot_be_read_is_told(trace: RegistrationTrace, tmp_path: Path) -> None:
    keeper = MomentKeeper()
    keeper.see(60, trace, seen(trace, 0.003))
    keeper.save(tmp_path)
    with pytest.raises(FileFormatError, match="kept: 60"):
        read_moment(tmp_path, 61)
    with pytest.raises(InvalidValueError, match="classes"):
        examine(read_moment(tmp_path, 60), {}, RegistrationConfig())
    for config, message in ((None, "no such run"), ("scene: a\ntracker: b:C\n", "only simtrack's own tracker keeps"),
                            ("scene: a\n", "kept no moment")):  # fmt: skip
        folder = tmp_path / message.replace(" ", "-")
        if config is not None:
            folder.mkdir()
            (folder / "config.yaml").write_text(config)
            MomentKeeper().save(folder)
            assert not (folder / "moments").exists()
        done = simtrack_command("debug", folder)
        assert done.returncode == 2 and message in done.stderr
    (tmp_path / "config.yaml").write_text("scene: a\ntracker: null\n")
    assert kept_frames(tmp_path) == [60]
    (tmp_path / "moments" / "60.npz").write_bytes(b"nonsense")
    with pytest.raises(FileFormatError):
        read_moment(tmp_path, 60)
