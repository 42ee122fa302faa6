"""Draws how maps get worse with the oracle's errors, method by method: ``docs/images/panoptic_sweep.png``.

    simtrack evaluate panoptic --rooms 101,105,109,113,117 --frames 100 --strength 2 --out sweep/2    # 0 to 2
    python reports/panoptic_sweep.py sweep/*

Folders that are named are those that the command wrote, one a strength; their figures are kept in
``panoptic_sweep.json`` beside this file, which is what is drawn.
"""

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from simtrack.evaluation.panoptic_rooms import ordering, scores_from_json
from simtrack.report.learning import STYLE

HERE = Path(__file__).parent
FILE = HERE / "panoptic_sweep.json"
FIGURES = (
    ("panoptic.pq", "PQ, all classes, %"),
    ("panoptic.stuff.pq", "PQ, stuff, %"),
    ("panoptic.things.pq", "PQ, things, %"),
    ("boxes.map50", "boxes, mAP at an IoU of 0.5, %"),
)
METHODS = {"full": "#1f6fb4", "no-joint-fusion": "#e07b1a", "voxbloxpp": "#7a7a7a"}


def collected(folders: Sequence[Path]) -> list[dict[str, Any]]:
    """A row for each strength: figures by method, and the rooms in which one method's PQ is above another's."""
    rows = []
    for folder in folders:
        (file,) = folder.glob("panoptic*.json")
        document = json.loads(file.read_text(encoding="utf-8"))
        # `ordering` looks at the values alone: any key will do for a room.
        rooms: dict[Any, Any] = {
            room["room"]: {m: scores_from_json(s) for m, s in room["scores"].items()} for room in document["rooms"]
        }
        figures = {m: {k: document["figures"][m][k]["value"] for k, _ in FIGURES} for m in METHODS}
        better = {f"{a} > {b}": ordering(rooms, a, b) for a, b in zip(METHODS, list(METHODS)[1:], strict=False)}
        rows.append({"how": document["how"], "rooms": list(rooms), "figures": figures, "rooms_above": better})
    return sorted(rows, key=lambda row: row["how"]["strength"])


def main(folders: Sequence[Path]) -> None:
    """Collect what is named, and draw."""
    import matplotlib

    if folders:
        FILE.write_text(json.dumps(collected(folders), indent=1) + "\n", encoding="utf-8")
    rows = json.loads(FILE.read_text(encoding="utf-8"))
    strengths = [row["how"]["strength"] for row in rows]
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(11.0, 2.8), layout="constrained")
        for axes, (key, title) in zip(figure.subplots(1, len(FIGURES)), FIGURES, strict=True):
            for method, color in METHODS.items():
                values = [100.0 * row["figures"][method][key] for row in rows]
                axes.plot(strengths, values, color=color, marker=".", label=method)
            axes.set_title(title, fontsize=9)
            axes.set_xlabel("strength of the oracle's errors")
            axes.set_ylim(bottom=0.0)
        figure.axes[0].legend(fontsize=8)
        figure.savefig(HERE.parent / "docs" / "images" / "panoptic_sweep.png", dpi=110)


if __name__ == "__main__":
    main([Path(name) for name in sys.argv[1:]])
