"""``simtrack bench raycast``: queries of the benchmark's office, beside other ray casters in the same run.

The engines get the same meshes in the same poses: simtrack as instances, the others baked into the map frame. They give
the same outputs: range, normal, face and mesh of every ray; simtrack writes into arrays that are used again. Each works
on one thread unless more are asked for, which simtrack and Open3D can use.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from simtrack.benchmarks import office as scenes
from simtrack.benchmarks.harness import Benchmark, Options, Timing, measure, rest
from simtrack.benchmarks.office import Office
from simtrack.benchmarks.yardstick import embreex_scene, scaled
from simtrack.contracts import Float32, Float64
from simtrack.geometry.meshes import concatenate
from simtrack.raycast import RayBundle, RayHits, RayScene
from simtrack.raycast.bundle import packet_width
from simtrack.raycast.embree import CONFIG_VARIABLE

ASKED_RATIOS = {"pinhole 640x480": {16: 3.5, 8: 2.5}, "VLP-16 1824x16": {16: 2.5, 8: 2.2}}
"""Times faster than `embreex`'s ``run``, by packet width: 16 where AVX-512 is native, 8 under AVX2."""
ASKED_MOVE = 0.0005
"""Seconds of CPU to move five instances and commit, where the yardstick is its reference."""
AGREE = 1e-4
"""Metres (of depth for the camera) within which two engines' ranges are the same."""


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """Rays of a sensor, for engines of all kinds."""

    name: str
    bundle: RayBundle
    T_map_sensor: Float64
    """(4, 4)."""
    origins: Float32
    """(N, 3), map frame."""
    directions: Float32
    """(N, 3), map frame."""

    @staticmethod
    def of(name: str, bundle: RayBundle, T_map_sensor: Float64) -> "Scan":
        """The rays of a bundle, in the map frame too."""
        T = T_map_sensor.astype(np.float32)
        directions = np.ascontiguousarray(bundle.directions @ T[:3, :3].T)
        origins = np.ascontiguousarray(np.broadcast_to(T[:3, 3], directions.shape))
        return Scan(name, bundle, T_map_sensor, origins, directions)


def run(options: Options) -> Benchmark:
    """Measure; see the module."""
    result = Benchmark("raycast")
    options.say("building the office in every engine")
    world = scenes.office()
    camera = Scan.of("pinhole 640x480", scenes.pinhole(), world.T_map_camera)
    lidar = Scan.of("VLP-16 1824x16", scenes.vlp16(), world.T_map_lidar)
    repeats = 3 if options.quick else 25
    with world.scene() as scene:
        engines = _engines(world, options, result)
        options.say(camera.name)
        yardstick = _cast(result, scene, camera, engines, repeats)["embreex run"].cpu
        options.say(lidar.name)
        _cast(result, scene, lidar, engines, repeats)
        options.say("moving instances, occlusion, closest points")
        _move(result, world, scene, None if options.quick else scaled(ASKED_MOVE, yardstick), repeats)
        _at_objects(result, scene, camera, repeats)
        _small_casts(result, scene, world, repeats)
        _occlusion(result, scene, world, options, repeats)
        _closest(result, scene, world, options, repeats)
    result.notes.append(
        f"Packets of {packet_width()} rays. To see another instruction set, e.g. AVX2 on an AVX-512 machine: "
        f"{CONFIG_VARIABLE}=isa=avx2 (embreex keeps its own choice)."
    )
    return result


# ---------------------------------------------------------------------------------------------------------- the engines


Engine: TypeAlias = Callable[[Scan], Callable[[], object] | None]
"""What gives for a scan what casts it, or None if that would take too long."""


def _engines(world: Office, options: Options, result: Benchmark) -> dict[str, Engine]:
    """Peers by name. What is not installed is noted."""
    baked = embreex_scene(world)
    engines: dict[str, Engine] = {
        "embreex run": lambda scan: partial(baked.run, scan.origins, scan.directions, output=True)
    }
    if options.quick:
        return engines
    engines["trimesh intersects_id"] = _trimesh(world)
    engines["mujoco mj_multiRay"] = _mujoco(world)
    try:
        engines["Open3D RaycastingScene"] = _open3d(world, options.threads)
    except ImportError:
        result.notes.append("Open3D is not installed (extra bench).")
    return engines


def _trimesh(world: Office) -> Engine:
    import trimesh

    baked = concatenate(world.posed())
    mesh = trimesh.Trimesh(baked.vertices, baked.faces, process=False)

    def cast(scan: Scan) -> object:
        found: Any = mesh.ray.intersects_id(scan.origins, scan.directions, multiple_hits=False, return_locations=True)
        return found, mesh.face_normals[found[0]]

    return lambda scan: partial(cast, scan)


def _open3d_scene(world: Office, threads: int) -> Any:
    import open3d  # pyright: ignore[reportMissingImports] - extra `bench`

    scene = open3d.t.geometry.RaycastingScene(nthreads=threads)
    for mesh in world.posed():
        scene.add_triangles(_tensor(mesh.vertices.astype(np.float32)), _tensor(mesh.faces.astype(np.uint32)))
    return scene


def _tensor(array: npt.NDArray[Any]) -> Any:
    import open3d  # pyright: ignore[reportMissingImports] - extra `bench`

    make: Any = open3d.core.Tensor
    return make(array)


def _open3d(world: Office, threads: int) -> Engine:
    scene = _open3d_scene(world, threads)

    def prepared(scan: Scan) -> Callable[[], object]:
        rays = _tensor(np.concatenate([scan.origins, scan.directions], axis=1))
        return partial(scene.cast_rays, rays, nthreads=threads)

    return prepared


def _mujoco(world: Office) -> Engine:
    """One geom a mesh; rays from one point, which is all that `mj_multiRay` takes."""
    import mujoco

    spec = mujoco.MjSpec()
    for k, mesh in enumerate(world.posed()):
        faces = mesh.faces.ravel()
        asset = spec.add_mesh(name=str(k), uservert=mesh.vertices.ravel(), userface=faces)
        asset.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=str(k), contype=0, conaffinity=0)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)

    def prepared(scan: Scan) -> Callable[[], object] | None:
        count = len(scan.directions)
        if count > 50_000:
            return None  # half a second a scan
        geoms, distances, normals = np.zeros(count, np.int32), np.zeros(count), np.zeros(3 * count)
        origin, directions = scan.origins[0].astype(float), scan.directions.astype(float).ravel()
        answers = geoms, distances, normals, count, 1e3
        return partial(mujoco.mj_multiRay, model, data, origin, directions, None, True, -1, *answers)

    return prepared


# ---------------------------------------------------------------------------------------------------------- the queries


def _cast(
    result: Benchmark,
    scene: RayScene,
    scan: Scan,
    engines: Mapping[str, Engine],
    repeats: int,
) -> dict[str, Timing]:
    """Nearest hits of a whole scan by everybody, and whether simtrack and embreex agree."""
    out = RayHits.empty(len(scan.bundle))
    ours = partial(scene.cast, scan.bundle, scan.T_map_sensor, out=out)
    contestants: dict[str, Callable[[], object]] = {"simtrack": ours}
    contestants |= {name: cast for name, make in engines.items() if (cast := make(scan)) is not None}
    timings = measure(contestants, repeats, before=rest, primed=True)
    for name, timing in timings.items():
        result.add(f"{scan.name}: {name}", timing)
    for name, timing in timings.items():
        if name != "simtrack":
            asked = ASKED_RATIOS[scan.name][packet_width()] if name == "embreex run" else None
            ratio = timing.cpu / timings["simtrack"].cpu
            result.add(f"{scan.name}: {name} / simtrack", value=ratio, unit="x", asked=asked, sense="at least")
    differing = _differing(ours(), contestants["embreex run"]())
    result.add(f"{scan.name}: rays on which simtrack and embreex differ", value=float(differing), unit="rays")
    return timings


def _differing(hits: RayHits, theirs: Any) -> int:
    """Rays whose ranges are further apart than `AGREE`."""
    return int(np.count_nonzero(~np.isclose(hits.distances, theirs["tfar"], rtol=0.0, atol=AGREE)))


def _move(result: Benchmark, world: Office, scene: RayScene, asked: float | None, repeats: int) -> None:
    poses = np.stack(list(world.T_map_object.values()))
    moved = poses.copy()
    moved[:, 0, 3] += 1e-3
    turn = [poses, moved]

    def move() -> None:
        turn.reverse()
        scene.set_poses((1, 2, 3, 4, 5), turn[0])
        scene.commit()

    timing = measure({"simtrack": move}, 10 * repeats)["simtrack"]
    result.add("move 5 instances and commit: simtrack", timing, asked=asked)


def _at_objects(result: Benchmark, scene: RayScene, scan: Scan, repeats: int) -> None:
    """The same rays where only hits on the five objects are asked for."""
    objects = (1, 2, 3, 4, 5)
    timings = measure({"": partial(scene.cast_at, scan.bundle, scan.T_map_sensor, objects)}, repeats)
    hits = len(scene.cast_at(scan.bundle, scan.T_map_sensor, objects))
    result.add(f"{scan.name}, hits on 5 objects: simtrack", timings[""], note=f"{hits} hits")


def _small_casts(result: Benchmark, scene: RayScene, world: Office, repeats: int) -> None:
    """What a tracker's frame is made of: fifteen casts of some two thousand rays at the objects."""
    seen = scene.cast(scenes.pinhole(), world.T_map_camera).instances.reshape(480, 640)
    rows, columns = np.nonzero(seen > 0)
    window = int(columns.min()), int(rows.min()), int(columns.max()) + 1, int(rows.max()) + 1
    stride = next(s for s in range(1, 64) if (window[2] - window[0]) * (window[3] - window[1]) < 2500 * s * s)

    def make() -> RayBundle:
        return RayBundle.from_windows(scenes.CAMERA, [window], stride)

    bundle = make()

    def cast() -> None:
        for _ in range(15):
            scene.cast(bundle, world.T_map_camera)

    timings = measure({"cast": cast, "bundle": make}, 4 * repeats)
    result.add(f"15 casts of {len(bundle)} rays at objects: simtrack", timings["cast"])
    result.add(f"a bundle of {len(bundle)} rays: simtrack", timings["bundle"])


def _occlusion(result: Benchmark, scene: RayScene, world: Office, options: Options, repeats: int) -> None:
    """Whether points in the room are hidden from others: incoherent rays."""
    rng = np.random.default_rng(options.seed)
    count = 2_000 if options.quick else 20_000
    middle = world.T_map_camera[:3, 3] + [0.0, 0.0, -0.3]
    starts, ends = (middle + rng.uniform(-1.5, 1.5, (2, count, 3)) * [1.0, 1.0, 0.5]).astype(np.float32)
    directions = ends - starts
    limits = np.ones(count, np.float32)
    baked = embreex_scene(world)
    timings = measure(
        {
            "simtrack": lambda: scene.occluded(starts, directions, limits),
            "embreex run": lambda: baked.run(starts, directions, dists=limits, query="OCCLUDED"),
        },
        repeats,
    )
    for name, timing in timings.items():
        result.add(f"occlusion of {count} segments: {name}", timing)
    ratio = timings["embreex run"].cpu / timings["simtrack"].cpu
    result.add(f"occlusion of {count} segments: embreex run / simtrack", value=ratio, unit="x")


def _closest(result: Benchmark, scene: RayScene, world: Office, options: Options, repeats: int) -> None:
    rng = np.random.default_rng(options.seed)
    count = 1_000 if options.quick else 10_000
    points = (world.T_map_camera[:3, 3] + rng.uniform(-1.5, 1.5, (count, 3)) * [1.0, 1.0, 0.5]).astype(np.float32)
    contestants: dict[str, Callable[[], object]] = {"simtrack": lambda: scene.closest_points(points)}
    if not options.quick:
        try:
            peer, queries = _open3d_scene(world, options.threads), _tensor(points)
            contestants["Open3D RaycastingScene"] = lambda: peer.compute_closest_points(queries, options.threads)
        except ImportError:
            pass  # noted with the engines
    timings = measure(contestants, repeats, before=rest, primed=True)
    for name, timing in timings.items():
        result.add(f"closest points of {count} points: {name}", timing)
    for name, timing in timings.items():
        if name != "simtrack":
            ratio = timing.cpu / timings["simtrack"].cpu
            result.add(f"closest points of {count} points: {name} / simtrack", value=ratio, unit="x")
