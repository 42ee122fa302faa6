"""Which detector a run has if none is named: one that looks at the images, where it knows what is to be found."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache

from simtrack.perception.detection.loading import KEYPOINTS, known_classes

ORACLE = "oracle"
"""The detector that knows the truth, and errs like a trained network; the localizer that knows it and does not err."""


@dataclass(frozen=True, slots=True)
class DetectorChoice:
    """A detector, and why it is this one."""

    name: str
    """As it is given to ``simtrack run --detector``."""
    reason: str
    """In words."""


def choose_detector(classes: Iterable[str], oracle_errs_otherwise: bool = False) -> DetectorChoice:
    """The detector of a run for which none was named.

    Args:
        classes: names of the models of the objects that are to be detected.
        oracle_errs_otherwise: the run says how the oracle's detections err or how late they are.
    """
    wanted = set(classes)
    if not wanted:
        return DetectorChoice(ORACLE, "the scene has no objects that are to be detected")
    if oracle_errs_otherwise:
        return DetectorChoice(ORACLE, "the conditions say how its detections err")
    if unknown := sorted(wanted - _shipped_classes()):
        return DetectorChoice(ORACLE, f"the networks that come along do not know {', '.join(unknown)}")
    return DetectorChoice(KEYPOINTS, "the networks that come along know all objects of the scene")


@cache
def _shipped_classes() -> frozenset[str]:
    return frozenset(known_classes(KEYPOINTS))
