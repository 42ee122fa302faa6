"""The CAD models that simtrack knows: the procedural catalogue, and folders of users' OBJ and URDF files."""

import os
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from types import MappingProxyType

from simtrack.errors import InvalidValueError, UnknownNameError
from simtrack.objects.cad.model import CadModel

CAD_CLASSES = (
    "bag",
    "bed",
    "book",
    "bottle",
    "bowl",
    "box",
    "cabinet",
    "chair",
    "cup",
    "fridge",
    "keyboard",
    "microwave",
    "monitor",
    "plant",
    "sofa",
    "table",
)
"""Semantic classes of the procedural catalogue."""
VARIABLE = "SIMTRACK_CAD"
"""Environment variable: folders of users' models, separated as ``$PATH`` is; see `simtrack.objects.cad.user_models`."""


def cad_classes() -> tuple[str, ...]:
    """All classes that there are models of, users' own included."""
    return tuple(sorted({*CAD_CLASSES, *_user_models()}))


def cad_models(semantic_class: str) -> tuple[CadModel, ...]:
    """All models of a class: the catalogue's, then users' own; built once a version and kept on disk.

    Raises:
        UnknownNameError: there is no model of that class; lists the classes.
        FileFormatError, MeshError: a user's model that cannot be used.
    """
    own = _user_models().get(semantic_class, ())
    if semantic_class not in CAD_CLASSES and not own:
        raise UnknownNameError("class of CAD models", semantic_class, cad_classes())
    built = _procedural(semantic_class) if semantic_class in CAD_CLASSES else ()
    return (*built, *(load() for load in own))


def cad_model(name: str) -> CadModel:
    """The model called `name`, e.g. ``fridge-french_doors``; raises UnknownNameError with those of its class."""
    semantic_class = name.partition("-")[0]
    models = {model.name: model for model in cad_models(semantic_class)}
    if name not in models:
        raise UnknownNameError("CAD model", name, models)
    return models[name]


@cache
def _procedural(semantic_class: str) -> tuple[CadModel, ...]:
    from simtrack.objects.cache import digest
    from simtrack.objects.cad.store import cached_models

    return cached_models(semantic_class, digest(), lambda: build_class(semantic_class))


def build_class(semantic_class: str) -> tuple[CadModel, ...]:
    """Build the catalogue's models of a class from their designs, past all caches."""
    from simtrack.objects.cad.designs import CAD_DESIGNS

    return tuple(design().finish(f"{semantic_class}-{name}") for name, design in CAD_DESIGNS[semantic_class].items())


def _user_models() -> Mapping[str, tuple[Callable[[], CadModel], ...]]:
    folders = [Path(entry).expanduser() for entry in os.environ.get(VARIABLE, "").split(os.pathsep) if entry]
    if not folders:
        return MappingProxyType({})
    from simtrack.objects.cad.user_models import find_models

    found: dict[str, tuple[Callable[[], CadModel], ...]] = {}
    for folder in folders:
        if not folder.is_dir():
            raise InvalidValueError(VARIABLE, str(folder), "existing folders, separated as in $PATH")
        for semantic_class, loaders in find_models(folder).items():
            found[semantic_class] = found.get(semantic_class, ()) + loaders
    return found
