"""``simtrack validate``: check every file of a data set, and that image, depth and pose agree."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

if TYPE_CHECKING:
    from simtrack.datasets.validation import Validation

MAX_LINES = 40


def validate(
    folder: Annotated[Path, tyro.conf.Positional],
    sample: int = 20,
) -> int:
    """Check every file of a data set against its format, and that image, depth and pose agree.

    Takes what `simtrack generate` made and, in a known format, what others made. Ends with exit code 1 if anything is
    wrong.

    Args:
        folder: The data set.
        sample: About how many images the models are shown in again at the stated poses, for comparison.
    """
    from simtrack.cli import console
    from simtrack.datasets import validation
    from simtrack.errors import InvalidValueError

    if sample < 0:
        raise InvalidValueError("sample", sample, "0 or more")
    with console.ProgressLine(f"validation of {folder.name}", "reading") as line:
        result = validation.validate(folder, sample, line.say)
    for finding in result.findings[:MAX_LINES]:
        print(finding)
    if len(result.findings) > MAX_LINES:
        print(f"... and {len(result.findings) - MAX_LINES} more")
    show(result)
    return 0 if result.good else 1


def show(result: "Validation") -> None:
    """Print what was looked at and the verdict."""
    checked = ", ".join(f"{name} {count}" for name, count in result.counts.items())
    print(f"checked {result.files} files ({checked} images, scans or logs)")
    if result.images:
        print(f"shown again at the stated poses: {result.instances} instances in {result.images} images")
    if result.depth_error is not None:
        median, high = result.depth_error
        print(f"depth off the models: {1e3 * median:.2f} mm (median), {1e3 * high:.2f} mm (99th percentile)")
    if result.colour_offset is not None:
        print(f"colour edges off the masks: {result.colour_offset[0]}, {result.colour_offset[1]} pixels")
    print("everything is right" if result.good else f"{len(result.findings)} things are wrong")
