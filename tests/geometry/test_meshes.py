"""Laws of meshes: masses, tessellation, sampling, reading."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from simtrack.errors import InvalidValueError, MeshError
from simtrack.geometry import meshes
from simtrack.geometry.meshes import Mesh
from simtrack.geometry.transforms import exp_so3, transform

sizes = arrays(np.float64, 3, elements=st.floats(0.01, 2.0))
rotation_vectors = arrays(np.float64, 3, elements=st.floats(-2.0, 2.0))
offsets = arrays(np.float64, 3, elements=st.floats(-5.0, 5.0))


def two_colored_box() -> Mesh:
    colors = np.repeat([[255, 0, 0], [0, 0, 255]], 6, axis=0)
    return Mesh(meshes.box_mesh((0.2, 0.1, 0.3)).vertices, meshes.box_mesh((0.2, 0.1, 0.3)).faces, colors)


@given(sizes)
def test_box_has_the_area_and_volume_of_a_box(size: np.ndarray) -> None:
    box = meshes.box_mesh(size)
    x, y, z = size
    assert meshes.is_closed(box)
    np.testing.assert_allclose(meshes.volume(box), x * y * z, rtol=1e-12)
    np.testing.assert_allclose(meshes.area(box), 2 * (x * y + y * z + z * x), rtol=1e-12)
    np.testing.assert_allclose(box.extents, size, rtol=1e-12)
    np.testing.assert_allclose(meshes.diameter(box), np.linalg.norm(size), rtol=1e-12)


@given(st.floats(0.01, 1.0), st.floats(0.01, 1.0), st.integers(3, 64))
def test_cylinder_is_a_closed_prism(radius: float, height: float, segments: int) -> None:
    mesh = meshes.cylinder_mesh(radius, height, segments)
    polygon = 0.5 * segments * radius**2 * np.sin(2 * np.pi / segments)
    assert meshes.is_closed(mesh)
    np.testing.assert_allclose(meshes.volume(mesh), polygon * height, rtol=1e-9)


@given(sizes, rotation_vectors, offsets)
def test_mass_properties_of_a_box_anywhere(size: np.ndarray, phi: np.ndarray, offset: np.ndarray) -> None:
    T = transform(exp_so3(phi), offset)
    mass, centre, inertia = meshes.mass_properties(meshes.transformed(meshes.box_mesh(size), T), mass=2.0)
    expected = 2.0 / 12.0 * np.diag((size**2).sum() - size**2)
    assert mass == pytest.approx(2.0)
    np.testing.assert_allclose(centre, offset, atol=1e-9)
    np.testing.assert_allclose(inertia, T[:3, :3] @ expected @ T[:3, :3].T, atol=1e-9)


def test_mass_follows_density_and_agrees_with_trimesh() -> None:
    torus = trimesh.creation.torus(0.1, 0.03)
    mesh = Mesh(np.asarray(torus.vertices), np.asarray(torus.faces, np.int32))
    torus.density = 700.0
    mass, centre, inertia = meshes.mass_properties(mesh, density=700.0)
    assert mass == pytest.approx(torus.mass)
    np.testing.assert_allclose(centre, torus.center_mass, atol=1e-12)
    np.testing.assert_allclose(inertia, torus.moment_inertia, atol=1e-9)


def test_mass_properties_refuse_what_they_cannot_weigh() -> None:
    box = meshes.box_mesh((1, 1, 1))
    with pytest.raises(MeshError, match="open"):
        meshes.mass_properties(Mesh(box.vertices, box.faces[:-1]), mass=1.0)
    with pytest.raises(MeshError, match="wind outwards"):
        meshes.mass_properties(Mesh(box.vertices, box.faces[:, ::-1]), mass=1.0)
    for mass, density in ((None, None), (1.0, 1.0), (-1.0, None), (None, np.nan)):
        with pytest.raises(InvalidValueError, match="exactly one"):
            meshes.mass_properties(box, mass=mass, density=density)


@given(rotation_vectors, offsets, st.booleans())
def test_moved_meshes_keep_outside_outside(phi: np.ndarray, offset: np.ndarray, mirrored: bool) -> None:
    T = transform(exp_so3(phi), offset) @ np.diag([-1.0 if mirrored else 1.0, 1.0, 1.0, 1.0])
    box = meshes.box_mesh((0.1, 0.2, 0.3))
    moved = meshes.transformed(box, T)
    assert meshes.is_closed(moved)
    np.testing.assert_allclose(meshes.volume(moved), meshes.volume(box), rtol=1e-6)


@given(st.integers(0, 3000))
@settings(max_examples=25)
def test_subdivision_keeps_the_surface_and_reaches_the_count(faces: int) -> None:
    box = two_colored_box()
    fine = meshes.subdivide_to(box, faces)
    assert len(fine.faces) == max(len(box.faces), faces - faces % 2)
    assert meshes.is_closed(fine)
    np.testing.assert_allclose(meshes.volume(fine), meshes.volume(box), rtol=1e-12)
    np.testing.assert_allclose(meshes.area(fine), meshes.area(box), rtol=1e-12)
    for (color, part), (same, original) in zip(meshes.split_by_color(fine), meshes.split_by_color(box), strict=True):
        assert color == same
        np.testing.assert_allclose(meshes.area(part), meshes.area(original), rtol=1e-12)


def test_subdivision_of_an_open_mesh_reaches_odd_counts_and_evens_out() -> None:
    triangle = Mesh(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2]], np.int32))
    fine = meshes.subdivide_to(triangle, 1001)
    areas = meshes.face_areas(fine)
    assert len(fine.faces) == 1001
    assert areas.max() / areas.min() < 8.0
    np.testing.assert_allclose(areas.sum(), 0.5)


def test_decimation_keeps_a_shape_and_its_colors() -> None:
    fine = meshes.subdivide_to(two_colored_box(), 4000)
    light = meshes.decimate(fine, 200)
    assert 100 <= len(light.faces) <= 210
    np.testing.assert_allclose(meshes.volume(light), meshes.volume(fine), rtol=0.02)
    areas = {color: meshes.area(part) for color, part in meshes.split_by_color(fine)}
    for color, part in meshes.split_by_color(light):
        assert meshes.area(part) == pytest.approx(areas[color], rel=0.15)
    assert meshes.decimate(fine, len(fine.faces)) is fine


def test_samples_lie_on_the_surface_in_proportion_to_area() -> None:
    box = meshes.box_mesh((1.0, 0.5, 0.25))
    points, faces = meshes.sample_surface(box, 20_000, np.random.default_rng(1))
    offsets = np.einsum("ij,ij->i", points - box.triangles[faces, 0], meshes.face_normals(box)[faces])
    np.testing.assert_allclose(offsets, 0.0, atol=1e-12)
    share = np.bincount(faces, minlength=len(box.faces)) / len(faces)
    np.testing.assert_allclose(share, meshes.face_areas(box) / meshes.area(box), atol=0.012)
    again, _ = meshes.sample_surface(box, 20_000, np.random.default_rng(1))
    np.testing.assert_array_equal(points, again)


def test_vertex_normals_of_a_ball_point_outwards() -> None:
    ball = trimesh.creation.icosphere(3, 0.2)
    mesh = Mesh(np.asarray(ball.vertices), np.asarray(ball.faces, np.int32))
    cosines = np.einsum("ij,ij->i", meshes.vertex_normals(mesh), mesh.vertices / 0.2)
    assert cosines.min() > 0.999


@given(arrays(np.float64, (40, 3), elements=st.floats(-1.0, 1.0), unique=True))
@settings(max_examples=30)
def test_hull_holds_its_points_and_diameter_is_the_largest_distance(points: np.ndarray) -> None:
    hull = meshes.convex_hull(points)
    assert meshes.is_closed(hull)
    outside = np.einsum("fd,nd->fn", meshes.face_normals(hull), points)
    outside -= np.einsum("fd,fd->f", meshes.face_normals(hull), hull.triangles[:, 0])[:, None]
    assert outside[meshes.face_areas(hull) > 1e-9].max() < 1e-6
    expected = np.linalg.norm(points[:, None] - points, axis=2).max()
    many = Mesh(np.repeat(points, 20, axis=0), np.array([[0, 20, 40]], np.int32))
    assert meshes.diameter(many) == pytest.approx(expected, abs=1e-9)


def test_hull_of_a_flat_set_is_an_error() -> None:
    with pytest.raises(MeshError, match="one plane"):
        meshes.convex_hull(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]))


def test_concatenation_keeps_faces_and_colors_apart() -> None:
    red, plain = two_colored_box(), meshes.box_mesh((0.1, 0.1, 0.1))
    both = meshes.concatenate([red, plain])
    assert len(both.faces) == 24 and both.face_colors is not None
    np.testing.assert_allclose(meshes.volume(both), meshes.volume(red) + meshes.volume(plain))
    assert meshes.concatenate([plain, plain]).face_colors is None
    assert len(meshes.concatenate([]).faces) == 0


def test_arrays_of_the_wrong_shape_are_refused() -> None:
    with pytest.raises(InvalidValueError, match="face_colors"):
        Mesh(np.zeros((3, 3)), np.array([[0, 1, 2]], np.int32), np.zeros((2, 3), np.uint8))


@pytest.mark.parametrize(
    ("mesh", "reason"),
    [
        (Mesh(np.empty((0, 3)), np.empty((0, 3), np.int32)), "empty"),
        (Mesh(np.array([[0.0, 0, 0], [np.nan, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2]], np.int32)), "not finite"),
        (Mesh(np.zeros((3, 3)), np.array([[0, 1, 2]], np.int32)), "zero area"),
        (Mesh(np.eye(3), np.array([[0, 1, 3]], np.int32)), "outside 0..2"),
    ],
)
def test_unusable_meshes_are_named(mesh: Mesh, reason: str) -> None:
    with pytest.raises(MeshError, match=r"(?s)thing\.ply.*" + reason):
        meshes.validate(mesh, "thing.ply")


@pytest.mark.parametrize("suffix", meshes.MESH_SUFFIXES)
def test_files_come_back_as_they_went(suffix: str, tmp_path: Path) -> None:
    mesh = two_colored_box()
    file = tmp_path / f"box{suffix}"
    trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(file)
    loaded = meshes.load_mesh(file)
    assert len(loaded.vertices) == 8 and meshes.is_closed(loaded)
    np.testing.assert_allclose(meshes.volume(loaded), meshes.volume(mesh), rtol=1e-6)


def test_face_colors_survive_a_file(tmp_path: Path) -> None:
    mesh = two_colored_box()
    trimesh.Trimesh(mesh.vertices, mesh.faces, face_colors=mesh.face_colors, process=False).export(tmp_path / "box.ply")
    colors = [color for color, _ in meshes.split_by_color(meshes.load_mesh(tmp_path / "box.ply"))]
    assert colors == [(0, 0, 255), (255, 0, 0)]


def test_missing_unknown_and_oversized_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(MeshError, match="no such file"):
        meshes.load_mesh(tmp_path / "none.ply")
    (tmp_path / "thing.exe").write_bytes(b"MZ")
    with pytest.raises(MeshError, match=r"unknown kind '\.exe'; known: \.ply"):
        meshes.load_mesh(tmp_path / "thing.exe")
    (tmp_path / "large.ply").write_bytes(b"ply\n" * 100)
    monkeypatch.setattr(meshes, "MAX_FILE_BYTES", 100)
    with pytest.raises(MeshError, match="larger than"):
        meshes.load_mesh(tmp_path / "large.ply")


@given(st.sampled_from(meshes.MESH_SUFFIXES), st.binary(max_size=200), st.booleans(), st.integers(0, 700))
@settings(max_examples=80)
def test_damaged_files_are_mesh_errors(
    tmp_path_factory: pytest.TempPathFactory, suffix: str, noise: bytes, head: bool, cut: int
) -> None:
    good = trimesh.creation.box((1, 1, 1)).export(file_type=suffix[1:])
    good = good.encode() if isinstance(good, str) else good
    file = tmp_path_factory.mktemp("damaged") / f"mesh{suffix}"
    file.write_bytes(good[:cut] + noise if head else noise)
    try:
        mesh = meshes.load_mesh(file)
    except MeshError as error:
        assert "mesh" in str(error) and suffix in str(error)
    else:
        meshes.validate(mesh, file)


def test_meshes_can_be_decimated_by_several_threads() -> None:
    round_ones = [trimesh.creation.icosphere(subdivisions=k) for k in (3, 4, 5)] * 3
    spheres = [Mesh(np.asarray(s.vertices, np.float64), np.asarray(s.faces, np.int32)) for s in round_ones]
    alone = [meshes.decimate(sphere, len(sphere.faces) // 2) for sphere in spheres]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(lambda sphere: meshes.decimate(sphere, len(sphere.faces) // 2), spheres))
    for one, other in zip(alone, together, strict=True):
        np.testing.assert_array_equal(one.vertices, other.vertices)
        np.testing.assert_array_equal(one.faces, other.faces)
