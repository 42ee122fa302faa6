"""The shell of a room, floor, walls and ceiling, told from the geometry of a map.

Masks of stuff are the worst that panoptic networks draw, and its geometry is the plainest: large planes that the room
ends at. Which segments lie on such planes weighs in when it is told what they are (`JointCounts.entities`).
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from simtrack.contracts import Float64, Int32
from simtrack.errors import InvalidValueError
from simtrack.geometry.meshes import Mesh, face_areas, face_normals
from simtrack.geometry.planes import PlaneConfig, SurfacePlane, detect_planes


@dataclass(frozen=True, slots=True)
class ShellConfig:
    """Settings of `shell_labels`."""

    least_area: float = 1.0
    """Square metres of a plane of the shell."""
    near: float = 0.04
    """Metres off a plane within which surface lies on it."""
    level: float = 0.9
    """Smallest vertical part of the normal of floors and ceilings."""
    upright: float = 0.25
    """Largest of that of walls."""
    behind: float = 0.15
    """Metres behind a plane of the shell from which on there is nothing ..."""
    reach: float = 1.0
    """... up to so many, beside it as far as `behind`: next to a cabinet's front, the wall behind it is seen ..."""
    allowed: float = 0.1
    """... but for this share of its area."""
    share: float = 0.7
    """Share of the surface of a segment that must lie on planes of one kind."""
    weight: float = 3.0
    """How many times as much observations count that take a segment for what it lies on, and how many times less those
    that take it for stuff which it does not lie on."""
    sure_area: float = 3.0
    """Square metres of a segment on a plane of the shell that is larger than what hangs on walls: one observation that
    says so is enough there."""

    def __post_init__(self) -> None:
        for name in ("least_area", "near", "behind", "reach", "weight", "sure_area"):
            if not 0.0 < getattr(self, name) < 1e6:
                raise InvalidValueError(f"ShellConfig.{name}", getattr(self, name), "a finite number > 0")
        for name in ("level", "upright", "allowed", "share"):
            if not 0.0 < getattr(self, name) <= 1.0:
                raise InvalidValueError(f"ShellConfig.{name}", getattr(self, name), "a share, above 0, up to 1")


_PLANES = PlaneConfig(distance=0.03, samples=20000, min_fraction=0.02, min_share=0.004, max_planes=60)


@dataclass(frozen=True, slots=True)
class OnShell:
    """What of the shell a segment lies on."""

    kind: str
    """"floor", "wall", "ceiling", or "" where it lies on none."""
    weight: float
    """Of observations that say so, and one over that of observations of other stuff."""


_SURE = 1e6
"""Weight of an observation that is enough."""


def shell_labels(surface: Mesh, labels: Int32, config: ShellConfig | None = None) -> Mapping[int, OnShell]:
    """Which segments lie on the shell of a room.

    Args:
        surface: of a map, z up, faces counter-clockwise seen from the free side.
        labels: (F,) segment of each face, 0 = none.
        config: settings, the defaults if None.

    Returns:
        Segment -> what it lies on, for all that have surface.
    """
    config = config or ShellConfig()
    if not len(surface.faces):
        return {}
    areas, normals, centres = face_areas(surface), face_normals(surface), surface.triangles.mean(axis=1)
    planes = [
        (kind, plane)
        for plane in detect_planes(surface, np.random.default_rng(0), _PLANES, source="shell")
        if plane.area >= config.least_area
        for kind in [_kind(plane, config)]
        if kind and _ends(plane, centres, areas, config)
    ]
    size = int(labels.max()) + 1
    total = np.bincount(labels, areas, minlength=size)
    found = dict.fromkeys((np.flatnonzero(total[1:]) + 1).tolist(), OnShell("", config.weight))
    for kind in ("floor", "wall", "ceiling"):
        on = np.zeros(len(areas), bool)
        for _, plane in (each for each in planes if each[0] == kind):
            on |= (np.abs(plane.distance(centres)) <= config.near) & (normals @ plane.normal > 0.8)
        own = np.bincount(labels[on], areas[on], minlength=size)
        for label in np.flatnonzero(own[1:] > config.share * total[1:]).tolist():
            found[label + 1] = OnShell(kind, _SURE if own[label + 1] >= config.sure_area else config.weight)
    return found


def is_upright(surface: Mesh, classes: npt.NDArray[np.object_]) -> bool:
    """Whether the z axis of a map is up, by what was told to be floor, or wall where nothing was.

    The map of a camera whose poses nobody stated has the axes of its first image.

    Args:
        surface: of the map.
        classes: (F,) semantic class of each face, "" = none.
    """
    areas, up = face_areas(surface), face_normals(surface)[:, 2]
    for name, agrees in (("floor", up > 0.8), ("wall", np.abs(up) < 0.25)):
        own = classes == name
        if areas[own].sum() > 0.0:
            return bool(areas[own & agrees].sum() > 0.5 * areas[own].sum())
    return False


def _kind(plane: SurfacePlane, config: ShellConfig) -> str:
    up = float(plane.normal[2])
    if abs(up) < config.upright:
        return "wall"
    return "floor" if up > config.level else "ceiling" if up < -config.level else ""


def _ends(plane: SurfacePlane, centres: Float64, areas: Float64, config: ShellConfig) -> bool:
    """Whether the room ends at a plane: nothing was seen behind it."""
    off = plane.distance(centres)
    side = np.cross(plane.normal, (0.0, 0.0, 1.0) if abs(plane.normal[2]) < 0.5 else (1.0, 0.0, 0.0))
    frame = np.stack([side / np.linalg.norm(side), np.cross(plane.normal, side / np.linalg.norm(side))], axis=1)
    along = centres @ frame
    lowest, highest = along[plane.faces].min(axis=0), along[plane.faces].max(axis=0)
    beside = ((along > lowest - config.behind) & (along < highest + config.behind)).all(axis=1)
    hidden = beside & (off < -config.behind) & (off > -config.reach)
    return bool(areas[hidden].sum() <= config.allowed * plane.area)
