"""Maps made from measurements: the surface that scans and depth images saw, as a triangle mesh."""

from simtrack.perception.mapping.scan_mesh import ScanMeshConfig, mesh_of_depth, mesh_of_scan

__all__ = ["ScanMeshConfig", "mesh_of_depth", "mesh_of_scan"]
