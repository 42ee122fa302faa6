"""Small labelled frames of a real scene: cast, labelled and painted, with everything that a frame can hold."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from simtrack.contracts import CameraIntrinsics, Float64, LidarScan, Odometry, Relation, StaticMap
from simtrack.datasets.annotate import Annotator, Owners
from simtrack.datasets.content import Placed
from simtrack.datasets.frame import Category, DatasetInfo, LabelledFrame, LidarLabels, SceneInfo, StuffCategory
from simtrack.datasets.writer import DatasetWriter
from simtrack.geometry.kinematics import Joint, KinematicTree, Link
from simtrack.geometry.meshes import Mesh, box_mesh, concatenate, cylinder_mesh, painted, transformed
from simtrack.geometry.transforms import exp_so3, inverse, look_at, transform
from simtrack.objects.model import ObjectModel, Symmetries, build_model, half_turns, rotational
from simtrack.raycast import RayScene, TriangleMesh

CAMERA = CameraIntrinsics(96, 72, 90.0, 88.0, 47.5, 35.5)
FRAMES = 3


def _bars() -> Mesh:
    """A picture frame, through which one can look."""
    long, short = box_mesh((0.30, 0.05, 0.05), (200, 60, 40)), box_mesh((0.05, 0.05, 0.10), (40, 60, 200))
    places = [(long, 0.0, 0.075), (long, 0.0, -0.075), (short, 0.125, 0.0), (short, -0.125, 0.0)]
    return concatenate([transformed(mesh, transform(None, (x, 0.0, z))) for mesh, x, z in places])


def _model(name: str, mesh: Mesh, symmetries: Symmetries) -> ObjectModel:
    return build_model(
        name=name, semantic_class="component", mesh=mesh, visual=mesh, collision=[mesh], mass=1.0, friction=0.5,
        symmetries=symmetries, trackable=True,
    )  # fmt: skip


WEDGE = Mesh(
    np.array([[0.1, 0.06, -0.05], [-0.1, 0.06, -0.05], [-0.1, -0.06, -0.05], [0.1, -0.06, -0.05],
              [-0.1, 0.06, 0.05], [-0.1, -0.06, 0.05]]),
    np.array([[0, 3, 2], [0, 2, 1], [1, 2, 5], [1, 5, 4], [0, 1, 4], [2, 3, 5], [0, 4, 5], [0, 5, 3]], np.int32),
)  # fmt: skip
"""Its own mirror image along y only."""
MODELS = (
    _model("bars", _bars(), half_turns("x", "z")),
    _model("can", cylinder_mesh(0.05, 0.16, 32, (220, 200, 60)), rotational("z")),
    _model("wedge", painted(WEDGE, (60, 180, 90)), Symmetries()),
)
POLE = cylinder_mesh(0.012, 0.5, 12, (90, 90, 90))
FLOOR = box_mesh((4.0, 4.0, 0.1), (120, 120, 110))
INFO = DatasetInfo(
    name="small",
    description="Things on a floor.",
    seed=7,
    recipe="name: small\n",
    intrinsics=CAMERA,
    categories=tuple(Category(number, model) for number, model in enumerate(MODELS, start=1)),
    stuff=(StuffCategory(4, "floor", False), StuffCategory(5, "pole", True)),
    val_share=0.5,
)
HEAD = Joint("head", "revolute", np.array([0.0, 0.0, 1.0]), -1.0, 1.0, 2.0)
NOTHING = np.empty((0, 3), np.float32), np.empty((0, 3), np.int32), 1.0
ROBOT = KinematicTree((Link("base", "", None, np.eye(4), *NOTHING), Link("neck", "base", HEAD, np.eye(4), *NOTHING)))
MAP = StaticMap(FLOOR.vertices.astype(np.float32), FLOOR.faces, noise=0.005)


@dataclass(frozen=True)
class Small:
    """A source of scenes."""

    info: DatasetInfo = INFO
    frames: int = FRAMES
    lidar: bool = True
    noise: float = 0.002
    """Metres, standard deviation of depth; where there is any, some readings are missing too."""
    stretch: float = 1.0
    """Factor on depth."""

    def scene_info(self, scene: int) -> SceneInfo:
        return SceneInfo(scene, self.frames, static_map=MAP, robot=ROBOT)

    def scene(self, scene: int) -> Iterator[LabelledFrame]:
        rng = np.random.default_rng([self.info.seed, scene])
        things = _things(rng)
        with RayScene() as rays:
            rays.add(TriangleMesh(FLOOR.vertices - [0, 0, 0.05], FLOOR.faces), instance=0)
            for thing in things:
                rays.add(thing.mesh, thing.T_map_mesh, instance=thing.ray_instance)
            annotator = Annotator(self.info.intrinsics)
            for index in range(self.frames):
                yield _frame(self, scene, index, things, rays, annotator)


def _things(rng: np.random.Generator) -> list[Placed]:
    """Five targets, the last of them behind all cameras, and a pole that splits what is behind it."""
    spots = [(0, 0.02, 0.06), (1, 0.22, -0.10), (2, -0.2, 0.0), (0, 0.1, 0.3), (1, 0.0, -3.0)]
    things = []
    for number, (which, x, y) in enumerate(spots, start=1):
        model = MODELS[which]
        T = transform(exp_so3(np.array([0.0, 0.0, rng.uniform(-0.5, 0.5)])), (x, y, 0.5 * model.extents[2]))
        surface = TriangleMesh(model.mesh.vertices, model.mesh.faces)
        things.append(
            Placed(number, number, f"{model.name}-{number}", model.semantic_class, which + 1, surface, T,
                   np.ones(3), model.extents, model.keypoints)
        )  # fmt: skip
    T, surface = transform(None, (-0.17, -0.12, 0.25)), TriangleMesh(POLE.vertices, POLE.faces)
    none = np.empty((0, 3))
    return [*things, Placed(6, 6, "pole-6", "pole", None, surface, T, np.ones(3), POLE.extents, none)]


def _frame(
    source: Small, scene: int, index: int, things: Sequence[Placed], rays: RayScene, annotator: Annotator
) -> LabelledFrame:
    rng = np.random.default_rng([source.info.seed, scene, index])
    eye = np.array([rng.uniform(-0.15, 0.15), -0.75, rng.uniform(0.2, 0.5)])
    # The second image cuts off what is left of its middle.
    T_map_camera = look_at(eye, np.array([0.35 if index == 1 else 0.0, 0.0, 0.05]))
    owners = Owners({0: 0} | {thing.ray_instance: thing.instance for thing in things})
    view = annotator.look(rays, owners, T_map_camera)
    noise = source.noise * rng.normal(size=view.depth.shape)
    read = (view.depth > 0) & (rng.random(view.depth.shape) > (0.05 if source.noise else 0.0))
    depth = np.where(read, (view.depth + noise) * source.stretch, 0.0).astype(np.float32)
    shade = (40 + 30 * (view.ids + 1))[..., None] + rng.integers(0, 12, (*view.ids.shape, 3))
    T_map_base = transform(exp_so3(np.array([0.0, 0.0, 0.1 * index])), (0.1 * index, -1.0, 0.0))
    stamp = 1_000_000_001 + index * 33_333_333
    return LabelledFrame(
        scene=scene, index=index, stamp=stamp, intrinsics=source.info.intrinsics, T_map_camera=T_map_camera,
        rgb=shade.astype(np.uint8), depth=depth, clean_depth=view.depth, normals=view.normals, ids=view.ids,
        names=("floor", *(thing.name for thing in things)),
        segment_categories=np.array([4, *(thing.category or 5 for thing in things)], np.int32),
        labels=annotator.annotate(things, rays, T_map_camera, view.ids, depth),
        lidar=_lidar(rays, T_map_base, stamp) if source.lidar else None,
        odometry=Odometry(stamp - 5, T_map_base, 0.3, 0.1), T_map_base=T_map_base, joints={"head": 0.1 * index},
        support=(("bars-1", "floor"), ("can-2", "floor")), relations=(Relation("can-2", "near", "bars-1"),),
    )  # fmt: skip


def _lidar(rays: RayScene, T_map_base: Float64, stamp: int) -> LidarLabels:
    T_base_lidar = transform(None, (0.0, 0.0, 0.3))
    azimuth, elevation = np.meshgrid(np.linspace(-1.0, 4.0, 40), np.linspace(-0.4, 0.4, 4))
    flat = np.cos(elevation)
    directions = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=-1).reshape(-1, 3)
    T_map_lidar = T_map_base @ T_base_lidar
    hits = rays.cast_rays(np.broadcast_to(T_map_lidar[:3, 3], directions.shape), directions @ T_map_lidar[:3, :3].T)
    count = len(directions)
    scan = LidarScan(
        stamp=stamp - 100_000_000, directions=directions.astype(np.float32),
        ranges=np.where(hits.hit, hits.distances, np.inf).astype(np.float32),
        times=np.linspace(0.0, 0.1, count, dtype=np.float32), rings=np.repeat(np.arange(4), 40).astype(np.uint8),
        intensities=np.linspace(0.0, 255.0, count, dtype=np.float32), T_base_lidar=T_base_lidar,
    )  # fmt: skip
    return LidarLabels(scan, T_map_lidar, np.where(hits.hit, hits.instances, -1).astype(np.int32))


def write(root: Path, writers: Sequence[DatasetWriter], source: Small, scenes: Sequence[int]) -> Path:
    """Write some scenes as the engine does: each in a staging folder of its own, then moved into place."""
    for writer in writers:
        writer.begin(root, source.info)
    for scene in scenes:
        staging = root / ".staging" / str(scene)
        staging.mkdir(parents=True)
        opened = [writer.open_scene(staging, source.info, source.scene_info(scene)) for writer in writers]
        for frame in source.scene(scene):
            for one in opened:
                one.write(frame)
        for one in opened:
            one.close()
        for path in sorted(file for file in staging.rglob("*") if file.is_file()):
            target = root / path.relative_to(staging)
            target.parent.mkdir(parents=True, exist_ok=True)
            path.rename(target)
    return root


def made(root: Path, writers: Sequence[DatasetWriter], source: Small | None = None, scenes: int = 2) -> Path:
    """A whole data set."""
    source = source or Small()
    write(root, writers, source, range(scenes))
    for writer in writers:
        writer.finish(root, source.info, scenes)
    return root


def contents(root: Path) -> dict[str, bytes]:
    """Every file with its bytes."""
    return {str(p.relative_to(root)): p.read_bytes() for p in sorted(root.rglob("*")) if p.is_file()}


def without_robot(frame: LabelledFrame) -> LabelledFrame:
    return replace(frame, T_map_base=None, odometry=None, lidar=None, joints={})


def silhouette_on_canvas(mesh: Mesh, T_camera_mesh: Float64, camera: CameraIntrinsics) -> np.ndarray:
    """(3H, 3W) what rays through the pixels of the wide canvas meet of a mesh alone."""
    u, v = np.meshgrid(np.arange(-camera.width, 2 * camera.width), np.arange(-camera.height, 2 * camera.height))
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)
    T = inverse(T_camera_mesh)
    with RayScene() as scene:
        scene.add(TriangleMesh(mesh.vertices, mesh.faces))
        origins = np.broadcast_to(T[:3, 3], (rays.size // 3, 3))
        hits = scene.cast_rays(origins, rays.reshape(-1, 3) @ T[:3, :3].T)
    return hits.hit.reshape(u.shape)
