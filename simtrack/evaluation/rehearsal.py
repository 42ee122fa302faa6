"""The first run on a machine compiles some 150 functions, for which the compiler takes as much memory as a run.

It never gives that back. So a child process runs the first seconds before, and leaves behind what it has compiled,
built and surveyed; the run itself then needs as much memory and time as any later one.
"""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

SECONDS = 2.5
"""Simulated: objects are detected, born, confirmed and related by then."""


def compiled() -> bool:
    """Whether functions that a run compiles late are kept on disk, as their source stands now."""
    from simtrack.perception.localization import kernels as localization
    from simtrack.perception.scene_graph import kernels as relations
    from simtrack.perception.tracking import filter_kernels as tracking

    return all(_kept(kernel) for kernel in (localization.explain, relations.margin_table, tracking.fuse))


def rehearse(scene: str, renderer: str, say: Callable[[str, str], None]) -> None:
    """Run the beginning of a scene in a child process, unless that has been compiled already.

    What goes wrong there goes wrong again, and is told, in the run itself.

    Args:
        scene: name or path.
        renderer: ``mujoco`` or ``embree``.
        say: takes what is being done, and to what.
    """
    if compiled():
        return
    command = [sys.executable, "-m", __name__, scene, renderer]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as child:
        assert child.stdout is not None
        try:
            for line in child.stdout:
                what, _, thing = line.rstrip("\n").partition("\t")
                say(what, thing)
        except BaseException:
            child.kill()
            raise


def _kept(kernel: Any) -> bool:
    """Whether a compiled function has a cache file that is younger than its source."""
    source = Path(kernel.py_func.__code__.co_filename)
    name = f"{source.stem}.{kernel.py_func.__qualname__}-*.nbi"
    files = Path(kernel.stats.cache_path).glob(name)
    return any(file.stat().st_mtime >= source.stat().st_mtime for file in files)


def main(scene: str, renderer: str) -> None:
    """What the child does; tells on standard output what is being made, a tab between what and to what."""
    from simtrack.evaluation.closed_loop import closed
    from simtrack.evaluation.evaluator import Evaluator
    from simtrack.evaluation.process import Clock
    from simtrack.evaluation.run_config import RunConfig
    from simtrack.evaluation.start_up import cold_start_told
    from simtrack.simulation.scene_file import load_scene

    config = RunConfig(scene=load_scene(scene), out=Path(), duration=SECONDS, renderer=renderer)
    with (
        cold_start_told(lambda what, thing: print(what, thing, sep="\t", flush=True)),
        closed(config, config.agent_name) as loop,
        Evaluator(loop.simulation, config.stack, config.seconds) as evaluator,
    ):
        for frame, belief in loop.drive(config.seconds, Clock()):
            evaluator.observe(frame, belief)


if __name__ == "__main__":
    main(*sys.argv[1:])
