"""Worlds too large for one scene: regions, portals, an index of objects, and rays that find what they need live.

A world of one's own:

    regions = Regions(low, high, sides, centres, half_axes, is_open)  # rooms as boxes, doors as rectangles
    index = ObjectIndex.from_poses(regions, bounds, models, T_map_objects)  # walls and furniture are objects, too
    scene = PagedScene(index, meshes, PagingConfig(reach=30.0))
    scene.update(T_map_camera[:3, 3])  # once a frame
    hits = scene.cast(RayBundle.from_camera(intrinsics), T_map_camera)
    hits.distances, hits.objects  # metres along the optical axis, ids of the index
    scene.move(hits.objects[0], T_map_object)
"""

from simtrack.raycast.paging.live import PagedHits
from simtrack.raycast.paging.objects import EVERYWHERE, ObjectIndex
from simtrack.raycast.paging.regions import Regions
from simtrack.raycast.paging.scene import PagedScene, PagingConfig, PagingReport

__all__ = ["EVERYWHERE", "ObjectIndex", "PagedHits", "PagedScene", "PagingConfig", "PagingReport", "Regions"]
