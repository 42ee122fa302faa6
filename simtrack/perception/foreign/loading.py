"""Stages by name: ``package.module:Class`` for Python, ``exec:program arguments`` for a tracker in any language."""

import importlib
import inspect
import shlex
import shutil
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Protocol

from simtrack.contracts import Detector, Float64, Localizer, SceneGraphBuilder, StaticMap, Tracker
from simtrack.errors import StageError
from simtrack.geometry.kinematics import KinematicTree
from simtrack.objects import ObjectModel
from simtrack.perception.foreign.process_tracker import ProcessTracker
from simtrack.perception.segmentation.panoptic import Segmenter

PROTOCOLS: Mapping[str, type] = {
    "tracker": Tracker, "localizer": Localizer, "detector": Detector, "scene graph": SceneGraphBuilder,
    "segmenter": Segmenter,
}  # fmt: skip
EXEC = "exec:"


class _Maker(Protocol):
    """A class, or a function that returns a stage."""

    def __call__(self, **parts: object) -> object: ...


@dataclass(frozen=True, slots=True)
class StageContext:
    """What a stage may ask for, by the names of its constructor's parameters."""

    models: Mapping[str, ObjectModel]
    """Class name -> model of every object that can be tracked."""
    static_map: StaticMap
    """The surveyed map."""
    robot: KinematicTree
    """The robot's body."""
    T_map_base: Float64 | None
    """(4, 4) start pose as the operator states it."""


def check_stage(stage: str, given: str) -> None:
    """Whether a stage can be loaded, before anything is built.

    Args:
        stage: ``tracker``, ``localizer``, ``detector``, ``scene graph`` or ``segmenter``.
        given: ``package.module:Class``, or ``exec:program`` for a tracker.

    Raises:
        StageError: it cannot; says which module, name or method is missing.

    """
    if given.startswith(EXEC):
        _command(stage, given)
    else:
        _maker(stage, given)


def build_stage(stage: str, given: str, context: StageContext | None = None) -> object:
    """The stage, made by what `given` names; its constructor gets the fields of `context` that it has parameters for.

    Raises:
        StageError: it cannot be loaded, its constructor asks for something else or raises, or it lacks a method.

    """
    if given.startswith(EXEC):
        program = ProcessTracker(_command(stage, given), {} if context is None else context.models)
        try:
            program.start()
        except (OSError, ValueError) as error:
            program.close()
            raise StageError(stage, given, f"is not ready: {error}") from error
        return program
    maker = _maker(stage, given)
    parts = _parts(stage, given, maker, context)
    try:
        built = maker(**parts)
    except Exception as error:
        raise StageError(stage, given, f"could not be built: {type(error).__name__}: {error}") from error
    _check_methods(stage, given, built)
    return built


def _command(stage: str, given: str) -> list[str]:
    """Program and arguments; the program is searched in $PATH and from the current folder."""
    if stage != "tracker":
        raise StageError(stage, given, "only a tracker can be a program; allowed: package.module:Class")
    try:
        command = shlex.split(given.removeprefix(EXEC))
    except ValueError as error:
        raise StageError(stage, given, f"cannot be split into program and arguments: {error}") from error
    if not command:
        raise StageError(stage, given, "names no program; allowed: exec:PROGRAM ARGUMENTS")
    found = shutil.which(command[0])
    if found is None:
        raise StageError(stage, given, f"no program '{command[0]}' that can be executed")
    return [str(Path(found).absolute()), *command[1:]]


def _maker(stage: str, given: str) -> _Maker:
    module_name, colon, name = given.partition(":")
    if not colon or not module_name or not name:
        allowed = f"{stage} is package.module:Class" + (" or exec:PROGRAM ARGUMENTS" if stage == "tracker" else "")
        raise StageError(stage, given, f"cannot be read; {allowed}")
    folder = str(Path.cwd())
    if folder not in sys.path:  # as with `python -m`, whatever simtrack was started by
        sys.path.insert(0, folder)
    try:
        module = importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        missing = f"no module '{error.name}' in {folder} or the Python path"
        raise StageError(stage, given, missing if error.name else str(error)) from error
    except Exception as error:  # of the module's own code
        raise StageError(stage, given, f"the module raised {type(error).__name__}: {error}") from error
    maker: object = module
    for part in name.split("."):
        if not hasattr(maker, part):
            raise StageError(stage, given, f"module '{module_name}' has no '{name}'; it has: {_names(module)}")
        maker = getattr(maker, part)
    if not callable(maker):
        raise StageError(stage, given, f"'{name}' is a {type(maker).__name__}, neither a class nor a function")
    if inspect.isclass(maker):
        _check_methods(stage, given, maker)
    return maker  # type: ignore[return-value]


def _check_methods(stage: str, given: str, thing: object) -> None:
    """Whether a class or an instance has every method of the stage's Protocol, with room for its arguments."""
    for method, wanted in _methods(PROTOCOLS[stage]).items():
        own = getattr(thing, method, None)
        what = PROTOCOLS[stage].__name__
        if not callable(own):
            raise StageError(stage, given, f"has no method '{method}', which a {what} needs: {method}{wanted}")
        try:
            taken = inspect.signature(own)
        except (TypeError, ValueError):  # of a compiled extension: the first call will tell
            continue
        skip_self = inspect.isclass(thing) and not isinstance(inspect.getattr_static(thing, method), staticmethod)
        try:
            taken.bind(*[None] * (len(wanted.parameters) - (0 if skip_self else 1)))
        except TypeError as error:
            reason = f"method '{method}{taken}' does not take what a {what} is given, {method}{wanted}: {error}"
            raise StageError(stage, given, reason) from error


def _methods(protocol: type) -> dict[str, inspect.Signature]:
    return {name: inspect.signature(part) for name, part in vars(protocol).items() if _is_method(name, part)}


def _is_method(name: str, part: object) -> bool:
    return not name.startswith("_") and inspect.isfunction(part)


def _parts(stage: str, given: str, maker: Callable[..., object], context: StageContext | None) -> dict[str, object]:
    """Arguments for the constructor."""
    offered = {} if context is None else {field.name: getattr(context, field.name) for field in fields(StageContext)}
    try:
        parameters = inspect.signature(maker).parameters.values()
    except (TypeError, ValueError):
        return {}
    chosen: dict[str, object] = {}
    for parameter in parameters:
        if parameter.kind in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD):
            continue
        if parameter.name in offered and parameter.kind is not parameter.POSITIONAL_ONLY:
            chosen[parameter.name] = offered[parameter.name]
        elif parameter.default is parameter.empty:
            reason = f"its constructor asks for '{parameter.name}'; there are: {', '.join(offered) or 'none'}"
            raise StageError(stage, given, reason)
    return chosen


def _names(module: object) -> str:
    names = [name for name, value in vars(module).items() if callable(value) and not name.startswith("_")]
    return ", ".join(sorted(names)) or "(nothing that can be called)"
