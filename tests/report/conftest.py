"""A made-up run with real object models and ray-cast images, to make reports of."""

import numpy as np
import pytest

from simtrack.contracts import (
    NANOSECONDS,
    Belief,
    CameraIntrinsics,
    Localization,
    MapEntity,
    Presegmentation,
    RegionOfInterest,
    Relation,
    RgbdFrame,
    Room,
    StaticMap,
    Status,
    Track,
    TrackStatus,
)
from simtrack.evaluation.metrics import Metrics, measured, unmeasured
from simtrack.evaluation.record import Album, RelationTimeline, RunRecord, graph_name
from simtrack.evaluation.tracking import ObjectFrame
from simtrack.geometry.transforms import inverse, look_at, perturb, transform, transform_planar
from simtrack.objects import load_object
from simtrack.raycast import RayBundle, RayScene, TriangleMesh

INTRINSICS = CameraIntrinsics(320, 240, 280.0, 280.0, 159.5, 119.5)
PLACES = {
    "materialbox": (1.2, 0.15, 0.75), "powerdrill": (1.25, -0.25, 0.75), "multimeter": (0.95, -0.1, 0.75),
    "screwdriver": (0.95, 0.2, 0.75),
}  # fmt: skip


def poses(second: float) -> dict[str, np.ndarray]:
    placed = {}
    for k, (name, (x, y, z)) in enumerate(PLACES.items()):
        height = float(load_object(name).extents[2]) / 2
        placed[name] = transform_planar(x, y + (0.02 * second if name == "multimeter" else 0.0), 0.6 * k)
        placed[name][2, 3] = z + height
    return placed


def cast(T_map_camera: np.ndarray, placed: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """A shaded image and its depth."""
    bench = np.array([[-0.4, -0.8, 0], [0.6, -0.8, 0], [0.6, 0.8, 0], [-0.4, 0.8, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    with RayScene() as scene:
        scene.add(TriangleMesh(bench, faces), transform(translation=(1.1, 0.0, 0.75)))
        scene.add(TriangleMesh(np.array([[6.0, -9, -9], [6, 9, -9], [6, 9, 9], [6, -9, 9]]), faces))
        colors = [np.tile([[150, 120, 90]], (2, 1)), np.tile([[205, 208, 210]], (2, 1))]
        for name, T in placed.items():
            visual = load_object(name).visual
            scene.add(TriangleMesh(visual.vertices, visual.faces), T)
            given = visual.face_colors
            colors.append(np.tile([[120, 120, 120]], (len(visual.faces), 1)) if given is None else given)
        hits = scene.cast(RayBundle.from_camera(INTRINSICS), T_map_camera)
    image = np.zeros((len(hits.distances), 3))
    for instance, shades in enumerate(colors):
        rows = hits.instances == instance
        image[rows] = np.asarray(shades)[hits.faces[rows]]
    light = 0.45 + 0.55 * np.abs(hits.normals @ np.array([0.3, 0.2, 0.93]))
    shape = (INTRINSICS.height, INTRINSICS.width)
    depth = np.where(np.isfinite(hits.distances), hits.distances, 0.0).astype(np.float32)
    return (image * light[:, None]).clip(0, 255).astype(np.uint8).reshape(*shape, 3), depth.reshape(shape)


def track(name: str, number: int, stamp: int, T: np.ndarray, T_map_camera: np.ndarray, hidden: bool) -> Track:
    status = TrackStatus.OCCLUDED if hidden else TrackStatus.CONFIRMED
    return Track(
        number, name, status, stamp, T, np.eye(6) * 1e-6, inverse(T_map_camera) @ T, np.zeros(6), stamp,
        0.1 if hidden else 0.9, name == "multimeter", 0.001, 0.9,
    )  # fmt: skip


def metrics() -> Metrics:
    return {
        "localization.ate_rmse": measured(0.0062, "m"), "localization.rotation_rmse": measured(0.002, "rad"),
        "tracking.static.translation_error.median": measured(0.0011, "m"),
        "tracking.floor.static.translation_error.median": measured(0.0009, "m"),
        "tracking.moving.translation_error.median": measured(0.0062, "m"), "tracking.recall": measured(0.953, "1"),
        "tracking.false_tracks": measured(1, "1"), "tracking.reacquisition_time.p95": measured(0.4, "s"),
        "world.known_share": measured(0.91, "1"), "relations.f1": measured(0.97, "1"),
        "loop.gaze_gain": unmeasured("1", "the fixed gaze was not run"),
        "presegmentation.camera.reduction": measured(0.87, "1"), "speed.frames_per_second": measured(11.3, "Hz"),
        "speed.peak_memory": measured(912_000_000, "bytes"), "run.frames": measured(60, "1"),
    }  # fmt: skip


def static_map() -> StaticMap:
    entities = [
        MapEntity("workbench", "table", transform(translation=(1.1, 0, 0.73)), np.array([1.0, 1.6, 0.04])),
        MapEntity("shelf", "shelf", transform(translation=(-1.5, 2.5, 1.0)), np.array([1.2, 0.4, 2.0])),
        MapEntity("wall-north", "wall", transform(translation=(0, 3.0, 1.5)), np.array([8.0, 0.1, 3.0])),
        MapEntity("wall-south", "wall", transform(translation=(0, -3.0, 1.5)), np.array([8.0, 0.1, 3.0])),
    ]
    room = Room("lab", np.array([[-4.0, -3], [4, -3], [4, 3], [-4, 3]]))
    empty = np.zeros((0, 3), dtype=np.float32), np.zeros((0, 3), dtype=np.int32)
    return StaticMap(*empty, tuple(entities), (room,))


@pytest.fixture(scope="session")
def record() -> RunRecord:
    rng = np.random.default_rng(0)
    frames, period = 60, NANOSECONDS // 10
    album, timeline = Album(0, frames * period / NANOSECONDS), RelationTimeline()
    objects: list[ObjectFrame] = []
    true = [transform_planar(-0.4 + 0.004 * k, 0.3 * np.sin(k / 20), 0.1) for k in range(frames)]
    believed = [perturb(T, np.append(rng.normal(0, 0.004, 2), [0, 0, 0, 0.001])) for T in true]
    for k in range(frames):
        stamp, placed = k * period, poses(k / 10)
        T_map_camera = look_at(np.array([0.0 + 0.004 * k, 0.1, 1.45]), np.array([1.1, 0.0, 0.8]))
        tracks, now = [], []
        for number, (name, T) in enumerate(placed.items(), start=1):
            hidden = name == "powerdrill" and 20 < k < 40
            xi = rng.normal(0, 0.004 if name == "multimeter" else 0.001, 6)
            estimate = track(name, number, stamp, perturb(T, xi), T_map_camera, hidden)
            missed = name == "screwdriver" and k < 8
            tracks += [] if missed else [estimate]
            error = np.inf if missed else float(np.linalg.norm(xi[:3]))
            now.append(
                ObjectFrame(stamp, name, name, 0.1 if hidden else 0.9, name == "multimeter", inverse(T_map_camera) @ T,
                            None if missed else estimate, error, 0.01, error, error, 0.01, not missed)
            )  # fmt: skip
        objects += now
        names = {t.class_name: graph_name(t) for t in tracks}
        held = {Relation(n, "on", "workbench") for n in names.values()}
        held |= {Relation(names["materialbox"], "left-of", names["multimeter"])} if k > 15 else set()
        held |= {Relation(names["multimeter"], "near", names["powerdrill"])} if k % 20 < 12 else set()
        timeline.observe(stamp, frozenset(held))
        if k % 12:
            continue
        rgb, depth = cast(T_map_camera, placed)
        unknown = np.zeros(depth.shape, dtype=bool)
        unknown[110:150, 190:240] = True
        region = RegionOfInterest(stamp, np.zeros(4), np.zeros(3), np.ones(3), 2000, "camera")
        presegmentation = Presegmentation(stamp, unknown, 70000, unknown.astype(np.int32), (region,), "camera")
        localization = Localization(stamp, believed[k], np.eye(6), Status.OK)
        belief = Belief(stamp, localization, T_map_camera, tuple(tracks), presegmentation, None, frozenset(held))
        frame = RgbdFrame(stamp, depth, rgb, INTRINSICS, np.eye(4))
        album.see(frame, belief, now)
        album.see_unknown(frame, belief)
    angles = rng.uniform(-np.pi, np.pi, 3000)
    points = np.stack([3.5 * np.cos(angles), 2.8 * np.sin(angles), rng.uniform(0, 2, 3000)], axis=1)
    album.see_lidar(0, points.astype(np.float32), (angles > 0.2) & (angles < 0.5), true[-1])
    return RunRecord(
        scene="workbench", seed=3, static_map=static_map(),
        meshes={name: load_object(name).visual for name in PLACES}, config={"scene": "workbench", "seed": 3},
        start=0, end=(frames - 1) * period, partial=True, metrics=metrics(),
        stamps=[k * period for k in range(frames)], estimated=believed, true=true, object_frames=objects,
        switches=[(30 * period, "multimeter")],
        stage_seconds={n: rng.gamma(9, s, 60).tolist() for n, s in (("tracking", 0.002), ("localization", 0.001))},
        key_frames=album.key_frames, worst=album.worst, query_frame=album.query_frame, camera=album.camera,
        lidar=album.lidar, believed_relations=timeline.intervals(),
    )  # fmt: skip
