"""``simtrack bench datasets``: what an image of ``workbench_keypoints`` costs one worker, and what of it is where.

Rendering colours and encoding images is what any generator has to do; the rest is settling, labels, sensor noise,
effects, and the formats' own files.
"""

import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

from simtrack.benchmarks.harness import Benchmark, Options
from simtrack.contracts import Float64, Uint8
from simtrack.datasets.content import ColorRenderer, Content
from simtrack.datasets.frame import LabelledFrame
from simtrack.datasets.generator import Generator
from simtrack.datasets.recipe import load_recipe
from simtrack.datasets.settled import color_renderer
from simtrack.datasets.writer import SceneWriter
from simtrack.datasets.writers import make_writer
from simtrack.datasets.writers.images import ColourJpeg, DepthPng

RECIPE = "workbench_keypoints"
CPU_ASKED = 0.25
"""Seconds of CPU an image."""


class _TimedRenderer:
    """A renderer whose CPU time is added up."""

    def __init__(self, renderer: ColorRenderer) -> None:
        self._renderer, self.seconds = renderer, 0.0

    def begin(self, content: Content) -> None:
        self.seconds += _cpu(partial(self._renderer.begin, content))

    def render(self, T_map_camera: Float64) -> Uint8:
        start = time.process_time()
        image = self._renderer.render(T_map_camera)
        self.seconds += time.process_time() - start
        return image

    def close(self) -> None:
        self._renderer.close()


def run(options: Options) -> Benchmark:
    """Measure; see the module."""
    result = Benchmark("datasets")
    recipe = load_recipe(RECIPE)
    scenes, skipped = (1, 0) if options.quick else (4, 1)
    renderer = _TimedRenderer(color_renderer(recipe))
    writers = [make_writer(name, {}, recipe.path) for name in ("bop", "coco", "yolo")]
    depth = DepthPng(1e4)
    writing = encoding = whole = 0.0
    frames = 0
    with TemporaryDirectory(prefix="simtrack-") as folder, Generator(recipe, options.seed, renderer) as generator:
        for scene in range(skipped + scenes):
            options.say(f"scene {scene + 1} of {skipped + scenes}")
            if scene == skipped:  # kernels are compiled, caches are warm
                renderer.seconds = 0.0
            start, spent, encoded, count = time.process_time(), 0.0, 0.0, 0
            about, staging = generator.scene_info(scene), Path(folder) / str(scene)
            open_ones = [writer.open_scene(staging, generator.info, about) for writer in writers]
            for frame in generator.frames(scene):
                spent += _cpu(partial(_write, open_ones, frame))
                encoded += _cpu(partial(_encode, frame, depth))
                count += 1
                if options.quick and count == 3:
                    break
            spent += _cpu(partial(_close, open_ones))
            if scene >= skipped:
                whole += time.process_time() - start - encoded  # the encoding beside the writers' own is none of theirs
                writing, encoding, frames = writing + spent, encoding + encoded, frames + count
    each = 1e3 / frames
    result.add(
        "an image, everything", value=each * whole, unit="ms CPU", asked=1e3 * CPU_ASKED, note=f"{frames} images"
    )
    result.add("... rendering of colours", value=each * renderer.seconds, unit="ms CPU")
    result.add("... encoding of colours and depth", value=each * encoding, unit="ms CPU", note="JPEG and 16-bit PNG")
    result.add("... BOP, COCO and YOLO, that encoding included", value=each * writing, unit="ms CPU")
    rest = whole - renderer.seconds - writing
    result.add("... settling, rays, labels, noise, effects", value=each * rest, unit="ms CPU")
    share = 100.0 * (renderer.seconds + encoding) / whole
    result.add("share of rendering and encoding", value=share, unit="%")
    result.add("images a second of CPU, two cores", value=2.0 * frames / whole, unit="1/s", asked=8.0, sense="at least")
    return result


def _write(writers: Sequence[SceneWriter], frame: LabelledFrame) -> None:
    for writer in writers:
        writer.write(frame)


def _close(writers: Sequence[SceneWriter]) -> None:
    for writer in writers:
        writer.close()


def _encode(frame: LabelledFrame, depth: DepthPng) -> None:
    ColourJpeg().encode(frame)
    depth.encode(frame)


def _cpu(work: Callable[[], object]) -> float:
    start = time.process_time()
    work()
    return time.process_time() - start
