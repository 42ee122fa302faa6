"""How well what is believed about objects agrees with what is the case."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from simtrack.contracts import Track
from simtrack.evaluation.pose_errors import PoseScorer
from simtrack.evaluation.tracking import KNOWN_ROTATION, KNOWN_TRANSLATION, match_tracks
from simtrack.objects import ObjectModel
from simtrack.simulation.ground_truth import Truth

ERROR_LIMIT = 0.1
"""Metres: an object that is believed farther off than this is as good as unknown."""


@dataclass(frozen=True, slots=True)
class Knowledge:
    """What is known of the scene's objects at one moment."""

    error: float
    """0 to 1: mean over the objects of their translation error as a share of `ERROR_LIMIT`, 1 if unknown."""
    known: float
    """0 to 1: share of the objects whose believed pose is within 2 cm and 10 degrees, symmetries respected."""
    median_error: float
    """Metres, over the objects that are believed at all; `ERROR_LIMIT` if none is."""


class KnowledgeMeter:
    """Measures beliefs in the map frame: an error of the robot's own pose counts."""

    def __init__(self, models: Mapping[str, ObjectModel]) -> None:
        """`models`: class name -> true model."""
        self._scorers = {
            name: PoseScorer(np.asarray(model.keypoints, dtype=float), model.symmetries, model.diameter)
            for name, model in models.items()
        }

    def measure(self, tracks: Sequence[Track], truth: Truth) -> Knowledge:
        """Compare tracks with the true poses of the objects of the catalogue."""
        things = [thing for thing in truth.objects.values() if thing.kind == "catalogue"]
        matches = match_tracks(tracks, truth)
        shares, known, errors = [], 0, []
        for thing in things:
            track = matches.get(thing.name)
            if track is None:
                shares.append(1.0)
                continue
            scorer = self._scorers[thing.class_name]
            translation, rotation = scorer.errors(track.T_map_object, thing.T_map_object)
            errors.append(translation)
            shares.append(min(translation / ERROR_LIMIT, 1.0))
            known += translation <= KNOWN_TRANSLATION and rotation <= KNOWN_ROTATION
        count = max(len(things), 1)
        median = float(np.median(errors)) if errors else ERROR_LIMIT
        return Knowledge(float(np.sum(shares)) / count, known / count, median)
