import numpy as np

from simtrack.benchmarks.harness import Options
from simtrack.benchmarks.tracking import PaperFrame, run


def test_the_paper_s_frame_converges_and_gauss_newton_goes_further_than_umeyama() -> None:
    rng = np.random.default_rng(3)
    frame = PaperFrame(rng)
    start = frame.start(rng)
    assert np.all(frame.errors(start) > 0.015)
    newton, umeyama = frame.errors(frame.track(start)), frame.errors(frame.track(start, "umeyama"))
    assert np.median(newton) < 0.001
    assert np.median(newton) < np.median(umeyama) < np.median(frame.errors(start))
    assert frame.rays == 336_384
    frame.scene.close()


def test_the_benchmark_runs() -> None:
    result = run(Options(quick=True))
    names = [row.name for row in result.rows]
    assert any("adaptive tracker" in name for name in names)
    assert all(row.figure is None or np.isfinite(row.figure) for row in result.rows)
    assert len(result.series["error.umeyama"]) == len(result.series["error.gauss-newton"]) == 5
