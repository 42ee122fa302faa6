"""Ray casting against oracles: baked meshes, MuJoCo's rays, the fallback."""

import os
import subprocess
import sys
import threading

import numba
import numpy as np
import pytest
import trimesh

from simtrack.contracts import CameraIntrinsics
from simtrack.errors import InvalidValueError, MeshError, RaycastError
from simtrack.geometry.transforms import exp_so3, look_at, transform
from simtrack.raycast import RayBundle, RayHits, RayScene, TriangleMesh
from simtrack.raycast import embree as rtc

CAMERA = CameraIntrinsics(64, 48, 60.0, 60.0, 31.5, 23.5)
BALL = trimesh.creation.icosphere(subdivisions=3, radius=0.5)
BOX = trimesh.creation.box((0.6, 0.4, 0.8))


def shape(mesh: trimesh.Trimesh) -> TriangleMesh:
    return TriangleMesh(mesh.vertices, mesh.faces)


def affine(kind: str) -> np.ndarray:
    T = transform(exp_so3(np.array([0.3, -0.8, 0.5])), (0.2, -0.1, 0.3))
    scale = {"rigid": (1, 1, 1), "scaled": (2, 0.5, 1.3), "mirrored": (-1, 1, 1), "mirrored-scaled": (0.7, -1.6, 1.1)}[
        kind
    ]
    T[:3, :3] = T[:3, :3] @ np.diag(scale) @ exp_so3(np.array([0.4, 0.1, 0.0]))
    return T


def random_rays(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    origins = rng.normal(size=(count, 3))
    origins *= 3 / np.linalg.norm(origins, axis=1, keepdims=True)
    directions = rng.normal(scale=0.4, size=(count, 3)) - origins
    return origins, directions


def assert_same_hits(a: RayHits, b: RayHits, atol: float = 2e-5) -> None:
    agree = a.instances == b.instances
    assert agree.mean() > 0.998  # single rays may graze a silhouette
    hit = agree & a.hit
    near = np.abs(a.distances[hit] - b.distances[hit]) < atol
    assert near.mean() > 0.998
    same_face = (a.faces[hit] == b.faces[hit]) & near
    assert same_face.mean() > 0.99  # a ray through an edge may be given to either face
    np.testing.assert_allclose(a.normals[hit][same_face], b.normals[hit][same_face], atol=2e-5)


@pytest.mark.parametrize("kind", ["rigid", "scaled", "mirrored", "mirrored-scaled"])
@pytest.mark.parametrize("use_fallback", [False, True])
def test_an_instance_casts_like_the_baked_mesh(kind: str, use_fallback: bool) -> None:
    T = affine(kind)
    baked = BOX.copy().apply_transform(T)  # trimesh flips the faces of a mirrored mesh: the outside stays outside
    origins, directions = random_rays(2000)
    with RayScene(use_fallback=use_fallback) as scene, RayScene(use_fallback=False) as oracle:
        scene.add(shape(BALL), transform(translation=(0.5, 0.5, 0.0)))
        scene.add(shape(BOX), T)
        oracle.add(shape(BALL), transform(translation=(0.5, 0.5, 0.0)))
        oracle.add(shape(baked))
        hits, expected = scene.cast_rays(origins, directions), oracle.cast_rays(origins, directions)
    assert expected.hit.mean() > 0.3
    assert_same_hits(hits, expected)
    seen = np.einsum("ij,ij->i", hits.normals[hits.hit], directions[hits.hit])
    assert (seen < 1e-4).all()  # closed meshes seen from outside: normals face the ray, mirrored or not


def test_embree_equals_mujoco_rays() -> None:
    import mujoco

    mesh = trimesh.creation.icosphere(subdivisions=2, radius=0.5)
    spec = mujoco.MjSpec()
    spec.add_mesh(name="ball", uservert=mesh.vertices.ravel(), userface=mesh.faces.ravel().astype(np.int32))
    rotation = exp_so3(np.array([0.2, 0.5, -0.3]))
    wxyz = np.empty(4)
    mujoco.mju_mat2Quat(wxyz, rotation.ravel())
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="ball", pos=(0.3, 0.1, 0.2), quat=wxyz)
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=(0.3, 0.2, 0.4), pos=(-0.6, 0.2, 0.0))
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    rng = np.random.default_rng(1)
    origin = np.array([0.1, -3.0, 0.2])
    directions = rng.normal((0, 1, 0), 0.25, (3000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    geoms, distances = np.zeros(3000, np.int32), np.zeros(3000)
    normals = np.zeros(9000)
    mujoco.mj_multiRay(model, data, origin, directions.ravel(), None, True, -1, geoms, distances, normals, 3000, 100.0)
    with RayScene() as scene:
        scene.add(shape(mesh), transform(rotation, (0.3, 0.1, 0.2)))
        scene.add(shape(trimesh.creation.box((0.6, 0.4, 0.8))), transform(translation=(-0.6, 0.2, 0.0)))
        hits = scene.cast(RayBundle.from_directions(directions), transform(translation=origin))
    agree = hits.instances == geoms
    assert agree.mean() > 0.998
    hit = agree & hits.hit
    np.testing.assert_allclose(hits.distances[hit], distances[hit], atol=1e-5)
    close = np.einsum("ij,ij->i", hits.normals[hit], normals.reshape(-1, 3)[hit]) > 0.9999
    assert close.mean() > 0.99


def test_depth_along_z_one_rays_is_depth_along_the_optical_axis() -> None:
    with RayScene() as scene:
        scene.add(shape(trimesh.creation.box((20, 20, 0.1))), transform(translation=(0, 0, 2.05)))
        bundle = RayBundle.from_camera(CAMERA)
        hits = scene.cast(bundle, np.eye(4))
    assert bundle.shape == (48, 64)
    np.testing.assert_allclose(hits.distances, 2.0, atol=1e-5)
    np.testing.assert_allclose(hits.normals, np.tile([0, 0, -1], (len(bundle), 1)), atol=1e-6)


@pytest.mark.parametrize("width", [8, 16])
def test_both_packet_widths_give_the_same(width: int, monkeypatch: pytest.MonkeyPatch) -> None:
    T = look_at(np.array([2.0, 1.0, 1.0]), np.zeros(3))
    with RayScene() as scene:
        scene.add(shape(BALL), affine("scaled"))
        expected = scene.cast(RayBundle.from_camera(CAMERA), T)
        singles = scene.cast_rays(*random_rays(500))
        monkeypatch.setattr(rtc.embree(), "packet_width", width)
        bundle = RayBundle.from_camera(CAMERA)
        assert bundle.packed.shape[2] == width
        assert_same_hits(scene.cast(bundle, T), expected)
        assert_same_hits(scene.cast_rays(*random_rays(500)), singles)


def test_ids_survive_removal_and_are_used_again() -> None:
    ball, towards = shape(BALL), np.array([[0.0, 0.0, -1.0]])
    with RayScene() as scene:
        ids = [scene.add(ball, transform(translation=(3.0 * i, 0, 0))) for i in range(4)]
        assert ids == [0, 1, 2, 3]
        assert scene.add(ball, transform(translation=(20, 0, 0)), instance=7) == 7

        def seen(x: float) -> int:
            return int(scene.cast_rays([[x, 0, 5]], towards).instances[0])

        assert [seen(3.0 * i) for i in range(4)] == ids
        scene.remove(1)
        assert [seen(3.0 * i) for i in range(4)] == [0, -1, 2, 3]
        assert scene.instances == (0, 2, 3, 7)
        assert scene.add(ball, transform(translation=(0, 50, 0))) == 1
        scene.set_pose(1, transform(translation=(3.0, 0, 0)))
        assert [seen(3.0 * i) for i in range(4)] == ids
        scene.set_enabled(2, False)
        assert seen(6.0) == -1
        scene.set_enabled(2, True)
        assert seen(6.0) == 2
        assert seen(20.0) == 7
        with pytest.raises(InvalidValueError, match="not one of"):
            scene.add(ball, instance=7)
        with pytest.raises(InvalidValueError, match=r"instance = 5.*\(0, 1, 2, 3, 7\)"):
            scene.remove(5)


@pytest.mark.parametrize("use_fallback", [False, True])
def test_an_empty_scene_is_all_misses(use_fallback: bool) -> None:
    with RayScene(use_fallback=use_fallback) as scene:
        hits = scene.cast(RayBundle.from_camera(CAMERA), np.eye(4))
        assert np.isinf(hits.distances).all()
        assert (hits.instances == -1).all() and (hits.faces == -1).all() and not hits.normals.any()
        assert not scene.occluded(np.zeros((3, 3)), np.eye(3), np.ones(3)).any()
        assert np.isinf(scene.closest_points(np.zeros((2, 3))).distances).all()
        assert len(scene.cast_rays(np.zeros((0, 3)), np.zeros((0, 3))).distances) == 0


@pytest.mark.parametrize("use_fallback", [False, True])
def test_motion_is_the_baked_mesh_at_the_rays_time(use_fallback: bool) -> None:
    keys = np.stack([transform(exp_so3(np.array([0, 0, 0.05 * i])), (0.1 * i, 0, 0.02 * i * i)) for i in range(5)])
    keys[:, :3, :3] *= 1.2
    origins, directions = random_rays(800, seed=2)
    with RayScene(use_fallback=use_fallback) as scene, RayScene() as oracle:
        scene.add(shape(BOX))
        oracle.add(shape(BOX))
        scene.set_motion(0, keys)
        for time in (0.0, 0.1, 0.25, 0.6, 1.0):
            segment = min(int(time * 4), 3)
            fraction = time * 4 - segment
            oracle.set_pose(0, (1 - fraction) * keys[segment] + fraction * keys[segment + 1])
            expected = oracle.cast_rays(origins, directions)
            assert_same_hits(scene.cast_rays(origins, directions, np.full(800, time)), expected)
            bundle = RayBundle.from_directions(directions)
            same = scene.cast(bundle, transform(translation=(0, 0, 3)), time=time)
            assert_same_hits(same, oracle.cast(bundle, transform(translation=(0, 0, 3))))
        scene.set_pose(0, np.eye(4))
        oracle.set_pose(0, np.eye(4))
        assert_same_hits(scene.cast_rays(origins, directions, np.full(800, 0.7)), oracle.cast_rays(origins, directions))


@pytest.mark.parametrize("use_fallback", [False, True])
def test_several_set_off_at_once_as_one_by_one(use_fallback: bool) -> None:
    way = np.stack([transform(exp_so3(np.array([0, 0, 0.1 * i])), (0.2 * i, 0.1, 0)) for i in range(3)])
    keys = np.stack([way, transform(translation=(0.0, 1.5, 0.5)) @ way])
    origins, directions = random_rays(600, seed=4)
    times = np.random.default_rng(5).uniform(size=600)
    with RayScene(use_fallback=use_fallback) as together, RayScene(use_fallback=use_fallback) as apart:
        for scene in (together, apart):
            scene.add_many([shape(BOX)] * 2, np.stack([np.eye(4)] * 2), [3, 8])
        together.set_motions([3, 8], keys)
        for number, track in zip([3, 8], keys, strict=True):
            apart.set_motion(number, track)
        assert_same_hits(together.cast_rays(origins, directions, times), apart.cast_rays(origins, directions, times))
        with pytest.raises(InvalidValueError, match="T_keys"):
            together.set_motions([3], keys)
        with pytest.raises(InvalidValueError, match="instance"):
            together.set_motions([3, 9], keys)


def test_the_fallback_gives_the_same_ranges() -> None:
    bundle = RayBundle.from_camera(CAMERA)
    T = look_at(np.array([2.0, 1.0, 1.0]), np.zeros(3))
    results = []
    for use_fallback in (False, True):
        with RayScene(use_fallback=use_fallback) as scene:
            scene.add(shape(BALL), affine("mirrored-scaled"))
            scene.add(shape(BOX), transform(translation=(0.4, 0.0, 0.2)))
            scene.add(shape(BOX), transform(translation=(0.0, 0.0, -0.9)))
            scene.set_enabled(2, False)
            results.append(scene.cast(bundle, T, max_distance=2.5, min_distance=0.5))
    assert_same_hits(*results)
    assert results[0].hit.any() and not (results[1].instances == 2).any()


def test_the_environment_forces_the_fallback() -> None:
    code = "from simtrack.raycast import RayScene; print(RayScene().fallback)"
    environment = os.environ | {rtc.FALLBACK_VARIABLE: "fallback"}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "True"


def test_one_and_two_threads_give_equal_bytes_also_from_several_python_threads() -> None:
    bundle = RayBundle.from_camera(CameraIntrinsics(160, 120, 150.0, 150.0, 79.5, 59.5))
    T = look_at(np.array([2.0, 1.0, 1.0]), np.zeros(3))
    before = numba.get_num_threads()  # two or more wherever there are two cores
    try:
        with RayScene() as scene:
            scene.add(shape(BALL), affine("scaled"))
            scene.add(shape(BOX), affine("rigid"))
            scene.commit()
            results: list[RayHits] = []
            for threads in (1, before):
                numba.set_num_threads(threads)
                results.append(scene.cast(bundle, T))
            workers = [threading.Thread(target=lambda: results.append(scene.cast(bundle, T))) for _ in range(4)]
            for worker in workers:
                worker.start()
            for worker in workers:
                worker.join()
    finally:
        numba.set_num_threads(before)
    assert len(results) == 6
    for other in results[1:]:
        assert other.distances.tobytes() == results[0].distances.tobytes()
        assert other.normals.tobytes() == results[0].normals.tobytes()
        assert other.instances.tobytes() == results[0].instances.tobytes()


def test_occlusion_agrees_with_casting() -> None:
    origins, directions = random_rays(1500, seed=3)
    limits = np.random.default_rng(4).uniform(0.2, 1.6, 1500)
    for use_fallback in (False, True):
        with RayScene(use_fallback=use_fallback) as scene:
            scene.add(shape(BOX), affine("scaled"))
            expected = scene.cast_rays(origins, directions).distances < limits
            got = scene.occluded(origins, directions, limits)
        assert 0.1 < got.mean() < 0.9
        assert (got == expected).mean() > 0.998


def test_bad_rays_miss_and_outputs_are_reused() -> None:
    origins = np.tile([0.0, 0.0, 3.0], (5, 1))
    directions = np.tile([0.0, 0.0, -1.0], (5, 1))
    directions[1] = 0.0
    directions[2, 0] = np.nan
    origins[3, 1] = np.inf
    for use_fallback in (False, True):
        with RayScene(use_fallback=use_fallback) as scene:
            scene.add(shape(BALL))
            out = RayHits.empty(5)
            hits = scene.cast_rays(origins, directions, out=out)
            assert hits is out
            assert hits.instances.tolist() == [0, -1, -1, -1, 0]
            assert not np.isnan(hits.distances).any()
            with pytest.raises(InvalidValueError, match="results for 2 rays"):
                scene.cast_rays(origins[:2], directions[:2], out=out)


def test_misuse_is_told() -> None:
    scene = RayScene()
    ball = shape(BALL)
    singular = np.diag([1.0, 1.0, 0.0, 1.0])
    for bad in (np.eye(3), np.full((4, 4), np.nan), singular):
        with pytest.raises(InvalidValueError, match="T_map_mesh"):
            scene.add(ball, bad)
    scene.add(ball)
    with pytest.raises(InvalidValueError, match="T_keys"):
        scene.set_motion(0, np.tile(np.eye(4), (130, 1, 1)))
    with pytest.raises(InvalidValueError, match="origins"):
        scene.cast_rays(np.zeros((3, 3)), np.zeros((2, 3)))
    with pytest.raises(InvalidValueError, match="T_map_sensor"):
        scene.cast(RayBundle.from_camera(CAMERA), np.full((4, 4), np.inf))
    scene.close()
    scene.close()
    with pytest.raises(RaycastError, match="closed"):
        scene.add(ball)
    with pytest.raises(RaycastError, match="closed"):
        scene.cast(RayBundle.from_camera(CAMERA), np.eye(4))


def test_embree_errors_carry_the_codes_name() -> None:
    device = rtc.embree()
    device.api.rtcNewGeometry(device.device, 99)
    with pytest.raises(RaycastError, match="RTC_ERROR_"):
        device.check("rtcNewGeometry")
    device.check("nothing pending")


@pytest.mark.parametrize(
    ("vertices", "faces", "reason"),
    [
        (np.zeros((0, 3)), np.zeros((0, 3), int), "empty"),
        (np.zeros((3, 2)), np.array([[0, 1, 2]]), "must be"),
        (np.array([[0, 0, 0], [1, 0, 0], [0, np.nan, 0]]), np.array([[0, 1, 2]]), "vertex 2 is not finite"),
        (np.eye(3), np.array([[0, 1, 3]]), "indices 0..3"),
        (np.eye(3), np.array([[0.0, 1.0, 2.0]]), "integers"),
        (np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0]]), np.array([[0, 1, 2]]), "no area"),
    ],
)
def test_bad_meshes_are_refused(vertices: np.ndarray, faces: np.ndarray, reason: str) -> None:
    with pytest.raises(MeshError, match=reason):
        TriangleMesh(vertices, faces, source="part.ply")


def test_meshes_outlive_their_python_owner_while_an_instance_uses_them() -> None:
    with RayScene() as scene:
        scene.add(shape(BALL))
        hits = scene.cast_rays([[0, 0, 3]], [[0, 0, -1]])
        assert hits.distances[0] == pytest.approx(2.5, abs=1e-5)


def test_no_leak_when_scenes_come_and_go() -> None:
    import resource

    ball = trimesh.creation.icosphere(subdivisions=5)

    def cycle() -> None:
        with RayScene() as scene:
            scene.add(shape(ball))
            scene.commit()

    for _ in range(5):
        cycle()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for _ in range(40):
        cycle()
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    assert grown < 20_000  # kB; 40 leaked hierarchies of 20,480 faces would be over 100 MB
