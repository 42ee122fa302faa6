"""Verdicts: right scenes pass, scenes made to fail in one way fail for that reason, nothing takes the check along."""

import json
import signal
import subprocess
import sys
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from simtrack.cli.main import main
from simtrack.errors import InvalidValueError, UnknownNameError
from simtrack.geometry.transforms import exp_so3, transform
from simtrack.perception.reconstruction.body_tree import Body, BodyJoint, BodyTree
from simtrack.perception.reconstruction.files import write_scene
from simtrack.plausibility import check as module
from simtrack.plausibility.check import ENGINES, answer_of, check_urdf, judge
from simtrack.plausibility.child import run
from simtrack.plausibility.verdict import CheckConfig, CheckReport
from tests.plausibility.scenes import at, block, floor, kitchen, on

QUICK = CheckConfig(duration=2.0)


def checked(tree: BodyTree, folder: Path) -> CheckReport:
    return checked_file(write_scene(tree, folder / "scene").urdf, folder)


def checked_file(urdf: Path, folder: Path) -> CheckReport:
    """`check_urdf` without the processes, which take longer than the check."""
    answers = []
    for engine in ENGINES:
        (folder / engine).mkdir()
        job = {"engine": engine, "file": str(urdf), "root": None, "pictures": None, "config": asdict(QUICK)}
        answers.append(answer_of(json.loads(json.dumps(run(job, folder / engine)))))
    return judge(urdf, answers, QUICK)


def kinds(report: CheckReport, subject: str | None = None, severity: str = "problem") -> set[str]:
    return {
        finding.kind
        for finding in report.findings
        if finding.severity == severity and subject in (None, finding.subject)
    }


def test_a_sound_scene_is_plausible_in_both_engines(tmp_path: Path) -> None:
    report = check_urdf(write_scene(kitchen(), tmp_path).urdf, config=QUICK, out=tmp_path / "out")
    assert report.verdict == "plausible" and report.exit_code == 0, [str(f) for f in report.findings]
    assert [result.engine for result in report.engines] == ["pybullet", "mujoco"]
    assert report.agreement == 1.0
    for result in report.engines:
        assert result.plausible
        assert {body.name: body.static for body in result.bodies} == {"floor": True, "cup": False, "stool": False}
        (hinge,) = result.joints
        assert hinge.reached == 1.0 and hinge.follows < 1e-5
    document = json.loads((tmp_path / "out" / "check.json").read_text())
    assert document["verdict"] == "plausible" and len(document["engines"]) == 2
    for name in ("before.png", "after.png"):
        assert (tmp_path / "out" / name).read_bytes().startswith(b"\x89PNG")


def test_a_cup_hung_in_the_air_falls(tmp_path: Path) -> None:
    """A floating joint that an engine froze would keep it there."""
    report = checked(kitchen(cup_above=0.25), tmp_path)
    assert report.verdict == "not plausible" and report.exit_code == 1
    assert {"drifted", "floating"} <= kinds(report, "cup")
    assert kinds(report) == kinds(report, "cup")
    for result in report.engines:
        cup = next(body for body in result.bodies if body.name == "cup")
        assert cup.gap == pytest.approx(0.25, abs=2e-4)
        assert cup.drift >= 0.24


def test_overlapping_bodies_are_told(tmp_path: Path) -> None:
    report = checked(kitchen(cup_above=-0.03), tmp_path)
    assert report.verdict == "not plausible"
    assert "penetrating" in kinds(report, "cup")
    for result in report.engines:
        cup = next(body for body in result.bodies if body.name == "cup")
        assert cup.penetration_start == pytest.approx(0.03, abs=5e-4)


def test_fixed_things_in_each_other_are_told_though_they_cannot_move(tmp_path: Path) -> None:
    """The third stands in the second by less than is told; walls without mass may meet as they like."""
    size = (0.4, 0.4, 0.4)
    things = [block(name, size, 20.0, on("floor", name, at(x, 0, 0.2), "fixed"), convex=True)
              for name, x in (("stove", 0.0), ("fridge", 0.35), ("sink", 0.746))]  # fmt: skip
    walls = [block(name, (4.0, 0.1, 1.0), 0.0, on("floor", name, T, "fixed"))
             for name, T in (("north", at(0, 2, 0.5)), ("south", at(0, 1.95, 0.5)))]  # fmt: skip
    root = Body("scene")
    ground = block("floor", (4.0, 4.0, 0.1), 0.0, on("scene", "floor", at(0, 0, -0.05), "fixed"))
    things = [replace(thing, joint=on("floor", thing.name, at(0, 0, 0.05) @ thing.joint.T_parent_body, "fixed"))
              for thing in things if thing.joint is not None]  # fmt: skip
    walls = [replace(wall, joint=on("scene", wall.name, wall.joint.T_parent_body, "fixed"))
             for wall in walls if wall.joint is not None]  # fmt: skip
    report = checked(BodyTree("kitchen", (root, ground, *things, *walls)), tmp_path)
    found = [(f.severity, f.subject) for f in report.findings if f.kind == "overlap"]
    assert found == [("warning", "fridge")]
    (pair,) = report.engines[0].inside
    assert pair[:2] == ("fridge", "stove")
    assert pair[2] == pytest.approx(0.05, abs=0.002)
    assert report.verdict == "plausible"


def test_what_stands_on_too_little_topples(tmp_path: Path) -> None:
    shelf = block("shelf", (0.4, 0.3, 0.7), 10.0, on("floor", "shelf", at(0.0, 0.0, 0.35)))
    lean = np.deg2rad(12.0)
    height = 0.5 * (0.5 * np.cos(lean) + 0.05 * np.sin(lean))
    leaning = transform(exp_so3(np.array([0.0, lean, 0.0])), (1.0, 0.0, height))
    picture = block("picture", (0.05, 0.3, 0.5), 1.0, on("floor", "picture", leaning))
    report = checked(BodyTree("room", (floor(), shelf, picture)), tmp_path)
    assert report.verdict == "not plausible"
    assert kinds(report, "picture") == {"toppled", "drifted"} and kinds(report, "shelf") == set()
    for result in report.engines:
        assert result.bodies[2].tilt == pytest.approx(np.pi / 2 - lean, abs=0.05)


def test_a_door_whose_axis_drives_it_into_the_body_is_told(tmp_path: Path) -> None:
    report = checked(kitchen(door_axis=1.0), tmp_path)
    assert report.verdict == "not plausible"
    assert "drives-into-body" in kinds(report, "hinge")
    assert all("drives-into-body" in result.joints[0].problems for result in report.engines)


def test_a_door_that_meets_other_furniture_is_noted_with_how_far_it_goes(tmp_path: Path) -> None:
    good = kitchen()
    wall = block("wall", (0.05, 1.0, 1.0), 0.5, on("floor", "wall", at(-0.1, -1.0, 0.5), "fixed"))
    report = checked(BodyTree("room", (*good.bodies[:3], wall)), tmp_path)
    assert report.verdict == "plausible", [str(f) for f in report.findings]
    assert "blocked" in kinds(report, "hinge", "note")
    corner = np.array([-0.075, -0.5]) - [-0.3, -0.262]  # of the wall, seen from the hinge
    expected = float(np.arctan2(-corner[1], corner[0]))
    step = 1.5 / (QUICK.sweep_steps - 1)
    for result in report.engines:
        assert expected - 1.5 * step < 1.5 * result.joints[0].reached < expected + 0.5 * step
        assert result.joints[0].blocked_by == "wall"


def test_a_door_before_which_something_stands_is_obstructed_and_not_at_fault(tmp_path: Path) -> None:
    """Its own object would let it open: so are real rooms. Another part of its own object would be at fault."""
    good = kitchen()
    wall = block("wall", (1.0, 0.02, 0.4), 0.5, on("floor", "wall", at(0.0, -0.288, 0.4), "fixed"))
    report = checked(BodyTree("room", (*good.bodies[:3], wall)), tmp_path)
    assert report.verdict == "plausible", [str(f) for f in report.findings]
    assert kinds(report, "hinge", "warning") == {"obstructed"}
    for result in report.engines:
        assert (result.joints[0].reached, result.joints[0].reached_alone) == (0.0, 1.0), result.engine
    slide = BodyJoint("slide", "prismatic", "cabinet", at(0.0, -0.288, 0.0), np.array([0.0, -1.0, 0.0]), 0.0, 0.1)
    (tmp_path / "own").mkdir()
    own = checked(BodyTree("room", (*good.bodies[:3], block("tray", (0.5, 0.02, 0.4), 1.0, slide))), tmp_path / "own")
    assert kinds(own, "hinge") == {"unreachable"}


def test_a_drawer_carries_what_stands_in_it(tmp_path: Path) -> None:
    """Things that a moved part carries along do not block it."""
    slide = BodyJoint("slide", "prismatic", "floor", at(0.0, 0.0, 0.3), np.array([0.0, -1.0, 0.0]), 0.0, 0.4, 1.0)
    tray = block("tray", (0.5, 0.4, 0.02), 2.0, slide)
    cup = block("cup", (0.08, 0.08, 0.1), 0.3, on("tray", "cup", at(0.0, 0.0, 0.06)))
    report = checked(BodyTree("drawer", (floor(), tray, cup)), tmp_path)
    for result in report.engines:
        assert result.joints[0].reached == 1.0 and not result.joints[0].problems, result.engine


def test_engines_judge_a_turned_scene_alike(tmp_path: Path) -> None:
    """Poses with rotations, off-centre masses and nested joints mean the same in both engines."""
    turned = transform(exp_so3(np.array([0.0, 0.0, 0.7])), (0.3, -0.2, 0.1))
    box = block("box", (0.3, 0.2, 0.2), 2.0, on("floor", "box", turned), centre=(0.02, 0.01, 0.0))
    lid = BodyJoint("lid", "revolute", "box", at(0.0, 0.1, 0.115), np.array([1.0, 0.0, 0.0]), -1.0, 0.0, 0.5)
    top = block("lid", (0.3, 0.2, 0.02), 0.2, lid, centre=(0, -0.1, 0))
    report = checked(BodyTree("chest", (floor(), box, top)), tmp_path)
    first, second = report.engines
    assert first.joints[0].follows < 1e-5 and second.joints[0].follows < 1e-5
    assert report.agreement == 1.0


def test_a_scene_without_floor_is_told(tmp_path: Path) -> None:
    cup = block("cup", (0.1, 0.1, 0.1), 0.3, on("world", "cup", at(0.0, 0.0, 1.0)))
    report = checked(BodyTree("void", (Body("world"), cup)), tmp_path)
    assert report.verdict == "not plausible" and "no-floor" in kinds(report)


@pytest.mark.parametrize("name", ["table/table", "tray/tray", "objects/mug", "lego/lego", "domino/domino"])
def test_models_of_pybullet_data_are_plausible(name: str, tmp_path: Path) -> None:
    pybullet_data = pytest.importorskip("pybullet_data")
    report = checked_file(Path(pybullet_data.getDataPath()) / f"{name}.urdf", tmp_path)
    assert report.verdict == "plausible", [str(f) for f in report.findings]
    static = name in ("table/table", "tray/tray")
    assert ("static" in kinds(report, severity="note")) == static
    assert ("ground" in kinds(report, severity="note")) == (not static)


def test_a_dying_engine_is_a_finding(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The process is killed by a signal as a crash would; the other engine's answer stays."""
    start = subprocess.Popen

    def doomed(command: list[str], **options: object) -> subprocess.Popen[bytes]:
        if not started:
            crash = f"import os; print('assertion', flush=True); os.kill(os.getpid(), {int(signal.SIGSEGV)})"
            command = [sys.executable, "-c", crash]
        started.append(1)
        return start(command, **options)  # pyright: ignore[reportCallIssue, reportArgumentType]

    started: list[int] = []
    urdf = write_scene(kitchen(), tmp_path).urdf
    monkeypatch.setattr(module.subprocess, "Popen", doomed)
    report = check_urdf(urdf, config=QUICK)
    assert report.verdict == "unreadable" and report.exit_code == 2
    (crash,) = [finding for finding in report.findings if finding.kind == "crash"]
    assert f"signal {int(signal.SIGSEGV)}" in crash.message and "assertion" in crash.message
    other = report.engine("mujoco")
    assert other is not None and other.plausible


def test_an_engine_that_takes_too_long_is_ended(tmp_path: Path) -> None:
    urdf = write_scene(kitchen(), tmp_path).urdf
    report = check_urdf(urdf, config=CheckConfig(duration=1000.0), engines=("pybullet",), time_limit=1.0)
    assert report.verdict == "unreadable"
    assert kinds(report, severity="unreadable") == {"time-limit"}


def test_wrong_arguments_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match="mujoco, pybullet"):
        check_urdf(tmp_path / "a.urdf", engines=("havok",))
    with pytest.raises(InvalidValueError, match="time_limit"):
        check_urdf(tmp_path / "a.urdf", time_limit=0.0)
    with pytest.raises(InvalidValueError, match="duration"):
        CheckConfig(duration=0.0)


def test_the_command_ends_with_the_verdict(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    urdf = write_scene(kitchen(cup_above=0.3), tmp_path / "scene").urdf
    assert main(["check", str(urdf), "--duration", "1", "--out", str(tmp_path / "out")]) == 1
    said = capsys.readouterr().out
    assert "floats" in said and "not plausible" in said
    assert main(["check", str(tmp_path / "nothing.urdf"), "--out", str(tmp_path / "other")]) == 2
    assert "no such file" in capsys.readouterr().err
    assert not (tmp_path / "other").exists()
