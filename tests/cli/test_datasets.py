"""The commands about data sets, from end to end: made, killed, resumed, validated, shown; and what they refuse."""

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from simtrack.cli.main import main
from tests.cli.commands import ROOT, refused, simtrack_command
from tests.datasets.tiny import tree

RECIPE = """
name: few
description: A few things on a table, small images.
counts: {frames: 12, views_per_scene: 3}
worlds: [{kind: room}]
targets: {models: [relay, materialbox], count: [2, 3]}
lights: {count: [1, 1]}
textures: {size: 64}
views: {kind: shell, distance: [0.5, 0.8]}
camera: {width: 128, height: 96, focal: 110.0, depth: ideal}
writers: [bop, coco, yolo, labels]
"""


@pytest.fixture(scope="module")
def recipe(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recipe") / "few.yaml"
    path.write_text(RECIPE)
    return path


@pytest.fixture(scope="module")
def made(recipe: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The data set, by one worker."""
    out = tmp_path_factory.mktemp("made") / "few"
    result = simtrack_command("generate", recipe, "--out", out, "--seed", 5, "--workers", 1)
    assert result.returncode == 0, result.stderr
    assert "12 images in 4 scenes" in result.stdout
    return out


@pytest.mark.gl
@pytest.mark.slow
def test_a_killed_generation_is_carried_on(recipe: Path, made: Path, tmp_path: Path) -> None:
    out = tmp_path / "few"
    command = [sys.executable, "-m", "simtrack", "generate", str(recipe), "--out", str(out), "--seed", "5"]
    command += ["--workers", "2"]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    for scenes in (1, 3):  # killed once so many are complete
        process = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        while process.poll() is None and len(list((out / "scenes").glob("*.json"))) < scenes:
            time.sleep(0.01)
        process.send_signal(signal.SIGKILL)
        process.wait()
    result = simtrack_command("generate", recipe, "--out", out, "--seed", 5, "--workers", 2)
    assert result.returncode == 0, result.stderr
    assert tree(out) == tree(made)


@pytest.mark.gl
@pytest.mark.slow
def test_ctrl_c_leaves_complete_scenes(recipe: Path, made: Path, tmp_path: Path) -> None:
    out = tmp_path / "few"
    command = [sys.executable, "-m", "simtrack", "generate", str(recipe), "--out", str(out), "--seed", "5"]
    process = subprocess.Popen(
        [*command, "--workers", "1", "--count", "90"], env=os.environ | {"PYTHONPATH": str(ROOT)}, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True,
        # Shells have what they run in the background ignore Ctrl-C, and so would all that is started from there.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )  # fmt: skip
    while process.poll() is None and not list((out / "scenes").glob("*.json")):
        time.sleep(0.01)
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does
    _, message = process.communicate(timeout=60)
    assert process.returncode == 130, message
    assert "Traceback" not in message
    assert "the same command carries on" in message
    left, whole = tree(out), tree(made)
    done = {Path(name).stem for name in left if name.startswith("scenes/")}
    assert 0 < len(done) < 30
    for name in left:
        numbers = [Path(part).stem for part in Path(name).parts if re.fullmatch(r"\d{6}", Path(part).stem)]
        assert not numbers or numbers[0] in done, f"{name}: nothing of unfinished scenes is left"
        if name.startswith("scenes/") and name in whole:
            assert left[name] == whole[name]


@pytest.mark.gl
@pytest.mark.slow
def test_what_was_made_is_valid_and_can_be_seen(made: Path, tmp_path: Path) -> None:
    result = simtrack_command("validate", made, "--sample", 12)
    assert result.returncode == 0, result.stdout
    assert "everything is right" in result.stdout
    assert "colour edges off the masks: 0, 0 pixels" in result.stdout
    page = tmp_path / "page.html"
    assert simtrack_command("inspect", made, "--out", page, "--images", 3).returncode == 0
    assert page.read_text().count("<figcaption>") == 3


@pytest.mark.gl
@pytest.mark.slow
def test_validation_tells_what_is_wrong_by_its_exit_code(made: Path, tmp_path: Path) -> None:
    folder = tmp_path / "few"
    (folder / "yolo").mkdir(parents=True)
    for path in (made / "yolo").rglob("*"):
        target = folder / path.relative_to(made)
        if path.is_dir():
            target.mkdir(exist_ok=True)
        else:
            target.write_bytes(path.read_bytes())
    label = next((folder / "yolo" / "pose" / "labels").rglob("*.txt"))
    label.write_text("0 2.5 0.5 0.1 0.1\n")
    result = simtrack_command("validate", folder / "yolo")
    assert result.returncode == 1
    assert label.name in result.stdout
    assert "things are wrong" in result.stdout


@pytest.mark.gl
@pytest.mark.slow
def test_another_seed_or_recipe_is_refused(recipe: Path, made: Path, tmp_path: Path) -> None:
    before = tree(made)
    assert "seed is 5 there and 6 here" in refused("generate", recipe, "--out", made, "--seed", 6)
    other = tmp_path / "few.yaml"
    other.write_text(RECIPE.replace("count: [2, 3]", "count: [2, 4]"))
    message = refused("generate", other, "--out", made, "--seed", 5)
    assert "recipe field targets.count is [2, 3] there and [2, 4] here" in message
    assert "holds 4 scenes already" in refused("generate", recipe, "--out", made, "--seed", 5, "--count", 3)
    assert tree(made) == before


def test_what_makes_no_sense_is_refused(recipe: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def refusal(*arguments: object) -> str:
        assert main([str(argument) for argument in arguments]) == 2
        return " ".join(capsys.readouterr().err.split())

    out = tmp_path / "x"
    assert "workbench_keypoints" in refusal("generate", "nonsense", "--out", out)
    assert "count" in refusal("generate", recipe, "--out", out, "--count", 0)
    assert "seed" in refusal("generate", recipe, "--out", out, "--seed", -1)
    assert "workers" in refusal("generate", recipe, "--out", out, "--workers", 0)
    assert "--engine ray" in refusal("generate", recipe, "--out", out, "--address", "auto")
    assert "no folder" in refusal("validate", tmp_path / "nothing")
    assert "neither BOP" in refusal("inspect", tmp_path)
    assert "images" in refusal("inspect", tmp_path, "--images", 0)
    wrong = tmp_path / "wrong.yaml"
    wrong.write_text(RECIPE.replace("lights:", "lamps:"))
    assert "lamps" in refusal("generate", wrong, "--out", out)
    assert not out.exists()


def test_recipes_are_listed() -> None:
    result = simtrack_command("generate")
    assert result.returncode == 0
    for name in ("workbench_keypoints", "bop_pbr_like", "clutter_user_meshes", "closed_loop_log"):
        assert name in result.stdout
