"""``simtrack trials``: whether the localizer recovers from a wrong start and from being carried off."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

if TYPE_CHECKING:
    from simtrack.evaluation.localization_trials import LidarWorld, TrialOutcome


def trials(
    kind: Annotated[Literal["wrong-start", "kidnapped"], tyro.conf.Positional],
    scene: Annotated[str, tyro.conf.Positional] = "lab_floor",
    count: int = 40,
    seed: int = 0,
    out: Path | None = None,
    threads: int | None = None,
) -> int:
    """Try the localizer many times in the building of a scene: from a wrong start, or carried off to another place.

    Args:
        kind: What is tried: wrong-start or kidnapped.
        scene: Name of a scene, or path of its folder or YAML file.
        count: How often.
        seed: Of the building, its survey and the trials.
        out: Write the figures to this JSON file.
        threads: Threads of the compiled kernels; all cores if not given.
    """
    from simtrack.cli import console
    from simtrack.errors import InvalidValueError
    from simtrack.evaluation.localization_trials import run_trials
    from simtrack.evaluation.metrics import measured, write_metrics
    from simtrack.evaluation.process import set_threads

    if count < 1:
        raise InvalidValueError("count", count, "1 or more")
    set_threads(threads)

    def tell(number: int, outcome: "TrialOutcome") -> None:
        verdict = f"recovered after {outcome.seconds:.1f} s" if outcome.recovered else "did not recover"
        wrong = f", confident and wrong for {outcome.confident_wrong:.1f} s" if outcome.confident_wrong else ""
        print(f"{kind} {number + 1}/{count}: {verdict}{wrong} ({outcome.status.value})", flush=True)

    summary = run_trials(kind, count, _world(scene, seed), seed, report=tell)
    name = f"localization.{kind.replace('-', '_')}"
    metrics = {
        f"{name}.recovered": measured(summary.recovered, "1"),
        f"{name}.confident_wrong": measured(summary.confident_wrong, "1"),
        f"{name}.recovery_time.median": measured(summary.median_seconds, "s"),
        f"{name}.trials": measured(count, "1"),
    }
    console.show_table(
        ("metric", "value", "unit"), [(name, m.value, m.unit) for name, m in metrics.items()], right=(1,)
    )
    if out is not None:
        write_metrics(out, metrics)
    return 0


def _world(scene: str, seed: int) -> "LidarWorld":
    """The building of a scene with its survey, for lidar and odometry alone."""
    from simtrack.evaluation.localization_trials import LidarWorld
    from simtrack.simulation.scene_file import load_scene
    from simtrack.simulation.simulation import Simulation

    with Simulation(load_scene(scene), seed, renderer="embree") as simulation:
        return LidarWorld(simulation.world.static, simulation.static_map, simulation.robot)
