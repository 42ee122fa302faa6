"""Convex pieces of aligned models in the map: how much they overlap, and how high one comes to rest on another."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from simtrack.contracts import Float64
from simtrack.geometry.meshes import Mesh, transformed
from simtrack.perception.reconstruction.candidates import CadCandidate

COMPACT = 0.8
"""Share of its hull that the pieces of a compact solid fill."""
_CLOSE = 1e-6
"""Metres: pieces that overlap by less only touch."""


@dataclass(frozen=True, slots=True, eq=False)
class Solid:
    """What stands for an entity in physics: convex pieces in the map, at rest."""

    pieces: tuple[Float64, ...]
    """(K, 3) corners each."""
    low: Float64
    """(N, 3), lower corners of the boxes around the pieces."""
    high: Float64
    """(N, 3)."""

    @classmethod
    def of(cls, pieces: Sequence[Float64]) -> "Solid":
        """Of the corners of convex pieces, one or more."""
        low, high = (np.array([bound(piece, axis=0) for piece in pieces]) for bound in (np.min, np.max))
        return cls(tuple(pieces), low, high)

    @property
    def bottom(self) -> float:
        """Height of the lowest point, metres."""
        return float(self.low[:, 2].min())

    def moved(self, shift: Float64) -> "Solid":
        """The solid after a translation (3,)."""
        pieces = tuple(piece + shift for piece in self.pieces)
        return replace(self, pieces=pieces, low=self.low + shift, high=self.high + shift)


def convex_pieces(candidate: CadCandidate) -> list[tuple[str, Mesh]]:
    """(part, closed convex mesh in the map) of an aligned model at its joint positions."""
    poses = candidate.model.part_poses(candidate.positions)
    return [
        (part.name, transformed(convex, candidate.T_map_scaled @ poses[part.name]))
        for part in candidate.model.parts
        for convex in part.convex
    ]


def solid_of(candidate: CadCandidate) -> Solid:
    """The pieces of an aligned model."""
    return Solid.of([mesh.vertices for _, mesh in convex_pieces(candidate)])


def compacted(solid: Solid) -> Solid:
    """The hull of a solid that nearly fills it, as a pile of books: what is in it has to come out of all of it."""
    if len(solid.pieces) == 1:
        return solid
    everything = np.concatenate(solid.pieces)
    filled = sum(float(_manifold(piece).volume()) for piece in solid.pieces)
    return Solid.of([everything]) if filled > COMPACT * float(_manifold(everything).volume()) else solid


def overlap(first: Solid, second: Solid) -> tuple[float, float]:
    """Vol(M1 and M2) in cubic metres, and about how deep they are in each other, metres.

    The depth is the smallest side of the box around the largest common piece. Where pieces of one solid overlap, what
    they share counts twice.
    """
    gap = np.maximum(first.low[:, None] - second.high[None], second.low[None] - first.high[:, None]).max(axis=2)
    total, largest, depth = 0.0, 0.0, 0.0
    for i, j in np.argwhere(gap < -_CLOSE).tolist():
        common = _manifold(first.pieces[i]) ^ _manifold(second.pieces[j])
        volume = float(common.volume())
        if volume <= 0.0:
            continue
        total += volume
        if volume > largest:
            box = np.array(common.bounding_box())
            largest, depth = volume, float((box[3:] - box[:3]).min())
    return total, depth


def depth_along(first: Solid, second: Solid, direction: Float64) -> float:
    """Largest extent of a common piece of two solids along a unit vector (3,), metres; 0 if they are apart."""
    gap = np.maximum(first.low[:, None] - second.high[None], second.low[None] - first.high[:, None]).max(axis=2)
    deepest = 0.0
    for i, j in np.argwhere(gap < -_CLOSE).tolist():
        common = (_manifold(first.pieces[i]) ^ _manifold(second.pieces[j])).to_mesh64()
        if len(common.tri_verts):
            deepest = max(deepest, float(np.ptp(np.asarray(common.vert_properties)[:, :3] @ direction)))
    return deepest


class _Key:
    """An array as a key of a cache, by identity; keeps it alive."""

    __slots__ = ("array",)

    def __init__(self, array: Float64) -> None:
        self.array = array

    def __hash__(self) -> int:
        return id(self.array)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Key) and other.array is self.array


@lru_cache(maxsize=20_000)
def _hull(key: _Key) -> Any:
    import manifold3d

    return manifold3d.Manifold.hull_points(np.ascontiguousarray(key.array))


def _manifold(piece: Float64) -> Any:
    return _hull(_Key(piece))


def rise(upper: Float64, lower: Float64) -> float | None:
    """Vertical translation, metres, after which one convex piece just stands on the other; None if it passes by.

    The maximum of z_l - z_u over points (x, y, z_u) of the upper and (x, y, z_l) of the lower piece: a linear program
    over the weights of their corners ((K, 3) and (L, 3)).
    """
    most = float(lower[:, 2].max() - upper[:, 2].min())
    if _meet(lower[lower[:, 2] > lower[:, 2].max() - _CLOSE], upper[upper[:, 2] < upper[:, 2].min() + _CLOSE]):
        return most  # the usual case: a level bottom over a level top
    from scipy.optimize import linprog

    corners = np.concatenate([upper, lower])
    first = np.arange(len(corners)) < len(upper)
    sign = np.where(first, 1.0, -1.0)
    equal = np.stack([sign * corners[:, 0], sign * corners[:, 1], first, ~first]).astype(float)
    found = linprog(sign * corners[:, 2], A_eq=equal, b_eq=[0.0, 0.0, 1.0, 1.0], method="highs")
    return -float(found.fun) if found.status == 0 else None


def _meet(first: Float64, second: Float64) -> bool:
    """Whether the convex hulls of the x, y of points have a point in common."""
    if (np.maximum(first.min(axis=0), second.min(axis=0)) > np.minimum(first.max(axis=0), second.max(axis=0)))[
        :2
    ].any():
        return False
    from shapely import MultiPoint

    return bool(MultiPoint(first[:, :2]).convex_hull.intersects(MultiPoint(second[:, :2]).convex_hull))


def resting_rise(upper: Solid, lower: Mapping[str, Solid], window: tuple[float, float]) -> float | None:
    """Vertical translation after which a solid rests on the highest of the solids below it; None if on none.

    Args:
        upper: what rests.
        lower: what it may rest on.
        window: metres, lowest and highest translation. Pieces that would need more are beside it or above it.
    """
    best: float | None = None
    for solid in lower.values():
        sides = np.maximum(
            upper.low[:, None, :2] - solid.high[None, :, :2], solid.low[None, :, :2] - upper.high[:, None, :2]
        )
        beside = sides.max(axis=2) > -_CLOSE
        most = solid.high[None, :, 2] - upper.low[:, None, 2]  # a bound on the rise
        for i, j in sorted(np.argwhere(~beside).tolist(), key=lambda pair: -most[pair[0], pair[1]]):
            if most[i, j] < (window[0] if best is None else best):
                break
            needed = rise(upper.pieces[i], solid.pieces[j])
            if needed is not None and window[0] <= needed <= window[1] and (best is None or needed > best):
                best = needed
    return best
