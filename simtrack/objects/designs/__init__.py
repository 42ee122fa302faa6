"""The procedural catalogue: one function an object, which answers with its `Design`."""

from collections.abc import Callable
from types import MappingProxyType

from simtrack.objects.designs import containers
from simtrack.objects.shapes import Design

DESIGNS: MappingProxyType[str, Callable[[], Design]] = MappingProxyType(
    {
        "klt3147": containers.klt3147,
        "materialbox": containers.materialbox,
    }
)
"""Name -> its design; the names of `simtrack.objects.catalogue.BUILT_IN`."""
