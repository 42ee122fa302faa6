"""The command: fast help, clear refusals, exit codes."""

import resource
from pathlib import Path

import pytest

import simtrack
from simtrack.cli.main import VERBS
from simtrack.cli.usage import unbroken
from tests.cli.commands import refusal, refused, simtrack_command, simtrack_process


def test_help_is_quick_and_names_the_verbs() -> None:
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    result = simtrack_process("--help")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert result.returncode == 0
    for verb in ("run", "replay", "scenes", "objects", "query", "trials"):
        assert verb in result.stdout
    spent = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    assert spent < 2.0, "help must not import the simulator"


def test_version() -> None:
    assert simtrack_process("--version").stdout.strip() == f"simtrack {simtrack.__version__}"


def test_every_verb_has_help() -> None:
    result = simtrack_command("run", "--help")
    assert result.returncode == 0
    for option in ("--duration", "--seed", "--out", "--agent", "--detector", "--renderer", "--overwrite", "--log"):
        assert option in result.stdout


@pytest.mark.parametrize("verb", VERBS)
def test_help_fits_the_terminal(verb: str) -> None:
    told = simtrack_command(verb, "--help", env={"COLUMNS": "72"})
    assert told.returncode == 0
    assert max(map(len, told.stdout.splitlines())) <= 72
    assert "{None" not in told.stdout


def test_sentences_of_help_have_no_breaks_and_paragraphs_stay() -> None:
    def verb() -> int:
        """Do it.

        A longer story
        (in two lines).

        Args:
            one: The first,
                and the
                (only) thing.
            two: Another.
        """
        return 0

    assert unbroken(unbroken(verb)).__doc__ == (
        "Do it.\n\nA longer story (in two lines).\n\n"
        "Args:\n    one: The first, and the (only) thing.\n    two: Another."
    )


def test_positional_arguments_have_names_and_none_may_be_given() -> None:
    assert "simtrack score [-h] RUN_DIR RESULTS [--out PATH]" in simtrack_command("score", "--help").stdout
    assert "simtrack query [-h] RUN_DIR QUESTION" in simtrack_command("query", "--help").stdout
    assert "duration = 0.0 is not valid" in refused("run", "--duration", "0", "--agent", "None")
    assert "unknown scene" in refused("sweep", "nowhere", "--over", "noise=0:1", "--duration", "None")


def test_scenes_are_listed() -> None:
    result = simtrack_command("scenes")
    assert result.returncode == 0
    assert "workbench" in result.stdout
    assert "lab_floor" in result.stdout


def test_unknown_names_list_the_known(tmp_path: Path) -> None:
    nowhere = simtrack_process("run", "nowhere", "--out", tmp_path / "x")
    assert "Known: hidden_chair, kitchen, lab_floor, open_kitchen, rooms, split_table" in refusal(nowhere)
    assert "explorer" in refused("run", "--agent", "nobody", "--out", tmp_path / "x")
    assert "oracle" in refused("run", "--detector", "psychic", "--out", tmp_path / "x")
    assert "multimeter" in refused("objects", "unobtainium")
    assert not (tmp_path / "x").exists()


def test_values_outside_their_domain_are_named(tmp_path: Path) -> None:
    assert "duration" in refused("run", "--duration", "-1", "--out", tmp_path / "x")
    assert "duration" in refused("run", "--duration", "nan", "--out", tmp_path / "x")
    assert "seed" in refused("run", "--seed", "-1", "--out", tmp_path / "x")
    assert "threads" in refused("run", "--threads", "0", "--out", tmp_path / "x")
    assert "renderer" in refused("run", "--renderer", "unreal", "--out", tmp_path / "x")


def test_existing_folder_is_refused_and_untouched(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("keep")
    assert "--overwrite" in refused("run", "--out", tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["mine.txt"]


@pytest.mark.parametrize(
    ("text", "expected"),
    [("name: [", "not valid YAML"), ("name: broken\nrobot: {}\n", "static"), ("- 1\n", "mapping")],
)
def test_broken_scenes_name_file_and_field(tmp_path: Path, text: str, expected: str) -> None:
    folder = tmp_path / "broken"
    folder.mkdir()
    (folder / "scene.yaml").write_text(text)
    message = refused("run", folder / "scene.yaml", "--out", tmp_path / "x")
    assert "scene.yaml" in message
    assert expected in message
    listing = simtrack_command("scenes", env={"SIMTRACK_SCENES": str(tmp_path)})
    assert listing.returncode == 2
    assert "workbench" in listing.stdout
    assert "scene.yaml" in listing.stderr


def test_queries_of_nothing_are_refused(tmp_path: Path) -> None:
    assert "graph.json" in refused("query", tmp_path, "on workbench")
    (tmp_path / "graph.json").write_text("{}")
    assert "graph.json" in refused("query", tmp_path, "on workbench")


def test_recordings_that_are_none_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "noise.mcap"
    assert "noise.mcap" in refused("replay", file, "--out", tmp_path / "x")
    file.write_bytes(bytes(range(256)) * 20)
    assert "noise.mcap" in refused("replay", file, "--out", tmp_path / "x")


def test_exported_objects_load_again(tmp_path: Path) -> None:
    result = simtrack_command("objects", "relay", "screwdriver", "--export", tmp_path)
    assert result.returncode == 0, result.stderr
    assert "relay" in refused("objects", "relay", "--export", tmp_path), "an older export is not replaced"
    text = (tmp_path / "relay" / "object.yaml").read_text()
    (tmp_path / "relay" / "object.yaml").write_text(text.replace("name: relay", "name: my_relay"))
    text = (tmp_path / "screwdriver" / "object.yaml").read_text()
    (tmp_path / "screwdriver" / "object.yaml").write_text(text.replace("name: screwdriver", "name: my_driver"))
    listing = simtrack_command("objects", "relay", "my_relay", env={"SIMTRACK_OBJECTS": str(tmp_path)})
    assert listing.returncode == 0, listing.stderr
    rows = [line.split() for line in listing.stdout.splitlines()[1:]]
    assert [row[0] for row in rows] == ["relay", "my_relay"]
    assert rows[0][1:] == rows[1][1:], "size, mass, triangles and symmetry survive the export"
