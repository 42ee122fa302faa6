"""The one tree of errors that simtrack raises.

Every message says what was wrong, where, and what would have been valid. A stage that merely fails on one frame does
not raise: it reports a status (see `simtrack.contracts.Status`) and keeps its state.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import Any


class SimtrackError(Exception):
    """Base of all errors raised by simtrack. They pass from process to process, message and attributes alike."""

    def __reduce__(self) -> tuple[Any, ...]:
        return _raised_elsewhere, (type(self), self.args, vars(self))


class UnknownNameError(SimtrackError):
    """A scene, object, agent, detector or other registered name that does not exist."""

    def __init__(self, kind: str, name: str, known: Iterable[str]) -> None:
        self.kind, self.name, self.known = kind, name, sorted(known)
        listing = ", ".join(self.known) if self.known else "(none)"
        super().__init__(f"unknown {kind} '{name}'. Known: {listing}")


class FileFormatError(SimtrackError):
    """A file that cannot be used: names the file, the field and the reason."""

    def __init__(self, path: str | Path, field: str, reason: str) -> None:
        self.path, self.field, self.reason = Path(path), field, reason
        where = f"{path}: {field}" if field else f"{path}"
        super().__init__(f"{where}: {reason}")


class MeshError(SimtrackError):
    """A mesh that is missing, empty, non-finite or without area."""

    def __init__(self, source: str | Path, reason: str) -> None:
        self.source, self.reason = str(source), reason
        super().__init__(f"mesh {source}: {reason}")


class InvalidValueError(SimtrackError, ValueError):
    """An argument or configuration value outside its domain."""

    def __init__(self, name: str, value: object, allowed: str) -> None:
        self.name, self.value, self.allowed = name, value, allowed
        super().__init__(f"{name} = {value!r} is not valid; allowed: {allowed}")


class RaycastError(SimtrackError):
    """Embree refused a call or could not be loaded."""


class RenderingError(SimtrackError):
    """No renderer could be created, or a rendering call failed."""


class OutputExistsError(SimtrackError):
    """The output folder exists and overwriting was not asked for."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        super().__init__(f"output folder {path} exists already; choose another --out or pass --overwrite")


class DatasetError(SimtrackError):
    """A data set's folder that cannot be written to or completed: names the folder and the reason."""

    def __init__(self, path: str | Path, reason: str) -> None:
        self.path, self.reason = Path(path), reason
        super().__init__(f"data set {path}: {reason}")


class QueryError(SimtrackError):
    """A scene-graph query that cannot be parsed or names unknown things."""


class StageError(SimtrackError):
    """A stage of somebody else's that cannot be loaded or built: names the stage, what was given, and the reason."""

    def __init__(self, stage: str, given: str, reason: str) -> None:
        self.stage, self.given, self.reason = stage, given, reason
        super().__init__(f"{stage} '{given}': {reason}")


def _raised_elsewhere(kind: type[SimtrackError], args: tuple[Any, ...], attributes: dict[str, Any]) -> SimtrackError:
    """An error as another process had it: its own constructor takes other arguments than the message."""
    error = kind.__new__(kind)
    error.args = args
    vars(error).update(attributes)
    return error
