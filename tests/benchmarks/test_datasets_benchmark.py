from simtrack.benchmarks.datasets import run
from simtrack.benchmarks.harness import Options


def test_the_parts_of_an_image_add_up() -> None:
    figures = {row.name: row.value or 0.0 for row in run(Options(quick=True)).rows}
    whole = figures["an image, everything"]
    parts = ("... rendering of colours", "... BOP, COCO and YOLO, that encoding included")
    rest = figures["... settling, rays, labels, noise, effects"]
    assert min(*(figures[name] for name in parts), rest) > 0.0
    assert abs(sum(figures[name] for name in parts) + rest - whole) < 1e-6 * whole
    assert 0.0 < figures["share of rendering and encoding"] < 100.0
