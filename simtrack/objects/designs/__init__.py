"""The procedural catalogue: one function an object, which answers with its `Design`."""

from collections.abc import Callable
from types import MappingProxyType

from simtrack.objects.designs import clutter, containers, handheld, multimeter, relay
from simtrack.objects.shapes import Design

DESIGNS: MappingProxyType[str, Callable[[], Design]] = MappingProxyType(
    {
        **{
            design.__name__: design
            for design in (
                clutter.cardboard_box,
                clutter.desk_lamp,
                clutter.mug,
                clutter.plant_pot,
                clutter.soldering_station,
                clutter.spray_bottle,
                clutter.tape_dispenser,
                clutter.thermos,
            )
        },
        "klt3147": containers.klt3147,
        "materialbox": containers.materialbox,
        "multimeter": multimeter.multimeter,
        "powerdrill": handheld.powerdrill,
        "relay": relay.relay,
        "screwdriver": handheld.screwdriver,
    }
)
"""Name -> its design; the names of `simtrack.objects.registry.BUILT_IN`."""
