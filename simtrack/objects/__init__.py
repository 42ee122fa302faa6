"""Object models: the procedural catalogue, users' own objects, and the tracker's imperfect copies of both."""

from simtrack.objects.model import (
    BOX_CORNERS,
    BOX_EDGES,
    ObjectModel,
    Symmetries,
    SymmetryAxis,
    box_keypoints,
)
from simtrack.objects.registry import BUILT_IN, CLUTTER, catalogue, load_object, register_folder
from simtrack.objects.semantics import SEMANTIC_CLASSES, superclasses
from simtrack.objects.tracker_model import EXACT, TrackerModelConfig, tracker_model

__all__ = [
    "BOX_CORNERS",
    "BOX_EDGES",
    "BUILT_IN",
    "CLUTTER",
    "EXACT",
    "SEMANTIC_CLASSES",
    "ObjectModel",
    "Symmetries",
    "SymmetryAxis",
    "TrackerModelConfig",
    "box_keypoints",
    "catalogue",
    "load_object",
    "register_folder",
    "superclasses",
    "tracker_model",
]
