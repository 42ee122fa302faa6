"""Background classes of things: what a class is a kind of, for queries such as "all tools on the bench"."""

from types import MappingProxyType

SEMANTIC_CLASSES = MappingProxyType(
    {
        "thing": (),
        # what robots handle
        "artifact": ("thing",),
        "tool": ("artifact",),
        "hand-tool": ("tool",),
        "power-tool": ("tool",),
        "measuring-device": ("tool",),
        "multimeter": ("measuring-device",),
        "screwdriver": ("power-tool",),
        "powerdrill": ("power-tool",),
        "soldering-station": ("power-tool",),
        "container": ("artifact",),
        "box": ("container",),
        "small-load-carrier": ("box",),
        "parts-box": ("box",),
        "cardboard-box": ("box",),
        "vessel": ("container",),
        "mug": ("vessel",),
        "thermos": ("vessel",),
        "spray-bottle": ("vessel",),
        "plant-pot": ("vessel",),
        "component": ("artifact",),
        "electrical-component": ("component",),
        "relay": ("electrical-component",),
        "consumable": ("artifact",),
        "tape-dispenser": ("hand-tool",),
        "lamp": ("artifact",),
        "cup": ("vessel",),
        "bottle": ("vessel",),
        "bowl": ("vessel",),
        "bag": ("container",),
        "book": ("artifact",),
        "plant": ("thing",),
        "electronic-device": ("artifact",),
        "monitor": ("electronic-device",),
        "keyboard": ("electronic-device",),
        "appliance": ("artifact",),
        "microwave": ("appliance",),
        "fridge": ("appliance",),
        # what stands or moves about in buildings
        "building-element": ("thing",),
        "floor": ("building-element",),
        "wall": ("building-element",),
        "ceiling": ("building-element",),
        "door": ("building-element",),
        "window": ("building-element",),
        "pillar": ("building-element",),
        "furniture": ("artifact",),
        "table": ("furniture",),
        "workbench": ("table",),
        "desk": ("table",),
        "shelf": ("furniture",),
        "cupboard": ("furniture",),
        "chair": ("furniture",),
        "bed": ("furniture",),
        "sofa": ("furniture",),
        "cabinet": ("furniture",),
        "bin": ("container",),
        "agent": ("thing",),
        "person": ("agent",),
        "hand": ("agent",),
        "robot": ("agent", "artifact"),
    }
)
"""Class -> its direct superclasses. A class may have several; every name that occurs is itself a key."""


def superclasses(name: str) -> tuple[str, ...]:
    """All classes that `name` is a kind of, itself first, nearer before farther ones; unknown names stand alone."""
    found = [name]
    for known in found:
        found.extend(parent for parent in SEMANTIC_CLASSES.get(known, ()) if parent not in found)
    return tuple(found)
