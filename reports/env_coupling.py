"""How much an agent depends on what it perceives: ``python env_coupling.py``, episodes of Tidy, ever worse detectors.

The scripted policy sees beliefs only. Writes `env_coupling.json` beside this file and the curve in `docs/envs`. The
same command carries on where it was stopped.
"""

import json
from pathlib import Path

import gymnasium as gym
import matplotlib.pyplot as plt

import simtrack  # noqa: F401  # registers the environments
from simtrack.envs.play import play
from simtrack.simulation.oracles import OracleDetectorConfig

HERE = Path(__file__).resolve().parent
PICTURE = HERE.parent / "docs" / "envs" / "coupling.png"
SEEDS = range(6000, 6010)
AXES = {
    "keypoint_error": ("median error of keypoints, % of the object's size", (0.1, 0.2, 0.3, 0.45)),
    "miss_rate": ("objects in view that an image does not show, %", (0.5, 0.8, 0.9, 0.97)),
}
"""What is made worse: how the curve names it, and its values beside the default."""


def levels(name: str) -> tuple[float, ...]:
    """The default, then the worse ones."""
    return getattr(OracleDetectorConfig(), name), *AXES[name][1]


def played(kept: dict[str, dict[str, bool]]) -> None:
    """Play what is not among the successes, level -> seed -> success."""
    for name in AXES:
        for k, value in enumerate(levels(name)):
            errors = {name: value} if k else {}
            results = kept.setdefault(f"{name} {value:g}" if errors else "default", {})
            missing = [seed for seed in SEEDS if str(seed) not in results]
            with gym.make("simtrack/Tidy-v0", disable_env_checker=True, detector_errors=errors) as env:
                for result in play(env, "scripted", missing):
                    results[str(result.seed)] = result.success
                    (HERE / "env_coupling.json").write_text(json.dumps(kept, indent=1) + "\n")
                    print(errors, result.seed, result.success, flush=True)


def draw(kept: dict[str, dict[str, bool]]) -> None:
    """The share of successes over each of the axes."""
    figure, plots = plt.subplots(1, len(AXES), figsize=(9, 3.2), sharey=True, layout="constrained")
    for plot, (name, (label, _)) in zip(plots, AXES.items(), strict=True):
        values = levels(name)
        found = [kept["default" if k == 0 else f"{name} {value:g}"] for k, value in enumerate(values)]
        plot.plot([100 * v for v in values], [100 * sum(f.values()) / len(f) for f in found], "o-", color="tab:blue")
        plot.set(xlabel=label, ylim=(-3, 103))
        plot.grid(alpha=0.3)
    plots[0].set_ylabel(f"Tidy: successes of {len(SEEDS)} episodes, %")
    figure.savefig(PICTURE, dpi=110)


if __name__ == "__main__":
    file = HERE / "env_coupling.json"
    results = json.loads(file.read_text()) if file.exists() else {}
    played(results)
    draw(results)
