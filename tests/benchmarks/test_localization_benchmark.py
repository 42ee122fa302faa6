"""The localization benchmark measures what it says: laws of what it compares, and a quick run."""

import sys

import numpy as np
import pytest

from simtrack.benchmarks import localization
from simtrack.benchmarks.harness import Options
from simtrack.benchmarks.localization import Site
from simtrack.contracts import Float64
from simtrack.geometry.transforms import perturb


@pytest.fixture(scope="module")
def site() -> Site:
    return Site.build(small=True)


def test_the_scan_is_that_of_the_map(site: Site) -> None:
    shots = site.measured()
    assert len(shots) > 0.95 * 1824 * 16
    view = site.surface.cast(site.T_map_base, shots)
    assert np.abs(view.ranges - view.hits.distances).max() < 1e-4


def test_projected_points_lead_to_the_truth_and_leave_it_alone(site: Site) -> None:
    shots = site.measured()
    kept = localization.umeyama(shots, site.surface, site.T_map_base, iterations=5)
    assert site.errors(kept)[0] < 1e-2
    T = perturb(site.T_map_base, np.array([0.04, 0.03, 0.0, 0.0, 0.0, 0.02]))
    errors = [site.errors(T)[0]]
    for _ in range(3):
        T = localization.umeyama(shots, site.surface, T, iterations=5)
        errors.append(site.errors(T)[0])
        assert errors[-1] < 0.8 * errors[-2]
        assert T[:3, :3] @ T[:3, :3].T == pytest.approx(np.eye(3), abs=1e-9)


def test_the_drive_starts_where_the_robot_stands_and_keeps_its_speed(site: Site) -> None:
    def at(seconds: float) -> Float64:
        return localization._on_circle(site.T_map_base, seconds)

    assert at(0.0) == pytest.approx(site.T_map_base)
    for seconds in (0.3, 2.0):
        velocity = (at(seconds + 1e-5) - at(seconds - 1e-5))[:3, 3] / 2e-5
        assert velocity == pytest.approx(0.3 * at(seconds)[:3, 0], abs=1e-6)
    both = localization._on_circle(site.T_map_base, np.array([0.3, 2.0]))
    assert both == pytest.approx(np.stack([at(0.3), at(2.0)]))


def test_a_quick_run_reports_every_figure(monkeypatch: pytest.MonkeyPatch, tmp_path) -> None:
    monkeypatch.setitem(sys.modules, "open3d", None)  # a peer that is missing is said
    result = localization.run(Options(quick=True))
    rows = {row.name: row for row in result.rows}
    assert any("Open3D is not installed" in note for note in result.notes)
    assert not any("Open3D" in name for name in rows)
    second = rows["error after 2 casts: gauss-newton"]
    assert second.met
    assert (rows["error after 2 casts: umeyama"].value or 0.0) > 10 * (second.value or 0.0) > 0.0
    assert all(row.timing is not None or row.value is not None for row in result.rows)
    assert 0.0 < (rows["update: RMS position error"].value or 0.0) < 10.0
    for name, draw in result.plots.items():
        draw(tmp_path / name)
        assert (tmp_path / name).stat().st_size > 1000
