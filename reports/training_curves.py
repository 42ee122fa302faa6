"""Draws what the networks that come along made of held-out scenes while they learned: ``docs/images/training.png``.

    python reports/training_curves.py

The logs beside it are those of the trainings (``log.jsonl`` of each network's folder).
"""

import json
from pathlib import Path

from matplotlib.figure import Figure

from simtrack.report.learning import BLUE, ORANGE, STYLE

HERE = Path(__file__).parent
CURVES = (
    ("training_boxes.jsonl", "AP50", 100.0, "boxes: AP50, %"),
    ("training_keypoints.jsonl", "median error, % of size", 1.0, "keypoints: median error, % of size"),
    ("training_segments.jsonl", "PQ", 1.0, "segments: PQ of single images, %"),
)


def main() -> None:
    """Read the logs and write the picture."""
    import matplotlib

    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(10.0, 2.8), layout="constrained")
        for axes, (name, key, factor, title) in zip(figure.subplots(1, len(CURVES)), CURVES, strict=True):
            rows = [json.loads(line) for line in (HERE / name).read_text(encoding="utf-8").splitlines()]
            minutes = [row["seconds"] / 60.0 for row in rows]
            values = [factor * row["figures"][key] for row in rows]
            axes.plot(minutes, values, color=ORANGE if "error" in key else BLUE, marker=".")
            axes.set_title(title, fontsize=9)
            axes.set_xlabel("minutes of computing time")
        figure.savefig(HERE.parent / "docs" / "images" / "training.png", dpi=110)


if __name__ == "__main__":
    main()
