from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import pytest

from simtrack.contracts import MapEntity, Room, StaticMap
from simtrack.recordings import McapWriter
from tests.recordings.feeds import Entry


@pytest.fixture
def static_map() -> StaticMap:
    entity = MapEntity(
        "workbench", "table", np.eye(4), np.array([1.6, 0.8, 0.9]), "lab", ((np.eye(4), np.array([1.6, 0.8])),)
    )
    room = Room("lab", np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 3.0]]))
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], dtype=np.float32)
    return StaticMap(vertices, np.array([[0, 1, 2]], dtype=np.int32), (entity,), (room,), noise=0.004)


@pytest.fixture
def record(tmp_path: Path) -> Callable[..., Path]:
    """Write entries to a log and return its path."""

    def write(entries: Iterable[Entry], name: str = "log.mcap", **resources: object) -> Path:
        path = tmp_path / name
        with McapWriter(path, **resources) as log:  # type: ignore[arg-type]
            for entry in entries:
                log.write(entry)
        return path

    return write
