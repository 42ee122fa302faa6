"""Medians of metrics over runs: ``python reports/medians.py RUN_DIR... > reports/NAME.json``."""

import json
import statistics
import sys
from pathlib import Path


def medians(folders: list[Path]) -> dict[str, dict[str, object]]:
    """Metric name -> median value, unit, and the value of each run, in the order of the folders."""
    runs = [json.loads((folder / "metrics.json").read_text(encoding="utf-8")) for folder in folders]
    out: dict[str, dict[str, object]] = {}
    for name, first in runs[0].items():
        values = [run.get(name, {}).get("value") for run in runs]
        numbers = [float(v) for v in values if isinstance(v, int | float) and not isinstance(v, bool)]
        if numbers:
            rounded = [None if v is None else float(f"{v:.4g}") for v in values]
            median = float(f"{statistics.median(numbers):.4g}")
            out[name] = {"median": median, "unit": first["unit"], "runs": rounded}
    return out


if __name__ == "__main__":
    json.dump(medians([Path(argument) for argument in sys.argv[1:]]), sys.stdout, indent=1)
    print()
