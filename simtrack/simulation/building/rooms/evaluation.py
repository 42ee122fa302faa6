"""The rooms that reconstruction is evaluated on: seeds in one file."""

from typing import Annotated

from pydantic import Field

from simtrack.errors import UnknownNameError
from simtrack.paths import scene_roots
from simtrack.simulation.strict_file import Strict, read_document, validated

FILE = "rooms/evaluation.yaml"
"""In the folders of scenes."""


class EvaluationRooms(Strict):
    """The content of the file."""

    seeds: Annotated[tuple[Annotated[int, Field(ge=0)], ...], Field(min_length=1, max_length=1000)]


def evaluation_rooms() -> tuple[int, ...]:
    """Seeds of the evaluation rooms, from the first folder of scenes that has the file.

    Raises:
        UnknownNameError: no folder of scenes has it.
        FileFormatError: it is not what it should be.
    """
    roots = scene_roots()
    for root in roots:
        if (root / FILE).is_file():
            return validated(EvaluationRooms, read_document(root / FILE), root / FILE, "evaluation rooms").seeds
    raise UnknownNameError("file of evaluation rooms", FILE, [str(root) for root in roots])
