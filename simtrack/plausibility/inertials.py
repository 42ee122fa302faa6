"""Masses and inertias that engines can use, in place of those that a file lacks or that cannot be true."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from simtrack.contracts import Float64
from simtrack.errors import MeshError
from simtrack.geometry.meshes import convex_hull, mass_properties
from simtrack.perception.reconstruction.body_tree import Shape
from simtrack.plausibility.verdict import Severity

HEAVIEST = 23_000.0
"""kg/m^3: no element is denser than osmium (22,590)."""
LIGHTEST = 1.0
"""kg/m^3: air weighs 1.2."""
SPREAD = 4.0
"""Times the mass on the farthest point of the body: no mass can lie farther out; some room for shapes left out."""

Find = Callable[[Severity, str, str, str], None]


@dataclass(frozen=True, slots=True)
class Inertial:
    """Mass properties of a body, frame of the body."""

    mass: float
    """Kilograms."""
    centre_of_mass: Float64
    """(3,), metres."""
    inertia: Float64
    """(3, 3), about the centre of mass, kg m^2."""


def credible_inertial(
    stated: Inertial | None, shapes: Sequence[Shape], name: str, moving: bool, movable: bool, find: Find
) -> Inertial:
    """The stated mass properties where they can be true, else those of the shapes, with a finding.

    Args:
        stated: what the file says; None if it says nothing.
        shapes: of the body.
        name: of the body.
        moving: whether a joint moves it, which needs mass.
        movable: whether it is a root, on a floating joint, or moved: whether its own inertia matters.
        find: called with (severity, kind, subject, message).
    """
    if stated is None or stated.mass == 0.0:
        if not moving:
            return Inertial(0.0, np.zeros(3), np.zeros((3, 3)))
        lack = "states no inertial" if stated is None else "has mass 0"
        find("problem", "zero-mass", name, f"a joint moves it, but it {lack}; taken as 1 kg")
        return _of_shapes(1.0, np.zeros(3), shapes)
    moments = np.linalg.eigvalsh(stated.inertia)
    replaced = _of_shapes(stated.mass, stated.centre_of_mass, shapes)
    if shapes:
        _check_density(stated.mass, shapes, name, find)
    if moments.max() <= 0.0:
        severity: Severity = "problem" if movable else "note"
        find(severity, "zero-inertia", name, f"{stated.mass:g} kg without inertia; taken from its shapes")
        return replaced
    if moments.min() <= 0.0 or moments[0] + moments[1] < moments[2] * (1.0 - 1e-6):
        listing = ", ".join(f"{moment:.3g}" for moment in moments)
        message = f"no body has the principal moments {listing} kg m^2; taken from its shapes"
        find("warning", "impossible-inertia", name, message)
        return replaced
    if shapes:
        points = np.concatenate([shape.corners() for shape in shapes]) - stated.centre_of_mass
        most = SPREAD * stated.mass * float((points**2).sum(axis=1).max())
        if moments.max() > most:
            message = f"a moment of {moments.max():.3g} kg m^2 is too large for its size; taken from its shapes"
            find("warning", "impossible-inertia", name, message)
            return replaced
    return stated


def _volume(shapes: Sequence[Shape]) -> float:
    return sum(mass_properties(convex_hull(shape.corners()), density=1.0)[0] for shape in shapes)


def _check_density(mass: float, shapes: Sequence[Shape], name: str, find: Find) -> None:
    try:
        density = mass / _volume(shapes)
    except MeshError:
        return
    if not LIGHTEST < density < HEAVIEST:
        find("warning", "absurd-mass", name, f"{mass:g} kg in its shapes are {density:.3g} kg/m^3")


def _of_shapes(mass: float, centre: Float64, shapes: Sequence[Shape]) -> Inertial:
    """Inertia of an even distribution over the hull of the shapes, about the stated centre of mass."""
    if shapes:
        try:
            _, middle, inertia = mass_properties(
                convex_hull(np.concatenate([shape.corners() for shape in shapes])), mass=mass
            )
            return Inertial(mass, centre if centre.any() else middle, inertia)
        except MeshError:
            pass
    return Inertial(mass, centre, 0.4 * mass * 0.05**2 * np.eye(3))  # a ball of 5 cm
