"""The objects that simtrack knows: the procedural catalogue and the user's own folders."""

import os
from collections.abc import Callable, Mapping
from functools import cache, partial
from pathlib import Path
from types import MappingProxyType

from simtrack.errors import FileFormatError, InvalidValueError, UnknownNameError
from simtrack.objects.model import ObjectModel

BUILT_IN = ("klt3147", "materialbox", "multimeter", "powerdrill", "relay", "screwdriver")
"""Names of the procedural objects that trackers have models of."""
CLUTTER = (
    "cardboard_box",
    "desk_lamp",
    "mug",
    "plant_pot",
    "soldering_station",
    "spray_bottle",
    "tape_dispenser",
    "thermos",
)
"""Names of the procedural objects that no tracker has a model of."""

_registered: dict[str, Path] = {}


def catalogue() -> Mapping[str, Callable[[], ObjectModel]]:
    """Every known name -> what loads it: procedural objects, clutter, ``$SIMTRACK_OBJECTS``, registered folders.

    Of two folders that define one name the one registered last counts, then the first of ``$SIMTRACK_OBJECTS``.

    Raises:
        FileFormatError: an ``object.yaml`` that cannot be used, or one that takes the name of a procedural object.
    """
    loaders: dict[str, Callable[[], ObjectModel]] = {n: partial(_procedural, n) for n in (*BUILT_IN, *CLUTTER)}
    folders = _environment_folders() | _registered
    loaders |= {name: partial(_from_folder, folder) for name, folder in folders.items()}
    return MappingProxyType(dict(sorted(loaders.items())))


def load_object(name: str) -> ObjectModel:
    """The model called `name`; built once a version and kept on disk, procedural ones in memory too.

    Raises:
        UnknownNameError: no such object; lists the known ones.
        FileFormatError, MeshError: a user's folder that cannot be used.
    """
    known = catalogue()
    if name not in known:
        raise UnknownNameError("object", name, known)
    return known[name]()


def register_folder(path: str | Path) -> tuple[str, ...]:
    """Make a user's object known to this process: a folder with an ``object.yaml``, or a folder of such folders.

    Returns:
        The names that are now known.

    Raises:
        InvalidValueError: not a folder, or no ``object.yaml`` in it.
        FileFormatError: an ``object.yaml`` that cannot be used.
    """
    found = _named_folders(Path(path))
    if not found:
        raise InvalidValueError("path", str(path), "a folder with an object.yaml, or a folder of such folders")
    _registered.update(found)
    return tuple(sorted(found))


def _environment_folders() -> dict[str, Path]:
    found: dict[str, Path] = {}
    for entry in os.environ.get("SIMTRACK_OBJECTS", "").split(os.pathsep):
        if entry:
            found = _named_folders(Path(entry).expanduser()) | found
    return found


def _named_folders(root: Path) -> dict[str, Path]:
    """Object folders at or directly below `root`, by the name that their files state."""
    from simtrack.objects import user_folder

    folders = (
        [root]
        if (root / user_folder.FILE_NAME).is_file()
        else sorted(p.parent for p in root.glob(f"*/{user_folder.FILE_NAME}"))
    )
    found: dict[str, Path] = {}
    for folder in folders:
        name = user_folder.read_specification(folder).name
        if name in BUILT_IN or name in CLUTTER:
            reason = f"'{name}' is an object of the catalogue; choose another name"
            raise FileFormatError(folder / user_folder.FILE_NAME, "name", reason)
        if name in found:
            reason = f"'{name}' is already the name of {found[name]}; choose another name"
            raise FileFormatError(folder / user_folder.FILE_NAME, "name", reason)
        found[name] = folder.resolve()
    return found


@cache
def _procedural(name: str) -> ObjectModel:
    from simtrack.objects.cache import cached_model, digest

    return cached_model(name, digest(), partial(build_procedural, name))


def build_procedural(name: str) -> ObjectModel:
    """Build an object of the catalogue from its design, past all caches."""
    from simtrack.geometry import meshes
    from simtrack.objects.designs import DESIGNS
    from simtrack.objects.model import build_model

    design = DESIGNS[name]()
    visual = meshes.validate(design.body.mesh(), name)
    return build_model(
        name=name,
        semantic_class=design.semantic_class,
        mesh=meshes.subdivide_to(visual, design.faces),
        visual=visual,
        collision=[meshes.convex_hull(part.mesh().vertices) for part in design.collision],
        mass=design.mass,
        friction=design.friction,
        symmetries=design.symmetries,
        trackable=name in BUILT_IN,
        description=design.description,
    )


def _from_folder(folder: Path) -> ObjectModel:
    from simtrack.objects import user_folder

    return user_folder.load_folder(folder)
