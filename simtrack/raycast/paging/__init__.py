"""Worlds too large for one scene: regions, portals, an index of objects, and rays that find what they need live."""

from simtrack.raycast.paging.objects import EVERYWHERE, ObjectIndex
from simtrack.raycast.paging.regions import Regions
from simtrack.raycast.paging.scene import PagedHits, PagedScene, PagingConfig, PagingReport

__all__ = ["EVERYWHERE", "ObjectIndex", "PagedHits", "PagedScene", "PagingConfig", "PagingReport", "Regions"]
