"""``simtrack bench relations``: one update of the scene graph in worlds of growing size, of which ten objects move.

The world is a floor of rooms; each has its shell, some furniture and two workbenches with twenty objects each, a
quarter of a metre apart. Ten objects are carried about over their benches, 1 cm a frame; what stands in other rooms
than the first is not seen. Beside it stand the same update when all objects moved, and the directions of all pairs of
boxes from scratch in numpy.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import count, cycle
from pathlib import Path

import numpy as np

from simtrack.benchmarks.harness import Benchmark, Options, Timing, measure
from simtrack.contracts import Bool, Float64, MapEntity, Room, StaticMap, Track, TrackStatus
from simtrack.geometry.transforms import exp_so3, transform
from simtrack.objects import ObjectModel, load_object
from simtrack.perception.scene_graph import RelationConfig, SceneGraph

SIZES, QUICK_SIZES = (100, 300, 1000, 3000), (40, 80)
LARGE_FLOOR = 200
"""Rooms of a floor with far more furniture than the objects need."""
LARGEST_FROM_SCRATCH = 1000
"""Objects: the peer takes seconds beyond."""
MOVING = 10
ASKED_SIZE, ASKED = 1000, 0.002
"""Objects, and seconds of CPU asked for an update."""
FRAME = 33_333_333
"""Nanoseconds between updates."""
CLASSES = ("relay", "multimeter", "klt3147", "screwdriver", "materialbox")
BENCHES, ROWS, COLUMNS = 2, 4, 5
"""Benches in a room; objects on a bench, across and along."""
_ROOM = np.array([5.0, 4.0, 3.0])
_BENCH = np.array([1.0, 2.0, 0.8])


@dataclass(frozen=True, slots=True)
class World:
    """A floor of rooms with objects on benches."""

    static_map: StaticMap
    classes: tuple[str, ...]
    """Model of each object."""
    poses: Float64
    """(N, 4, 4), map <- object, where the objects stand."""

    def tracks(self, frame: int, moving: int = MOVING) -> list[Track]:
        """All objects as a tracker gives them in a frame: the first ones carried about, the first room's seen."""
        stamp = (frame + 1) * FRAME
        return [self._track(number, stamp, self._pose(number, frame, moving)) for number in range(len(self.classes))]

    def _pose(self, number: int, frame: int, moving: int) -> Float64:
        T = self.poses[number].copy()
        if number < moving:
            angle = 0.1 * frame + number
            T[:3, 3] += 0.1 * math.cos(angle), 0.1 * math.sin(angle), 0.05
        return T

    def _track(self, number: int, stamp: int, T: Float64) -> Track:
        seen = number < BENCHES * ROWS * COLUMNS
        return Track(
            id=number + 1,
            class_name=self.classes[number],
            status=TrackStatus.CONFIRMED if seen else TrackStatus.OUT_OF_VIEW,
            stamp=stamp,
            T_map_object=T,
            covariance=1e-6 * np.eye(6),
            T_camera_object=T,
            velocity=np.zeros(6),
            last_seen=stamp if seen else 0,
            visible_fraction=float(seen),
            moving=number < MOVING,
            residual=0.001,
            score=1.0,
        )


def run(options: Options) -> Benchmark:
    """Measure updates of growing worlds."""
    models = {name: load_object(name) for name in CLASSES}
    result = Benchmark("relations")
    sizes = QUICK_SIZES if options.quick else SIZES
    asked = None if options.quick else _asked(options)
    curves: dict[str, list[float]] = {"objects": [], "ten move": [], "all move": [], "numpy": []}
    for size in sizes:
        options.say(f"{size} objects")
        world = build_world(size, models, options.seed)
        graph = SceneGraph(world.static_map, models)
        timings = _measure_updates(world, graph, options.quick)
        wanted = asked if size == ASKED_SIZE else None
        ten = timings["ten move"]
        result.add(f"{size} objects, {MOVING} move: simtrack", ten, asked=wanted, note=_extent(world, graph))
        result.add(f"{size} objects, all move: simtrack", timings["all move"])
        if size <= LARGEST_FROM_SCRATCH:
            bodies = [graph.body(name) for name in graph.entities if name not in graph.rooms]
            parts = boxes([(body.T_map, body.shape.extents) for body in bodies])
            timings |= measure({"numpy": partial(directions, *parts, RelationConfig())}, repeats=1, warmup=0)
            result.add(f"{size} objects, six directions of all pairs: numpy", timings["numpy"])
            result.add(f"{size} objects: numpy over {MOVING} that move", value=timings["numpy"].cpu / ten.cpu, unit="x")
        curves["objects"].append(size)
        for name in ("ten move", "all move", "numpy"):
            if name in timings:
                curves[name].append(timings[name].cpu)
    if not options.quick:
        options.say(f"{ASKED_SIZE} objects on a floor of {LARGE_FLOOR} rooms")
        world = build_world(ASKED_SIZE, models, options.seed, rooms=LARGE_FLOOR)
        graph = SceneGraph(world.static_map, models)
        ten = _measure_updates(world, graph, options.quick)["ten move"]
        name = f"{ASKED_SIZE} objects in {LARGE_FLOOR} rooms, {MOVING} move: simtrack"
        result.add(name, ten, asked=asked, note=_extent(world, graph))
        result.add("distance of two neighbours' surfaces: simtrack", _measure_surfaces(world, graph))
    result.series = curves
    result.plots = {"relations.svg": lambda path: _plot(curves, path)}
    return result


def _extent(world: World, graph: SceneGraph) -> str:
    return f"{len(world.static_map.entities)} static entities, {len(graph.relations)} relations"


def _asked(options: Options) -> float:
    """Seconds asked on this machine."""
    from simtrack.benchmarks.yardstick import scaled, yardstick

    return scaled(ASKED, yardstick(options.say))


def _measure_updates(world: World, graph: SceneGraph, quick: bool) -> dict[str, Timing]:
    """Updates with the tracks of one frame after another; making the tracks is not timed."""
    frames = count()
    tracks: list[Track] = []

    def follow(moving: int) -> None:
        tracks[:] = world.tracks(next(frames), moving)

    def update() -> None:
        graph.update(tracks[0].stamp, tracks)

    few = {"ten move": update}
    every = {"all move": update}
    repeats = 5 if quick else 60
    ten = measure(few, repeats, warmup=5, before=lambda: follow(MOVING))
    return ten | measure(every, max(3, repeats // 6), before=lambda: follow(len(world.poses)))


def _measure_surfaces(world: World, graph: SceneGraph) -> Timing:
    """The distance of the meshes of neighbours, on demand."""
    names = [f"{name}-{number + 1}" for number, name in enumerate(world.classes)]
    pairs = cycle(zip(names[MOVING : MOVING + 9], names[MOVING + 1 : MOVING + 10], strict=True))
    return measure({"surfaces": lambda: graph.mesh_distance(*next(pairs))}, repeats=45, warmup=9)["surfaces"]


def boxes(posed: Sequence[tuple[Float64, Float64]]) -> tuple[Float64, Float64, Float64]:
    """Centres (N, 3), rotations (N, 3, 3) and half sides (N, 3) of boxes given by pose and extents."""
    T = np.array([pose for pose, _ in posed])
    return T[:, :3, 3].copy(), T[:, :3, :3].copy(), 0.5 * np.array([extents for _, extents in posed])


def directions(centres: Float64, rotations: Float64, halves: Float64, config: RelationConfig) -> Bool:
    """The peer: the six directions between all boxes by separating axes, a reference at a time, in plain numpy.

    Returns:
        (N, N, 6) of subject, reference and direction: live variant, layout not left out.
    """
    holds = np.zeros((len(centres), len(centres), 6), dtype=np.bool_)
    for b, (R, half) in enumerate(zip(rotations, halves, strict=True)):
        t = (centres - centres[b]) @ R
        axes = np.einsum("ki,nkj->nij", R, rotations)
        reach = np.einsum("nij,nj->ni", np.abs(axes), halves)
        for d, (axis, sign) in enumerate(((2, 1.0), (2, -1.0), (1, 1.0), (1, -1.0), (0, 1.0), (0, -1.0))):
            region = half.copy()
            region[axis] *= config.projection_factor
            offset = t.copy()
            offset[:, axis] -= sign * (half[axis] + region[axis])
            contained = (region - np.abs(offset) - reach).min(axis=1) >= 0.0
            meets = -_separation(offset, axes, halves, region) >= config.meet_depth
            holds[:, b, d] = contained | meets
        holds[b, b] = False
    return holds


def _separation(t: Float64, axes: Float64, halves: Float64, region: Float64) -> Float64:
    """(N,) largest gap over the fifteen axes between one box at the origin and boxes at (N, 3) turned by (N, 3, 3)."""
    size = np.abs(axes)
    gap = (np.abs(t) - region - np.einsum("nij,nj->ni", size, halves)).max(axis=1)
    along = np.abs(np.einsum("ni,nij->nj", t, axes)) - halves - np.einsum("i,nij->nj", region, size)
    gap = np.maximum(gap, along.max(axis=1))
    for i in range(3):
        i1, i2 = (i + 1) % 3, (i + 2) % 3
        for j in range(3):
            j1, j2 = (j + 1) % 3, (j + 2) % 3
            sine = np.sqrt(np.maximum(1.0 - axes[:, i, j] ** 2, 0.0))
            span = region[i1] * size[:, i2, j] + region[i2] * size[:, i1, j]
            span += halves[:, j1] * size[:, i, j2] + halves[:, j2] * size[:, i, j1]
            apart = np.abs(t[:, i2] * axes[:, i1, j] - t[:, i1] * axes[:, i2, j]) - span
            parallel = sine < 1e-6
            gap = np.maximum(gap, np.where(parallel, -np.inf, apart / np.where(parallel, 1.0, sine)))
    return gap


def _plot(curves: Mapping[str, Sequence[float]], path: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6, 4), layout="constrained")
    axes = figure.subplots()
    names = {
        "ten move": f"simtrack, {MOVING} objects move",
        "all move": "simtrack, all objects move",
        "numpy": "numpy, six directions of all pairs",
    }
    for name, label in names.items():
        times = np.array(curves[name])
        axes.loglog(curves["objects"][: len(times)], 1e3 * times, "o-", label=label)
    axes.set_xlabel("objects")
    axes.set_ylabel("CPU time of an update, ms")
    axes.grid(alpha=0.3, which="both")
    axes.legend()
    figure.savefig(path)


def build_world(objects: int, models: Mapping[str, ObjectModel], seed: int, rooms: int = 1) -> World:
    """As many rooms as the objects need, `rooms` at least; twenty objects a bench, each in a cell of its own."""
    rng = np.random.default_rng(seed)
    per_bench = ROWS * COLUMNS
    rooms = max(rooms, math.ceil(objects / (BENCHES * per_bench)))
    wide = math.ceil(math.sqrt(rooms))
    entities: list[MapEntity] = []
    outlines: list[Room] = []
    names = list(models)
    classes = tuple(names[k] for k in rng.integers(len(names), size=objects))
    poses = np.tile(np.eye(4), (objects, 1, 1))
    for room in range(rooms):
        corner = np.array([*divmod(room, wide), 0.0]) * (_ROOM + 0.2)
        name = f"room{room}"
        square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]) * _ROOM[:2]
        outlines.append(Room(name, corner[:2] + square, 0.0, _ROOM[2]))
        entities += [_placed(name, corner, *part) for part in _FURNITURE]
    for number in range(objects):
        bench, cell = divmod(number, per_bench)
        room, bench = divmod(bench, BENCHES)
        corner = np.array([*divmod(room, wide), 0.0]) * (_ROOM + 0.2)
        model = models[classes[number]]
        # Long sides lie along the bench; jitter leaves the cells apart.
        yaw = rng.uniform(-0.1, 0.1) + np.pi * rng.integers(2) + (np.pi / 2 if model.extents[0] > 0.2 else 0.0)
        row, column = divmod(cell, COLUMNS)
        place = np.array([(row + 0.5) / ROWS - 0.5, (column + 0.5) / COLUMNS - 0.5]) * _BENCH[:2]
        place += rng.uniform(-0.01, 0.01, 2) + corner[:2] + _BENCH_PLACES[bench]
        poses[number] = transform(exp_so3(np.array([0.0, 0.0, yaw])), (*place, _BENCH[2] + 0.5 * model.extents[2]))
    nothing = np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32)
    return World(StaticMap(*nothing, tuple(entities), tuple(outlines)), classes, poses)


_BENCH_PLACES = (np.array([1.2, 1.5]), np.array([3.8, 1.5]))
_FURNITURE = (
    ("floor", "floor", (2.5, 2.0, -0.05), (5.0, 4.0, 0.1), (0.0,)),
    ("ceiling", "ceiling", (2.5, 2.0, 3.05), (5.0, 4.0, 0.1), ()),
    ("wall1", "wall", (-0.05, 2.0, 1.5), (0.1, 4.0, 3.0), ()),
    ("wall2", "wall", (5.05, 2.0, 1.5), (0.1, 4.0, 3.0), ()),
    ("wall3", "wall", (2.5, -0.05, 1.5), (5.0, 0.1, 3.0), ()),
    ("wall4", "wall", (2.5, 4.05, 1.5), (5.0, 0.1, 3.0), ()),
    *(
        (f"bench{k}", "workbench", (*place, 0.5 * _BENCH[2]), tuple(_BENCH), (_BENCH[2],))
        for k, place in enumerate(_BENCH_PLACES)
    ),
    ("shelf", "shelf", (2.5, 3.8, 1.0), (1.0, 0.4, 2.0), (0.5, 1.0, 1.5, 2.0)),
    ("desk", "desk", (4.2, 3.4, 0.375), (1.4, 0.8, 0.75), (0.75,)),
    ("chair", "chair", (3.2, 3.3, 0.45), (0.5, 0.5, 0.9), ()),
    ("bin", "trash-bin", (4.8, 2.7, 0.2), (0.3, 0.3, 0.4), ()),
)
"""Name, class, centre, extents and heights of the supports, in the frame of the room's corner."""


def _placed(
    room: str,
    corner: Float64,
    name: str,
    semantic_class: str,
    centre: tuple[float, ...],
    extents: tuple[float, ...],
    levels: tuple[float, ...],
) -> MapEntity:
    T = transform(None, corner + np.array(centre))
    faces = tuple((transform(None, (T[0, 3], T[1, 3], level)), np.array(extents[:2])) for level in levels)
    return MapEntity(f"{room}/{name}", semantic_class, T, np.array(extents), room, faces)
