import math

from simtrack.benchmarks.harness import Options
from simtrack.benchmarks.realtime import Play, run


def test_a_short_feed_is_played_to_its_end() -> None:
    result = run(Options(quick=True))
    figures = {row.name: row.value for row in result.rows}
    images, processed = figures["images"], figures["processed"]
    assert images is not None and processed is not None
    assert 50 <= images <= 65  # 30 Hz for 4 s less the warm-up
    assert 0 < processed <= images
    assert figures["latency, p95"] is not None and figures["latency, p95"] > 0.0


def test_shares_of_nothing_are_defined() -> None:
    assert Play().drop_share == 0.0
    assert math.isnan(Play().latency(0.5))
