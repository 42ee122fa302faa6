"""The rerun log: a file appears, and a missing extra is named."""

import sys

import numpy as np
import pytest

from simtrack.contracts import Belief, Localization, RgbdFrame, Status
from simtrack.errors import InvalidValueError, SimtrackError
from simtrack.evaluation.record import RunRecord
from simtrack.geometry.kinematics import KinematicTree
from simtrack.objects import load_object
from simtrack.report.rerun_log import RerunLog


def test_missing_extra_is_named(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(SimtrackError, match=r"simtrack\[viz\]"):
        RerunLog(view=True)


def test_run_is_saved(record: RunRecord, tmp_path) -> None:
    pytest.importorskip("rerun")
    path = tmp_path / "run.rrd"
    log = RerunLog(path=path)
    log.start(record.static_map, {name: load_object(name) for name in record.meshes}, KinematicTree(()))
    for key in record.key_frames[:2]:
        depth = np.ones((key.intrinsics.height, key.intrinsics.width), dtype=np.float32)
        localization = Localization(key.stamp, np.eye(4), np.eye(6), Status.OK)
        belief = Belief(key.stamp, localization, key.T_map_camera, key.tracks, None, None, frozenset())
        log.frame(RgbdFrame(key.stamp, depth, None, key.intrinsics, np.eye(4)), belief)
    log.close()
    assert path.stat().st_size > 10_000


def test_folder_of_the_file_has_to_exist(tmp_path) -> None:
    pytest.importorskip("rerun")
    with pytest.raises(InvalidValueError, match="rrd"):
        RerunLog(path=tmp_path / "nowhere" / "run.rrd")
