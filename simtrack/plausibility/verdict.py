"""What a check is asked to allow, what it finds, and what follows from it."""

from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np

from simtrack.errors import InvalidValueError

Severity: TypeAlias = Literal["note", "warning", "problem", "unreadable"]
SEVERITIES: tuple[Severity, ...] = ("note", "warning", "problem", "unreadable")
"""A problem makes a scene not plausible; what is unreadable cannot be judged."""
Verdict: TypeAlias = Literal["plausible", "not plausible", "unreadable"]
EXIT_CODES: dict[Verdict, int] = {"plausible": 0, "not plausible": 1, "unreadable": 2}


@dataclass(frozen=True, slots=True)
class CheckConfig:
    """What counts as plausible, and how long it is tried."""

    duration: float = 5.0
    """Seconds that the scene settles under gravity."""
    drift: float = 0.02
    """Metres that the centre of mass of a free body may move."""
    tilt: float = np.deg2rad(5.0)
    """Radians that a free body may turn away from the vertical."""
    toppled: float = np.deg2rad(45.0)
    """Radians of tilt from which a body counts as toppled."""
    penetration: float = 0.005
    """Metres that bodies may overlap, before and after settling."""
    gap: float = 0.005
    """Metres that a free body may float above what it rests on."""
    sweep_steps: int = 12
    """Positions in which a joint is tried from one limit to the other."""
    sweep_penetration: float = 0.01
    """Metres that a moved part may enter others beyond what it does at rest."""
    least_range: float = 0.1
    """Share of its range that a joint must be able to reach before it meets a part of its own object."""

    def __post_init__(self) -> None:
        for name in ("duration", "drift", "tilt", "toppled", "penetration", "gap", "sweep_penetration"):
            if not 0.0 < getattr(self, name) <= 1000.0:
                raise InvalidValueError(f"CheckConfig.{name}", getattr(self, name), "above 0, at most 1000")
        if not 2 <= self.sweep_steps <= 1000:
            raise InvalidValueError("CheckConfig.sweep_steps", self.sweep_steps, "2 to 1000")


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing to be said about a file or a body."""

    severity: Severity
    kind: str
    """What it is about, e.g. ``missing-mesh``; the same for all of its kind."""
    subject: str
    """Body, joint or file; empty for the whole."""
    message: str

    def __str__(self) -> str:
        where = f"{self.subject}: " if self.subject else ""
        return f"{self.severity}: {where}{self.message} [{self.kind}]"


@dataclass(frozen=True, slots=True)
class BodyResult:
    """How a component fared while it settled; named after its root body. Margins of the engine are subtracted."""

    name: str
    support: str | None
    """What it rests on, as the file says."""
    static: bool
    drift: float
    """Metres that its centre of mass moved."""
    tilt: float
    """Radians that it turned away from the vertical; turns about the vertical do not count."""
    penetration_start: float
    """Metres, deepest overlap with another object; 0 for none."""
    penetration_end: float
    gap: float | None
    """Metres to what is below (or nearest) at the start; None if nothing is near."""
    resting: bool
    """Whether it had come to rest at the end."""
    problems: tuple[str, ...]
    """Kinds of findings against it: drifted, tilted, toppled, fell, floating, penetrating."""


@dataclass(frozen=True, slots=True)
class JointResult:
    """How a joint fared when it was moved through its range."""

    name: str
    body: str
    lower: float
    upper: float
    reached: float
    """Share of the range that is free of collision, going out from the rest position; 1 for all of it."""
    reached_alone: float
    """The same if nothing stood there but the object that the joint belongs to."""
    blocked_by: str | None
    """First body that the moved part enters."""
    depth: float
    """Metres, deepest overlap beyond that at rest, within the range."""
    follows: float
    """Metres by which the engine's pose of the body differs from the described one, at worst."""
    problems: tuple[str, ...]
    """Kinds of findings against it: drives-into-body, unreachable, astray."""


@dataclass(frozen=True, slots=True)
class EngineResult:
    """What one engine says."""

    engine: str
    version: str
    margin: float
    """Metres that the engine's shapes are thicker than drawn, a side; subtracted."""
    bodies: tuple[BodyResult, ...]
    joints: tuple[JointResult, ...]
    plausible: bool
    inside: tuple[tuple[str, str, float], ...] = ()
    """Objects of one component that are in each other, and how deep, metres: they cannot give way."""


@dataclass(frozen=True, slots=True)
class CheckReport:
    """The outcome of a check."""

    file: str
    verdict: Verdict
    findings: tuple[Finding, ...]
    engines: tuple[EngineResult, ...]
    """pybullet first; engines that failed are missing, and a finding says so."""
    agreement: float | None
    """Share of free bodies on whose verdict both engines agree; None without two engines."""
    config: CheckConfig

    @property
    def exit_code(self) -> int:
        """0 plausible, 1 not, 2 unreadable."""
        return EXIT_CODES[self.verdict]

    def engine(self, name: str) -> EngineResult | None:
        """What the named engine says, if it ran."""
        return next((result for result in self.engines if result.engine == name), None)


def result_from_json(document: dict[str, Any]) -> EngineResult:
    """Inverse of `dataclasses.asdict` of an `EngineResult`, through JSON."""
    bodies = tuple(BodyResult(**{**row, "problems": tuple(row["problems"])}) for row in document["bodies"])
    joints = tuple(JointResult(**{**row, "problems": tuple(row["problems"])}) for row in document["joints"])
    inside = tuple((a, b, float(depth)) for a, b, depth in document["inside"])
    return EngineResult(**{**document, "bodies": bodies, "joints": joints, "inside": inside})
