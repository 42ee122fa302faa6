"""Ray casting: Embree meshes, the scene of their instances, bundles of rays; closest points."""

from simtrack.raycast.bundle import RayBundle
from simtrack.raycast.hits import ClosestPoints, RayHits
from simtrack.raycast.mesh import TriangleMesh
from simtrack.raycast.scene import RayScene

__all__ = ["ClosestPoints", "RayBundle", "RayHits", "RayScene", "TriangleMesh"]
