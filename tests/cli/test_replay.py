"""``simtrack replay`` on what others recorded: finds the format, prints a short table, refuses by name."""

import json
from pathlib import Path

import pytest

from tests.cli.commands import refused, simtrack_command
from tests.recordings.samples import World, camera_path, write_tum


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    world = World()
    return write_tum(tmp_path_factory.mktemp("cli") / "desk", [world.depth(T) for T in camera_path(3)], camera_path(3))


def test_a_folder_is_replayed(folder: Path, tmp_path: Path) -> None:
    result = simtrack_command("replay", folder.parent, "--out", tmp_path / "out")
    assert result.returncode == 0, result.stderr
    rows = dict(
        line.split(maxsplit=1) for line in result.stdout.splitlines() if line.startswith(("local", "map", "run"))
    )
    assert rows["localization.located"] == "1.000" and rows["run.frames"] == "3"
    assert rows["localization.residual.median"].endswith("mm")
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names == {"config.yaml", "estimates.csv", "frames.csv", "metrics.json", "map.ply"}
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert metrics["localization.located"] == {"value": 1.0, "unit": "1"}
    for name in ("frames.csv", "map.ply"):
        assert str(tmp_path / "out" / name) in result.stdout
    again = refused("replay", folder, "--out", tmp_path / "out")
    assert "--overwrite" in again


def test_help_names_what_can_be_replayed() -> None:
    result = simtrack_command("replay", "--help")
    assert result.returncode == 0
    text = " ".join(result.stdout.split())
    for word in ("MCAP", "VLP-16", "KITTI", "TUM", "7-Scenes", "BOP", "--intrinsics", "--depth-unit"):
        assert word in text


def test_sources_that_are_none_are_refused(folder: Path, tmp_path: Path) -> None:
    out = "--out", tmp_path / "x"
    assert "no such file or folder" in refused("replay", tmp_path / "nothing", *out)
    assert "depth.txt" in refused("replay", tmp_path, *out)
    (tmp_path / "a.pcap").write_bytes(b"\xd4\xc3\xb2\xa1" + bytes(30))
    assert "a.pcap" in refused("replay", tmp_path / "a.pcap", *out)
    assert "intrinsics" in refused("replay", folder, "--intrinsics", "0", "1", "2", "3", *out)
    assert "MCAP" in refused("replay", folder, "--rrd", tmp_path / "a.rrd", *out)
    assert not (tmp_path / "x").exists()
