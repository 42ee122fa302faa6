"""Coarse surfaces: planes keep their faces, their area and their place; small meshes stay as they are."""

import numpy as np

from simtrack.geometry.meshes import Mesh, area, box_mesh, subdivide_to
from simtrack.geometry.planes import detect_planes
from simtrack.perception.scene_graph.contact.coarse import coarse_surface


def test_planes_of_a_fine_mesh_keep_place_extent_and_area() -> None:
    mesh = subdivide_to(box_mesh([0.8, 0.5, 0.3]), 12_000)
    planes = detect_planes(mesh, np.random.default_rng(0))
    coarse, on_planes = coarse_surface(mesh, planes, limit=1200)
    assert len(planes) == len(on_planes) == 6
    assert 400 < len(coarse.faces) <= 1500
    for plane, faces in zip(planes, on_planes, strict=True):
        before, after = Mesh(mesh.vertices, mesh.faces[plane.faces]), Mesh(coarse.vertices, faces)
        assert np.abs(plane.distance(after.triangles.reshape(-1, 3))).max() < 1e-9
        assert 0.8 < area(after) / area(before) <= 1.05
        shrunk = np.ptp(before.triangles.reshape(-1, 3), axis=0) - np.ptp(after.triangles.reshape(-1, 3), axis=0)
        assert (shrunk > -1e-9).all() and (shrunk < 0.06).all()


def test_what_lies_on_no_plane_is_kept_too() -> None:
    mesh = subdivide_to(box_mesh([0.8, 0.5, 0.3]), 4000)
    coarse, on_planes = coarse_surface(mesh, (), limit=1000)
    assert on_planes == ()
    assert 0.75 < area(coarse) / area(mesh) <= 1.05


def test_a_small_mesh_is_taken_as_it_is() -> None:
    mesh = box_mesh([0.8, 0.5, 0.3])
    planes = detect_planes(mesh, np.random.default_rng(0))
    coarse, on_planes = coarse_surface(mesh, planes)
    assert coarse is mesh
    assert all(np.array_equal(faces, mesh.faces[p.faces]) for faces, p in zip(on_planes, planes, strict=True))
