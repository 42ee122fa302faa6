"""simtrack map: a recording becomes a surface; refusals are clear and leave no folder."""

import json
import warnings
from pathlib import Path

import pytest

from simtrack.cli.main import main
from simtrack.geometry.meshes import load_mesh


def test_a_recording_with_poses_is_mapped(real_data: Path, tmp_path: Path) -> None:
    source, out = real_data / "open3d_rgbd", tmp_path / "map"
    if not source.is_dir():
        pytest.skip(f"no RGB-D images in {source}")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the folder does not say its intrinsics
        assert main(["map", str(source), "--out", str(out), "--frames", "2", "--voxel", "0.03"]) == 0
    surface = load_mesh(out / "surface.ply")
    assert len(surface.faces) > 2000 and surface.face_colors is not None
    assert json.loads((out / "metrics.json").read_text())["map.frames"]["value"] == 2
    assert json.loads((out / "entities.json").read_text()) == []
    assert "From behind the camera" in (out / "report.html").read_text()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["workbench"], "furnished room"),
        (["rooms:1", "--strength", "9"], "0 to 3"),
        (["rooms:1", "--frames", "0"], "FilmConfig.frames"),
        (["rooms:1", "--sensor", "polaroid"], "kinect_v2"),
        (["rooms:1", "--voxel", "9"], "VolumeConfig.voxel"),
        (["nowhere"], "unknown scene"),
        (["rooms:1", "--segmenter", "http://127.0.0.1:9"], "simtrack serve segmenter"),
        (["rooms:1", "--segmenter", "mine"], "package.module:Class"),
        (["rooms:1", "--swap", "1"], "reach of the readings"),
        (["rooms:1", "--onto", "nowhere"], "no map that can be read"),
    ],
)
def test_what_cannot_be_mapped_is_refused(
    arguments: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["map", *arguments, "--out", str(tmp_path / "out")]) == 2
    assert message in " ".join(capsys.readouterr().err.split()) and not list(tmp_path.iterdir())


def test_an_evaluation_of_nonsense_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["evaluate", "panoptic", "--strength", "-1", "--out", str(tmp_path / "out")]) == 2
    assert "strength" in capsys.readouterr().err


def test_a_service_that_cannot_listen_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["serve", "segmenter", "--segmenter", "nowhere:Class", "--port", "99999"]) == 2
    assert "65535" in capsys.readouterr().err
    assert main(["serve", "segmenter", "--segmenter", "nowhere:Class"]) == 2
    assert "nowhere" in capsys.readouterr().err


def test_a_run_on_a_survey_that_is_none_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "workbench", "--map", str(tmp_path / "none"), "--out", str(tmp_path / "out")]) == 2
    assert "simtrack survey" in " ".join(capsys.readouterr().err.split())
    assert main(["survey", "nowhere", "--out", str(tmp_path / "out")]) == 2
    assert not list(tmp_path.iterdir())
