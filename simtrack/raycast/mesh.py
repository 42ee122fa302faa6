"""A triangle mesh with its bounding volume hierarchy, built once and shared by any number of instances."""

import weakref
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from simtrack.contracts import Float32
from simtrack.errors import MeshError
from simtrack.raycast import embree as rtc

if TYPE_CHECKING:
    from embreex.rtcore_scene import EmbreeScene

    from simtrack.raycast.topology import Topology
    from simtrack.raycast.tree import FaceTree


class TriangleMesh:
    """Triangles in their own frame with one Embree hierarchy, shareable between scenes and instances."""

    def __init__(self, vertices: npt.ArrayLike, faces: npt.ArrayLike, source: str = "TriangleMesh") -> None:
        """Copy and validate the mesh.

        Args:
            vertices: (V, 3), metres, mesh frame; kept as float32, which is what Embree traces.
            faces: (F, 3) indices into `vertices`; counter-clockwise seen from the side that normals point to.
            source: what an error message calls the mesh, e.g. its file.

        Raises:
            MeshError: empty, wrong shape, non-finite, index out of range, or no area at all.
        """
        corners, triangles = np.asarray(vertices), np.asarray(faces)
        _validate(corners, triangles, source)
        # Embree reads 16 bytes for each 12-byte vertex: one spare row keeps the last read inside the buffer.
        self._vertices = np.zeros((len(corners) + 1, 3), np.float32)
        self._vertices[:-1] = corners
        self._faces = np.ascontiguousarray(triangles, np.uint32)
        self.source = source

    @property
    def vertices(self) -> Float32:
        """(V, 3), metres, mesh frame."""
        return self._vertices[:-1]

    @property
    def faces(self) -> npt.NDArray[np.uint32]:
        """(F, 3), indices into `vertices`."""
        return self._faces

    @cached_property
    def bounding_sphere(self) -> tuple[npt.NDArray[np.float64], float]:
        """Centre (3,) and radius of a sphere around all vertices, mesh frame, metres."""
        low, high = self.vertices.min(0).astype(np.float64), self.vertices.max(0).astype(np.float64)
        centre = (low + high) / 2
        return centre, float(np.sqrt(((self.vertices - centre) ** 2).sum(1).max()))

    @cached_property
    def half_extents(self) -> npt.NDArray[np.float64]:
        """(3,) half the size of the box around all vertices, mesh frame, metres; `bounding_sphere` has its centre."""
        low, high = self.vertices.min(0).astype(np.float64), self.vertices.max(0).astype(np.float64)
        return (high - low) / 2

    @cached_property
    def topology(self) -> "Topology":
        """Which faces meet where, and whether they close the mesh."""
        from simtrack.raycast.topology import Topology

        return Topology.of(self.vertices, self.faces)

    @cached_property
    def tree(self) -> "FaceTree":
        """Boxes over the faces, for distances between meshes."""
        from simtrack.raycast.tree import FaceTree

        return FaceTree.of(self.vertices, self.faces)

    @cached_property
    def scene_handle(self) -> int:
        """Address of the committed RTCScene that holds this mesh (built at first use)."""
        device, api = rtc.embree().device, rtc.embree().api
        geometry = api.rtcNewGeometry(device, rtc.RTC_GEOMETRY_TYPE_TRIANGLE)
        rtc.embree().check("rtcNewGeometry")
        for kind, layout, data, count in (
            (rtc.RTC_BUFFER_TYPE_VERTEX, rtc.RTC_FORMAT_FLOAT3, self._vertices, len(self._vertices) - 1),
            (rtc.RTC_BUFFER_TYPE_INDEX, rtc.RTC_FORMAT_UINT3, self._faces, len(self._faces)),
        ):
            api.rtcSetSharedGeometryBuffer(geometry, kind, 0, layout, data.ctypes.data, 0, 12, count)
        api.rtcCommitGeometry(geometry)
        scene = api.rtcNewScene(device)
        api.rtcAttachGeometry(scene, geometry)
        api.rtcReleaseGeometry(geometry)
        # The hierarchy reads the arrays for as long as any instance keeps the scene, hence they go with the finalizer.
        weakref.finalize(self, _release_scene, scene, self._vertices, self._faces)
        api.rtcCommitScene(scene)
        rtc.embree().check(f"rtcCommitScene({self.source})")
        return scene

    @cached_property
    def embreex_scene(self) -> "EmbreeScene":
        """The same mesh as an `embreex` scene, for the fallback."""
        from embreex.mesh_construction import TriangleMesh as EmbreexMesh
        from embreex.rtcore_scene import EmbreeScene

        scene = EmbreeScene()
        EmbreexMesh(scene, np.ascontiguousarray(self.vertices), self._faces.astype(np.int32))
        return scene


def _release_scene(scene: int, *_kept_alive: object) -> None:
    rtc.embree().api.rtcReleaseScene(scene)


def _validate(vertices: np.ndarray, faces: np.ndarray, source: str) -> None:
    if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3:
        raise MeshError(source, f"vertices {vertices.shape} and faces {faces.shape} must be (V, 3) and (F, 3)")
    if not len(vertices) or not len(faces):
        raise MeshError(source, f"is empty ({len(vertices)} vertices, {len(faces)} faces)")
    if not np.issubdtype(faces.dtype, np.integer):
        raise MeshError(source, f"faces must be integers, not {faces.dtype}")
    if not np.isfinite(vertices).all():
        raise MeshError(source, f"vertex {int(np.flatnonzero(~np.isfinite(vertices).all(1))[0])} is not finite")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise MeshError(source, f"faces use indices {faces.min()}..{faces.max()}, valid are 0..{len(vertices) - 1}")
    for start in range(0, len(faces), 1024):
        a, b, c = (vertices[faces[start : start + 1024, corner]] for corner in range(3))
        if np.cross(b - a, c - a).any():
            return
    raise MeshError(source, "has no area: every triangle is degenerate")
