"""``simtrack inspect``: a page that shows a data set's images with their labels, and its statistics."""

from pathlib import Path
from typing import Annotated

import tyro


def inspect(
    folder: Annotated[Path, tyro.conf.Positional],
    out: Path | None = None,
    images: int = 12,
) -> int:
    """Write a page that shows a data set: images with masks, boxes, keypoints and axes drawn over them, statistics.

    Reads what is on disk, BOP or COCO, made by simtrack or by others.

    Args:
        folder: The data set.
        out: The HTML file; FOLDER-inspection.html beside the data set if not given.
        images: How many images are shown, evenly spread.
    """
    from simtrack.cli import console
    from simtrack.datasets import inspection
    from simtrack.errors import InvalidValueError
    from simtrack.report.dataset_page import write_dataset_page

    if not 1 <= images <= 500:
        raise InvalidValueError("images", images, "1 to 500")
    path = out if out is not None else folder.resolve().with_name(f"{folder.resolve().name}-inspection.html")
    with console.ProgressLine(f"inspection of {folder.name}", "reading") as line:
        found = inspection.inspect(folder, images, line.say)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_dataset_page(found, path)
    console.show_written(path.parent, [path.name])
    return 0
