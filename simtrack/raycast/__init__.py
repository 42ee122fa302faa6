"""Ray casting: Embree meshes, the scene of their instances, bundles of rays; closest points."""

import os

# Threads that wait for each other in a busy loop burn the core that the other stages need. OpenMP reads this once, when
# the first parallel kernel starts.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

from simtrack.raycast.bundle import RayBundle
from simtrack.raycast.hits import ClosestPoints, RayHits, SelectedHits
from simtrack.raycast.mesh import TriangleMesh
from simtrack.raycast.scene import RayScene

__all__ = ["ClosestPoints", "RayBundle", "RayHits", "RayScene", "SelectedHits", "TriangleMesh"]
