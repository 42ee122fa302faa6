"""Surfaces as evenly spread points with normals, and which points of a model belong to points of an entity.

Points correspond where they lie close and face the same way: a front does not answer for the back behind it. Distance
and angle are one Euclidean distance in six dimensions, so a k-d tree finds the nearest.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from simtrack.contracts import Float64, Int32
from simtrack.geometry.meshes import Mesh, face_normals, sample_surface
from simtrack.objects.cad import CadModel

if TYPE_CHECKING:
    from simtrack.raycast import TriangleMesh

FACING = 0.05
"""What a difference of normals (of length 0 to 2) counts for, in diagonals of the box."""
TOLERANCE = 0.2
"""Share by which a counterpart may be farther than the nearest."""


@dataclass(frozen=True, slots=True, eq=False)
class SurfacePoints:
    """Points spread over a surface by area."""

    points: Float64
    """(N, 3), metres."""
    normals: Float64
    """(N, 3), unit, outwards."""

    @staticmethod
    def of(mesh: Mesh, count: int, seed: int = 0) -> "SurfacePoints":
        """`count` points of a mesh; the same mesh gives the same ones."""
        points, faces = sample_surface(mesh, count, np.random.default_rng(seed))
        return SurfacePoints(points, face_normals(mesh)[faces])


@dataclass(frozen=True, eq=False)
class ModelSurface:
    """A model at joint positions as points and as triangles, model frame, not scaled."""

    model: CadModel
    samples: SurfacePoints
    positions: Mapping[str, float] = field(default_factory=dict)

    @cached_property
    def facing(self) -> float:
        """Metres that stand for a difference of normals of length 1."""
        return FACING * float(np.linalg.norm(self.model.extents))

    @cached_property
    def _tree(self) -> Any:
        from scipy.spatial import KDTree

        return KDTree(np.concatenate([self.samples.points, self.facing * self.samples.normals], axis=1))

    @cached_property
    def triangles(self) -> "TriangleMesh":
        """The mesh for queries of closest points."""
        from simtrack.raycast import TriangleMesh

        mesh = self.model.mesh(self.positions)
        return TriangleMesh(mesh.vertices, mesh.faces, self.model.name)

    def corresponding(self, points: Float64, normals: Float64) -> tuple[Int32, Float64]:
        """Samples that lie nearest to (N, 3) points and face their way, and (N,) distances in the six dimensions."""
        distances, index = self._tree.query(np.concatenate([points, self.facing * normals], axis=1), eps=TOLERANCE)
        return index.astype(np.int32), distances

    def at(self, positions: Mapping[str, float]) -> "ModelSurface":
        """The model at other joint positions, as many points."""
        return _posed(self.model, len(self.samples.points), tuple(sorted(positions.items())))


def model_surface(model: CadModel, count: int) -> ModelSurface:
    """The model with its joints at 0; made once."""
    return _posed(model, count, ())


@lru_cache(maxsize=1024)
def _posed(model: CadModel, count: int, positions: tuple[tuple[str, float], ...]) -> ModelSurface:
    given = dict(positions)
    return ModelSurface(model, SurfacePoints.of(model.mesh(given), count), given)
