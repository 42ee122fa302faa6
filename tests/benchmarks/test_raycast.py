"""The ray casting benchmark in its quick form: it runs, and the engines agree."""

from simtrack.benchmarks.harness import Options
from simtrack.benchmarks.raycast import run


def test_quick_run_compares_equal_work() -> None:
    said: list[str] = []
    result = run(Options(quick=True, say=said.append))
    rows = {row.name: row for row in result.rows}
    assert len(rows) == len(result.rows)
    assert said
    for scan, rays in (("pinhole 640x480", 307_200), ("VLP-16 1824x16", 29_184)):
        ratio = rows[f"{scan}: embreex run / simtrack"]
        assert ratio.value is not None and ratio.value > 0 and ratio.sense == "at least" and ratio.asked is not None
        differing = rows[f"{scan}: rays on which simtrack and embreex differ"].value
        assert differing is not None and differing < 1e-3 * rays
    timings = [row.timing for row in result.rows if row.timing is not None]
    assert timings and all(timing.cpu > 0 for timing in timings)
