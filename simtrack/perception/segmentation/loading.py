"""Segmenters by name: a network that was trained, a service, a class of the user's."""

from pathlib import Path
from typing import cast

from simtrack.errors import StageError
from simtrack.perception.segmentation.panoptic import Segmenter

LEARNED = "learned"
"""The network that comes along."""
ALLOWED = f"{LEARNED}, a folder or .onnx file of `simtrack train segmenter`, http://HOST:PORT, package.module:Class"


def make_segmenter(given: str) -> Segmenter:
    """Open a segmenter.

    Args:
        given: one of `ALLOWED`.

    Raises:
        FileFormatError: a network's file is missing or is another's.
        StageError: no service answers, or the class cannot be used.
    """
    if given.startswith(("http:", "https:")):
        from simtrack.perception.segmentation.client import HttpSegmenter

        return HttpSegmenter(given)
    if given == LEARNED or given.endswith(".onnx") or Path(given).is_dir():
        from simtrack.perception.segmentation.learned import LearnedSegmenter

        return LearnedSegmenter(None if given == LEARNED else Path(given))
    from simtrack.perception.foreign.loading import build_stage

    if ":" not in given:
        raise StageError("segmenter", given, f"cannot be read; allowed: {ALLOWED}")
    return cast(Segmenter, build_stage("segmenter", given))
