"""The designs of the CAD catalogue: eight or more constructions a class."""

from collections.abc import Callable, Mapping
from types import MappingProxyType

from simtrack.objects.cad.builder import ModelBuilder
from simtrack.objects.cad.designs import beds, electronics, seats, small_things, storage, tables, vessels

Designer = Callable[[], ModelBuilder]


def _named(*designs: Designer) -> dict[str, Designer]:
    return {design.__name__: design for design in designs}


CAD_DESIGNS: Mapping[str, Mapping[str, Designer]] = MappingProxyType(
    {
        "bag": _named(*small_things.BAGS),
        "bed": _named(*beds.VARIANTS),
        "book": small_things.BOOKS,
        "bottle": vessels.BOTTLES,
        "bowl": vessels.BOWLS,
        "box": small_things.BOXES,
        "cabinet": _named(*storage.CABINETS),
        "chair": _named(*seats.CHAIRS),
        "cup": vessels.CUPS,
        "fridge": _named(*storage.FRIDGES),
        "keyboard": electronics.KEYBOARDS,
        "microwave": storage.MICROWAVES,
        "monitor": _named(*electronics.MONITORS),
        "plant": small_things.PLANTS,
        "sofa": _named(*seats.SOFAS),
        "table": _named(*tables.VARIANTS),
    }
)
"""Semantic class -> name of the variant -> its design."""
