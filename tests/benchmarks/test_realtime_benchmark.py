import math
import queue
import threading
from collections.abc import Iterator
from typing import cast

import pytest

from simtrack.benchmarks.harness import Options
from simtrack.benchmarks.realtime import Feed, Play, _play, _read, run
from simtrack.contracts import SensorFrame
from simtrack.errors import FileFormatError
from simtrack.perception.pipeline import PerceptionStack
from simtrack.recordings import Recording


class Broken:
    """A log that cannot be read."""

    def sensor_frames(self) -> Iterator[SensorFrame]:
        raise FileFormatError("broken.mcap", "chunk 3", "is damaged")


def test_a_short_feed_is_played_to_its_end() -> None:
    result = run(Options(quick=True))
    figures = {row.name: row.value for row in result.rows}
    images, processed = figures["images"], figures["processed"]
    assert images is not None and processed is not None
    assert 50 <= images <= 65  # 30 Hz for 4 s less the warm-up
    assert 0 < processed <= images
    assert figures["latency, p95"] is not None and figures["latency, p95"] > 0.0


def test_a_feed_that_breaks_off_is_an_error_and_not_waited_for() -> None:
    feed: Feed = queue.Queue(4)
    _read(cast(Recording, Broken()), feed, threading.Event())
    with pytest.raises(FileFormatError, match="is damaged"):
        _play(cast(PerceptionStack, None), feed)


def test_shares_of_nothing_are_defined() -> None:
    assert Play().drop_share == 0.0
    assert math.isnan(Play().latency(0.5))
