"""A reconstruction as JSON: which model stands for each entity, where, how well it fits, and why others were not taken.

Lengths in metres; poses are (4, 4) matrices in the map, row by row.
"""

import json
import math
from typing import Any

from simtrack.perception.reconstruction.reconstruct import Choice, Reconstruction
from simtrack.perception.scene_graph.contact.nodes import SCENE

FORMAT = "simtrack-reconstruction"
VERSION = 1


def dump_reconstruction(made: Reconstruction) -> str:
    """The document; the contact graph and the scene lie in files of their own."""
    document = {
        "format": FORMAT,
        "version": VERSION,
        "name": made.name,
        "entities": [_entity(name, choice, made) for name, choice in made.choices.items()],
        "notes": [{"code": note.code, "entity": note.entity, "message": note.message} for note in made.notes],
    }
    return json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def _entity(name: str, choice: Choice, made: Reconstruction) -> dict[str, Any]:
    candidate, support = choice.candidate, made.graph.supports[name]
    return {
        "name": name,
        "semantic_class": made.graph.nodes[name].semantic_class,
        "model": candidate.model.name,
        "own_mesh": choice.own_mesh,
        "scale": candidate.scale,
        "T_map_model": candidate.T_map_model.tolist(),
        "joint_positions": dict(candidate.positions),
        "matching_error": candidate.matching_error,
        "alignment_error": candidate.alignment_error,
        "orientation": candidate.orientation,
        "rank": choice.rank,
        "candidates": choice.offered,
        "rejected": [{"rank": r.rank, "model": r.model, "reason": r.reason} for r in choice.rejected],
        "snapped_by": choice.shift.tolist(),
        "eq1_residual": None if math.isnan(choice.residual) else choice.residual,
        "parent": None if support.parent == SCENE else support.parent,
        "support": support.kind,
    }
