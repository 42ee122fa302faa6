"""What a scene takes is given back before the next but one: memory does not grow with the number of scenes."""

import ctypes
import gc
import re
import sys
import weakref
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from simtrack.contracts import Float64, Uint8
from simtrack.datasets.content import Content
from simtrack.datasets.generator import Generator
from simtrack.datasets.local import thread_limits
from simtrack.datasets.mujoco_renderer import MujocoColorRenderer
from simtrack.datasets.physics import Body, settle
from simtrack.datasets.primitives import primitive
from simtrack.datasets.recipe import ArrangePlacement, PrimitiveSettings, parse_recipe
from simtrack.simulation.building import furniture
from simtrack.simulation.building.parts import StaticWorld
from simtrack.simulation.placement import support_area

RECIPE: dict[str, Any] = {
    "name": "small",
    "counts": {"frames": 8, "views_per_scene": 2},
    "worlds": [{"kind": "room"}],
    "targets": {"models": ["relay", "materialbox"], "count": [2, 2]},
    "distractors": {"primitives": {"count": [2, 2]}},
    "placement": {"kind": "arrange"},
    "textures": {"size": 64},
    "camera": {"width": 80, "height": 60, "focal": 72.0},
}


class _Watched(MujocoColorRenderer):
    """Remembers, weakly, what each scene consisted of and what it was compiled to."""

    def begin(self, content: Content) -> None:
        super().begin(content)
        textures = [shape.material.texture for shape in content.shapes if shape.material.texture is not None]
        self.seen = [weakref.ref(thing) for thing in (content.rays, content.background, *textures)]
        self.seen += [weakref.ref(self._model), weakref.ref(self._scene)]

    def render(self, T_map_camera: Float64) -> Uint8:
        image = super().render(T_map_camera)
        self.seen.append(weakref.ref(image))
        return image


@pytest.mark.gl
def test_nothing_of_a_scene_outlives_the_beginning_of_the_next() -> None:
    recipe = parse_recipe(RECIPE, Path("small.yaml"))
    renderer = _Watched(recipe.camera.intrinsics)
    with Generator(recipe, seed=0, renderer=renderer) as generator:
        for scene in range(3):
            former = [] if scene == 0 else renderer.seen
            frames = generator.frames(scene)
            next(frames)
            gc.collect()
            assert [kept for ref in former if (kept := ref()) is not None] == []
            assert sum(1 for _ in frames) == 1
    assert len(renderer.seen) > 8


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="asks glibc")
def test_settling_leaves_no_memory_to_heaps_of_threads() -> None:
    """MuJoCo's compiler starts threads unless it is told not to, and glibc keeps a heap for each."""
    static = StaticWorld((furniture.table(1.0, 1.5, 0.7).placed("table", 0.0, 0.0, 0.0, room="room"),))
    area, rng = support_area(static, "table", 0, None, None), np.random.default_rng(0)
    settings = PrimitiveSettings(count=(6, 6), size=(0.04, 0.15))

    def once() -> int:
        bodies = [Body(f"shape-{k}", primitive(settings, rng), 1.0) for k in range(6)]
        settle(static, bodies, area, ArrangePlacement(kind="arrange", settle=0.1), rng)
        return _other_heaps()

    first = once()
    assert [once() for _ in range(4)] == [first] * 4


def test_a_worker_has_one_heap() -> None:
    assert thread_limits(2)["MALLOC_ARENA_MAX"] == "1"


def _other_heaps() -> int:
    """Bytes of all heaps of this process but its main one, from glibc's ``malloc_info``."""
    libc = ctypes.CDLL(None)
    libc.open_memstream.restype, libc.fclose.argtypes = ctypes.c_void_p, [ctypes.c_void_p]
    text, size = ctypes.c_char_p(), ctypes.c_size_t()
    stream = libc.open_memstream(ctypes.byref(text), ctypes.byref(size))
    libc.malloc_info(0, ctypes.c_void_p(stream))
    libc.fclose(stream)
    report = (text.value or b"").decode()
    libc.free(text)
    heaps = report.split("<heap ")[2:]
    return sum(int(found[1]) for heap in heaps if (found := re.search(r'type="current" size="(\d+)"', heap)))
