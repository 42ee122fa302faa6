"""What a validation finds wrong, and how it reads files without ever failing on them."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError

from simtrack.contracts import Float64
from simtrack.errors import SimtrackError
from simtrack.geometry.transforms import is_rigid

MAX_SHOWN = 200
"""Digits and letters of a value in a finding."""
_T = TypeVar("_T")


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that is wrong."""

    file: str
    """Relative to the data set."""
    field: str
    """Place in the file, e.g. ``3.0.visib_fract``; empty for the file as a whole."""
    found: str
    expected: str

    def __str__(self) -> str:
        where = f"{self.file}: {self.field}" if self.field else self.file
        return f"{where}: found {self.found}, expected {self.expected}"


class Entry(BaseModel):
    """A part of a foreign document: known fields have to be right, others may be there."""

    model_config = ConfigDict(extra="ignore", strict=False, allow_inf_nan=False)


class Report:
    """Collects findings; paths are told relative to the data set."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.findings: list[Finding] = []
        self.files = 0
        """That were read."""

    def add(self, path: Path, field: str, found: object, expected: object) -> None:
        """Something is wrong."""
        name = path.relative_to(self.root).as_posix() if path.is_relative_to(self.root) else str(path)
        self.findings.append(Finding(name, field, _text(found), _text(expected)))

    def equal(self, path: Path, field: str, found: object, expected: object) -> bool:
        """Two values ought to be the same."""
        if found != expected:
            self.add(path, field, found, expected)
        return found == expected

    def near(self, path: Path, field: str, found: float, expected: float, tolerance: float) -> bool:
        """Two numbers ought to be the same but for rounding."""
        good = abs(found - expected) <= tolerance
        if not good:
            self.add(path, field, f"{found:.9g}", f"{expected:.9g} to within {tolerance:.3g}")
        return good

    def holds(self, condition: bool, path: Path, field: str, found: object, expected: object) -> bool:
        """A condition ought to be met."""
        if not condition:
            self.add(path, field, found, expected)
        return condition

    def rigid(self, path: Path, field: str, T: Float64) -> bool:
        """A (4, 4) matrix ought to be a rigid transform."""
        return self.holds(is_rigid(T, tolerance=1e-5), path, field, np.round(T[:3, :3], 6).tolist(), "a rotation")

    def read(self, path: Path, reader: Callable[[Path], _T]) -> _T | None:
        """What `reader` makes of a file; None, and a finding, where it cannot."""
        self.files += 1
        try:
            return reader(path)
        except SimtrackError as error:
            self.add(path, getattr(error, "field", ""), getattr(error, "reason", error), "a file that can be read")
        except (OSError, ValueError, KeyError, EOFError) as error:
            found = "no such file" if isinstance(error, FileNotFoundError) else f"{type(error).__name__}: {error}"
            self.add(path, "", found, "a file that can be read")
        return None

    def document(self, path: Path, kind: Any) -> Any | None:
        """A JSON file as the given type; None, and a finding for each field that is wrong."""
        data = self.read(path, lambda file: json.loads(file.read_text(encoding="utf-8")))
        return None if data is None else self.typed(path, data, kind)

    def typed(self, path: Path, data: object, kind: Any, prefix: str = "") -> Any | None:
        """Plain data as the given type; None, and a finding for each field that is wrong."""
        try:
            return TypeAdapter(kind).validate_python(data)
        except ValidationError as error:
            for problem in error.errors(include_url=False):
                place = ".".join((*([prefix] if prefix else []), *map(str, problem["loc"])))
                missing = problem["type"] == "missing"
                self.add(path, place, "nothing" if missing else problem["input"], problem["msg"])
            return None


def _text(value: object) -> str:
    text = value if isinstance(value, str) else json.dumps(value, default=str)
    return text if len(text) <= MAX_SHOWN else text[: MAX_SHOWN - 3] + "..."
