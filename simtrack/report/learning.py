"""Pictures of what agents do: what PPO has learned over time, and how success falls with a worse detector."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

BLUE, ORANGE, GREY = "#4c9be8", "#f28e2b", "#555555"
STYLE: Any = {
    "font.size": 9, "axes.spines.top": False, "axes.spines.right": False, "axes.grid": True, "grid.alpha": 0.4,
    "legend.frameon": False, "figure.facecolor": "white",
}  # fmt: skip
SMOOTH = 10
"""Episodes that a curve of learning is the mean of."""


def draw_learning(
    episodes: Sequence[tuple[float, float, float]], path: Path, beside: Mapping[str, tuple[float, float]] | None = None
) -> None:
    """Draw return and known share over the time of a training.

    Args:
        episodes: minutes of CPU time, return, known share of each.
        path: of the PNG file.
        beside: name of a policy -> its mean return and known share, as lines.
    """
    import matplotlib
    from matplotlib.figure import Figure

    minutes, *curves = (np.array(column) for column in zip(*episodes, strict=True))
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(8.0, 3.2), layout="constrained")
        both = figure.subplots(1, 2)
        for k, name in enumerate(("return of an episode", "known share")):
            axes, values = both[k], curves[k]
            axes.plot(minutes, values, ".", color=BLUE, alpha=0.35, markersize=4, label="episodes of the training")
            count = min(SMOOTH, len(values))
            mean = np.convolve(values, np.full(count, 1.0 / count), "valid")
            axes.plot(minutes[count - 1 :], mean, color=BLUE, linewidth=2, label=f"mean of {count}")
            for style, (policy, figures) in zip(("--", ":", "-."), (beside or {}).items(), strict=False):
                axes.axhline(figures[k], color=GREY, linestyle=style, linewidth=1.2, label=policy)
            axes.set_xlabel("minutes of CPU time")
            axes.set_title(name)
        figure.legend(*both[0].get_legend_handles_labels(), loc="outside lower center", ncols=5)
        figure.savefig(path, dpi=150)
