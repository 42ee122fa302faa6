import ast
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import simtrack.envs.policies
from simtrack.cli.env import full_id
from simtrack.cli.main import main
from simtrack.envs.environment import SimtrackEnv
from simtrack.envs.play import play
from simtrack.envs.policies import POLICIES, make_policy
from simtrack.errors import InvalidValueError, UnknownNameError

Make = Callable[..., SimtrackEnv]
FORBIDDEN = ("ground_truth", "oracles", "simulation.simulation", "simulation.world", "evaluation", "envs.loop")


def test_policies_cannot_see_the_truth() -> None:
    for path in Path(simtrack.envs.policies.__file__).parent.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [f"{node.module}"] if isinstance(node, ast.ImportFrom) else []
            assert not any(hidden in name for name in names for hidden in FORBIDDEN), (path, names)


@pytest.mark.parametrize("policy", POLICIES)
def test_a_policy_repeats_itself_for_a_seed(make: Make, policy: str) -> None:
    env = make(seconds=0.5)
    once, again = (list(play(env, policy, [4], "state")) for _ in range(2))
    assert once == again and once[0].steps == 5 and np.isfinite(once[0].total)


def test_looking_around_finds_what_a_fixed_gaze_does_not(make: Make) -> None:
    env = make(objects=("relay", "powerdrill"), seconds=10.0)
    still, scripted = (next(play(env, policy, [1], "state")) for policy in ("still", "scripted"))
    assert scripted.metrics["known"] == 1.0 > still.metrics["known"]


def test_a_policy_that_needs_what_is_not_observed_says_so(make: Make) -> None:
    env = make()
    env.reset(seed=0)
    with pytest.raises(InvalidValueError, match="belief"):
        make_policy("scripted", "active-perception", env.briefing(), 5)
    with pytest.raises(UnknownNameError, match="random"):
        make_policy("clever", "active-perception", env.briefing(), 5)


def test_the_command_plays_and_writes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "figures.json"
    arguments = ["env", "ActivePerception", "--policy", "still", "--observation", "state", "--seconds", "0.3"]
    assert main([*arguments, "--episodes", "2", "--json", str(out)]) == 0
    assert "seed 1: return" in capsys.readouterr().out and '"seed": 1' in out.read_text()
    assert main(["env", "Juggle"]) == 2 and "Localize-v0" in capsys.readouterr().err
    assert full_id("Localize") == full_id("simtrack/Localize-v0")
