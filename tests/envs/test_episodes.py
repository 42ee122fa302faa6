import json
from pathlib import Path

import pytest

from simtrack.cli.main import main
from simtrack.envs.episodes import EpisodeFile
from simtrack.envs.play import EpisodeResult
from simtrack.errors import FileFormatError


def result(seed: int) -> EpisodeResult:
    return EpisodeResult(seed, 1.5, 10, True, {"known": 0.5})


def test_what_was_played_is_taken_up_again(tmp_path: Path) -> None:
    path = tmp_path / "new" / "episodes.json"
    first = EpisodeFile(path, {"policy": "still", "errors": {}})
    for seed in (3, 1):
        first.add(result(seed))
    again = EpisodeFile(path, {"policy": "still", "errors": {}})
    assert again.results == {1: result(1), 3: result(3)}
    with pytest.raises(FileFormatError, match="random"):
        EpisodeFile(path, {"policy": "random", "errors": {}})


@pytest.mark.parametrize("text", ["", "[]", '{"arguments": {}, "episodes": [{"seed": 1}]}'])
def test_other_files_are_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "other.json"
    path.write_text(text)
    with pytest.raises(FileFormatError, match="episodes"):
        EpisodeFile(path, {})


def test_the_command_plays_no_episode_twice(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "figures.json"
    command = ["env", "ActivePerception", "--policy", "still", "--observation", "state", "--seconds", "0.2"]
    assert main([*command, "--json", str(out)]) == 0
    assert main([*command, "--episodes", "2", "--json", str(out)]) == 0
    assert capsys.readouterr().out.count("seed 0: return") == 1
    assert [entry["seed"] for entry in json.loads(out.read_text())["episodes"]] == [0, 1]
