"""How time and memory grow with the world: a thousand objects in a hundred rooms to ten million in a million.

A robot drives from room to room; in every frame the paged world follows, camera and lidar are cast into it, and up to
ten visible objects are registered to the camera's depth. The rooms in the middle are the same in worlds of every size,
so the frames of all sizes are the same, but for what lies farther away, and take turns. Apart from paging, the same
rays are cast into scenes that hold whole worlds as Embree instances.
"""

import resource
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from simtrack.benchmarks import rooms
from simtrack.benchmarks.harness import Benchmark, Options, Timing
from simtrack.benchmarks.room_drive import PARTS, T_BASE_LIDAR, AllLive, PagedDrive, mounted, sensors
from simtrack.benchmarks.yardstick import REFERENCE, scaled, yardstick
from simtrack.contracts import Float64
from simtrack.objects import load_object
from simtrack.perception.tracking.target import tracked_model
from simtrack.raycast import TriangleMesh
from simtrack.raycast.scene import MAX_INSTANCE

OBJECTS = ("klt3147", "materialbox", "relay", "screwdriver", "mug", "thermos")
"""What stands in the rooms."""
PAGED_ROOMS = (100, 1_000, 10_000, 100_000, 1_000_000)
LIVE_ROOMS = (100, 300, 1_000, 3_000, 10_000, 30_000, 100_000)
_QUICK = (20, 100)
_FRAMES, _STEP = 400, 0.1
"""Of a drive, and metres from one to the next: 3 m/s at 30 Hz."""


def run(options: Options) -> Benchmark:
    """Measure worlds of `PAGED_ROOMS` and `LIVE_ROOMS`; small ones in a quick run."""
    result = Benchmark("scaling")
    models = [tracked_model(load_object(name)) for name in OBJECTS]
    paged, live = (_QUICK, _QUICK) if options.quick else (PAGED_ROOMS, LIVE_ROOMS)
    meshes, drives = [model.mesh for model in models], []
    rooms.build(2, meshes, options.seed)  # the meshes of the rooms, which worlds of all sizes share
    for count in paged:
        options.say(f"building {count:,} rooms")
        before, cpu, wall = _resident(), time.process_time(), time.perf_counter()
        world = rooms.build(count, meshes, options.seed)
        timing = Timing(time.process_time() - cpu, time.perf_counter() - wall, 1)
        _report_world(result, world, timing, _resident() - before)
        drives.append(PagedDrive(world, models, rooms.drive(world, 10 if options.quick else _FRAMES, _STEP)))
    _drive_in_turn(drives, options)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024**2
    result.add("peak memory of the process, all worlds at once", value=peak, unit="GB", asked=4.0)
    pace = REFERENCE if options.quick else yardstick(options.say)
    _report_drives(result, drives, pace)
    _report_paging(result, drives[-1], 100 if options.quick else 4000, pace)
    _report_equality(result, next(d for d in drives if d.world.count == PAGED_ROOMS[0]), 3 if options.quick else 30)
    for drive in drives:
        drive.close()
    worlds = {drive.world.count: drive.world for drive in drives}
    del drives
    _cast_at_whole_worlds(result, worlds, live, meshes, options)
    result.plots["scaling.png"] = lambda path: _plot(result.series, path)
    return result


def _drive_in_turn(drives: Sequence[PagedDrive], options: Options) -> None:
    """Frame by frame, every world takes its turn."""
    pair = sensors()
    frames = len(drives[0].poses)
    for drive in drives:
        for _ in range(2):
            drive.step(0, pair, keep=False)
    for number in range(frames):
        if number % 50 == 0:
            options.say(f"driving through {len(drives)} worlds, frame {number} of {frames}")
        for drive in drives:
            drive.step(number, pair)


def _report_world(result: Benchmark, world: rooms.Rooms, timing: Timing, memory: float) -> None:
    arrays = (world.index.nbytes + world.index.regions.nbytes) / world.objects
    note = f"{memory / 1e6:.0f} MB more, {arrays:.0f} bytes an object"
    asked = 60.0 if world.count == PAGED_ROOMS[-1] else None
    result.add(f"build {world.count:,} rooms, {world.objects:,} objects", timing, asked=asked, note=note)


def _report_drives(result: Benchmark, drives: Sequence[PagedDrive], pace: float) -> None:
    for drive in drives:
        medians = zip(PARTS, 1e3 * np.median(drive.cpu, axis=0), strict=True)
        tail = 1e3 * np.percentile(drive.frames, (95, 100))
        note = ", ".join(f"{name} {ms:.1f}" for name, ms in medians) + f"; p95 {tail[0]:.0f}, max {tail[1]:.0f} ms"
        result.add(f"frame, {drive.world.objects:,} objects", drive.frame, note=note)
    small, large = drives[0], drives[-1]
    sizes = f"{large.world.objects:,}"
    ratio = float(np.median(large.frames / small.frames))
    result.add(f"frame, {sizes} : {small.world.objects:,} objects", value=ratio, unit="x", asked=1.5)
    live = f"{np.mean(large.live):.0f} instances live, {large.loaded} loaded"
    entered = _entered(large.world, large.poses[:, :3, 3])
    _add_paging(result, f"paging in any frame, {sizes} objects", np.array(large.cpu)[:, 0], pace, f"{live}; {entered}")
    result.notes.append(f"{np.mean(large.tracked):.1f} objects are registered in a frame on average.")
    result.series["paged.objects"] = [float(drive.world.objects) for drive in drives]
    result.series["paged.frame_ms"] = [1e3 * drive.frame.cpu for drive in drives]
    without_registration = [1e3 * np.array(drive.cpu)[:, :-1].sum(axis=1) for drive in drives]
    result.series["paged.casts_ms"] = [float(np.median(ms)) for ms in without_registration]


def _report_paging(result: Benchmark, drive: PagedDrive, frames: int, pace: float) -> None:
    """Paging alone, over hundreds of metres of corridor, doors on both sides."""
    positions = rooms.along_corridor(drive.world, frames, _STEP)
    seconds, loaded = np.empty(len(positions)), 0
    drive.scene.require(positions[0] + T_BASE_LIDAR[:3, 3], drive.scene.config.reach, drive.scene.config.ahead)
    for k, position in enumerate(positions):
        start = time.process_time()
        loaded += drive.scene.update(position + T_BASE_LIDAR[:3, 3]).loaded
        seconds[k] = time.process_time() - start
    note = f"{len(positions) * _STEP:.0f} m, {loaded} loaded; {_entered(drive.world, positions)}"
    _add_paging(result, f"paging in any frame, {drive.world.objects:,} objects, along a corridor", seconds, pace, note)


def _add_paging(result: Benchmark, name: str, seconds: Float64, pace: float, note: str) -> None:
    middle, p95, longest = (float(value) for value in np.percentile(1e3 * seconds, (50, 95, 100)))
    note = f"median {middle:.2f}, p95 {p95:.2f}; {note}"
    result.add(f"{name}, at most", value=longest, unit="ms", asked=scaled(20.0, pace), note=note)


def _entered(world: rooms.Rooms, positions: Float64) -> str:
    return f"{np.count_nonzero(np.diff(world.index.regions.locate(positions)))} rooms and pieces of corridor entered"


def _report_equality(result: Benchmark, drive: PagedDrive, frames: int) -> None:
    pair, live = sensors(), AllLive(drive.world)
    rays = differing = on_edges = 0
    for number in range(0, len(drive.poses), max(len(drive.poses) // frames, 1)):
        T_map_base = drive.poses[number]
        poses, found = mounted(pair, T_map_base, number), live.cast(pair, T_map_base, number)
        for sensor, T, hits in zip(pair, poses, found, strict=True):
            paged = drive.scene.cast(sensor.bundle, T, sensor.reach)
            counts = live.differing(paged, hits)
            rays, differing, on_edges = rays + len(sensor.bundle), differing + counts[0], on_edges + counts[1]
    live.scene.close()
    name = f"{drive.world.objects:,} objects: rays that differ from all being live"
    note = f"of {rays:,}, in object or by 1e-6 of the distance; {on_edges} name the other face of an edge"
    result.add(name, value=differing, unit="rays", asked=0.0, note=note)


def _cast_at_whole_worlds(
    result: Benchmark,
    worlds: dict[int, rooms.Rooms],
    counts: Sequence[int],
    meshes: Sequence[TriangleMesh],
    options: Options,
) -> None:
    """The same casts against scenes that hold everything, in turn."""
    pair, scenes = sensors(), []
    before = _resident()
    for count in counts:
        world = worlds.get(count) or rooms.build(count, meshes, options.seed)
        if AllLive.size(world) > MAX_INSTANCE:
            result.notes.append(f"A scene holds {MAX_INSTANCE:,} instances: {world.objects:,} objects were left out.")
            break
        options.say(f"making {world.objects:,} objects live")
        scenes.append(AllLive(world))
    memory = (_resident() - before) / sum(AllLive.size(s.world) for s in scenes)
    frames = range(10)[::3] if options.quick else range(_FRAMES)[::6]
    drives = [rooms.drive(scene.world, frames[-1] + 1, _STEP) for scene in scenes]
    times = np.empty((2, len(frames), len(scenes)))
    for turn in range(-1, len(frames)):  # the first turn does not count
        for k, scene in enumerate(scenes):
            start = np.array([time.process_time(), time.perf_counter()])
            scene.cast(pair, drives[k][frames[turn]], frames[turn])
            times[:, turn, k] = np.array([time.process_time(), time.perf_counter()]) - start
    sizes = np.array([AllLive.size(scene.world) for scene in scenes], float)
    cpu, wall = np.median(times, axis=1)
    for k, scene in enumerate(scenes):
        name = f"casts, all live: {scene.world.objects:,} objects, {sizes[k]:,.0f} instances"
        result.add(name, Timing(float(cpu[k]), float(wall[k]), len(frames)))
        scene.scene.close()
    medians = 1e3 * cpu
    result.notes.append(f"A live instance takes {memory:.0f} bytes.")
    result.series |= {"live.instances": sizes.tolist(), "live.casts_ms": medians.tolist()}
    result.series["live.objects"] = [float(scene.world.objects) for scene in scenes]
    _fit(result, sizes, medians)


def _fit(result: Benchmark, sizes: Float64, milliseconds: Float64) -> None:
    """Least squares of ``c + a log m``; whether the largest scene takes longer than the others let expect."""
    terms = np.stack([np.ones_like(sizes), np.log10(sizes)], axis=1)
    (c, a), *_ = np.linalg.lstsq(terms, milliseconds)
    residual = float(np.sqrt(np.mean((terms @ (c, a) - milliseconds) ** 2)))
    name = f"c + a log10 m for all live: {c:.2f} + {a:.2f} log10 m ms, RMS residual"
    result.add(name, value=residual, unit="ms", note=f"{100 * residual / milliseconds.mean():.1f} % of the mean")
    result.series["live.fit"] = [float(c), float(a), residual]
    if len(sizes) > 2:
        (c, a), *_ = np.linalg.lstsq(terms[:-1], milliseconds[:-1])
        excess = float(milliseconds[-1] / (terms[-1] @ (c, a)))
        name = f"{sizes[-1]:,.0f} instances : the fit to the smaller scenes"
        result.add(name, value=excess, unit="x", asked=1.05, note="no faster than log m, 5 % for the noise of a run")


def _resident() -> float:
    """Resident memory of the process, bytes."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()


def _plot(series: dict[str, list[float]], path: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 4.2), layout="constrained")
    axes = figure.add_subplot()
    axes.plot(series["paged.objects"], series["paged.frame_ms"], "o-", label="paged: whole frame")
    axes.plot(series["paged.objects"], series["paged.casts_ms"], "o-", label="paged: paging and casts")
    axes.plot(series["live.objects"], series["live.casts_ms"], "s-", label="all live: casts")
    c, a, _ = series["live.fit"]
    axes.plot(
        series["live.objects"], c + a * np.log10(series["live.instances"]), "k:", label=f"{c:.1f} + {a:.1f} log m"
    )
    axes.set(xscale="log", xlabel="objects in the world", ylabel="CPU time, ms")
    axes.set_ylim(0.0, 1.1 * axes.get_ylim()[1])
    axes.grid(alpha=0.3)
    axes.legend()
    figure.savefig(path, dpi=120)
