"""The benchmark of scale runs, says what it was asked, and draws its curves."""

import json
from pathlib import Path

import pytest

from simtrack.benchmarks.harness import Options
from simtrack.benchmarks.scaling import run
from simtrack.raycast import embree as rtc


@pytest.mark.skipif(rtc.fallback_forced() or not rtc.available(), reason="the fallback takes minutes for it")
def test_a_quick_run_has_all_rows_and_draws_its_plot(tmp_path: Path) -> None:
    options = Options(quick=True)
    result = run(options)
    rows = {row.name: row for row in result.rows}
    for name in ("peak memory", "frame, 1,000 : 200", "paging in any frame", "1,000 objects: rays that differ"):
        assert any(name in row for row in rows), name
    differing = next(row for name, row in rows.items() if "rays that differ" in name)
    assert differing.value == 0
    assert differing.met is True
    assert len(result.series["paged.objects"]) == len(result.series["paged.casts_ms"])
    assert len(result.series["live.objects"]) == len(result.series["live.casts_ms"])
    json.dumps(result.to_json(options))
    for name, draw in result.plots.items():
        draw(tmp_path / name)
        assert (tmp_path / name).stat().st_size > 1000
