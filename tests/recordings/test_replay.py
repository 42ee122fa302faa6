"""The way round: a run in simulation, its log without labels, the same stack on that log, the same estimates."""

from pathlib import Path

import numpy as np
import pytest

from simtrack.evaluation.closed_loop import closed, open_log
from simtrack.evaluation.process import Clock
from simtrack.evaluation.replay import Replay
from simtrack.evaluation.run_config import RunConfig
from simtrack.evaluation.run_folder import EstimateTables
from simtrack.recordings import open_recording, strip_labels
from simtrack.simulation.scene_file import load_scene

SECONDS = 1.0


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the log of a short run, labels included, and what was believed in it."""
    folder = tmp_path_factory.mktemp("live")
    scene = load_scene("workbench")
    config = RunConfig(scene, folder / "out", SECONDS, seed=3, renderer="embree", log=folder / "log.mcap")
    with closed(config, config.agent_name) as loop, open_log(config, loop) as log, EstimateTables(folder) as tables:
        for _, belief in loop.drive(SECONDS, Clock(), log):
            if belief is not None:
                tables.add(belief)
                truth = loop.simulation.truth.at(belief.stamp)
                poses = {name: thing.T_map_object for name, thing in truth.objects.items()}
                log.write_labels(belief.stamp, {"base": truth.T_map_base, **poses})
    return folder


@pytest.mark.slow
def test_a_replay_without_labels_gives_identical_estimates(live: Path, tmp_path: Path) -> None:
    labels = list(open_recording(live / "log.mcap").labels())
    assert len(labels) > 10 and any(np.abs(poses["base"]).max() > 1.0 for _, poses in labels)
    stripped = tmp_path / "stripped.mcap"
    strip_labels(live / "log.mcap", stripped)
    assert list(open_recording(stripped).labels()) == []
    assert b"ground_truth" not in stripped.read_bytes()

    assert not Replay(stripped, tmp_path / "out").run()
    for table in ("tracks.csv", "estimates.csv"):
        rows = (live / table).read_text().splitlines()
        assert len(rows) > 20
        assert (tmp_path / "out" / table).read_text().splitlines() == rows
