"""``simtrack bench tracking``: the tracking paper's frame, and the tracker that does the same with less.

The paper's frame (its section IV): four times, all 640x480 rays of the camera and the 29,184 of a VLP-16 turn are
traced at the office, and five objects are registered to what they met. The adaptive tracker casts what its objects'
windows hold, coarse ones first, and ends with a single cast at full resolution.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np

from simtrack.benchmarks import office as scenes
from simtrack.benchmarks.harness import Benchmark, Options, Timing, measure
from simtrack.benchmarks.yardstick import scaled, yardstick
from simtrack.contracts import Float32, Float64, Int32
from simtrack.geometry.transforms import inverse, perturb
from simtrack.perception.tracking import correspondences as kernels
from simtrack.perception.tracking import solver
from simtrack.perception.tracking.registration import Registration, RegistrationResult, TrackedModel
from simtrack.perception.tracking.registration_config import RegistrationConfig
from simtrack.raycast import RayHits, RayScene
from simtrack.sensors.depth_noise import apply_depth_noise, preset

PUBLIC_PARTS = 1.25
"""Seconds of CPU of this frame built from the best public C++ parts (rmagine), where the yardstick is its reference."""
ITERATIONS = 4
LIDAR_SIGMA = 0.01
"""Standard deviation of a lidar range, metres."""
PREDICTION_SHIFT, PREDICTION_TURN, PREDICTION_SPREAD = 0.001, np.deg2rad(0.35), 1.25
"""Median error of a track's prediction, metres and radians, and the standard deviation of its logarithm: what the
workbench's closed loop shows."""
GATES = (0.06, 0.03, 0.02, 0.02)
"""Largest distances of correspondences, metres, by iteration."""


@dataclass
class _Sensor:
    """A sensor's rays in the camera's frame, and what it measured."""

    rays: scenes.RayBundle
    T_camera_sensor: Float64
    sigma: float
    """Standard deviation of its readings, metres; 0: that of a depth camera."""
    readings: Float32 = field(default_factory=lambda: np.empty(0, np.float32))

    def __post_init__(self) -> None:
        self.hits = RayHits.empty(len(self.rays))
        self.pixels: Int32 = np.arange(len(self.rays), dtype=np.int32)
        self.rows: Int32 = np.empty(len(self.rays), np.int32)
        rotation = self.T_camera_sensor[:3, :3].astype(np.float32)
        self.directions = np.ascontiguousarray(self.rays.directions @ rotation.T)
        self.origin = self.T_camera_sensor[:3, 3].copy()

    def cast(self, scene: RayScene, changed: Sequence[int] | None = None) -> None:
        """Trace all rays, or those on which changed instances make a difference to the last hits."""
        scene.cast(self.rays, self.T_camera_sensor, out=self.hits, changed=changed)


class PaperFrame:
    """The paper's frame on the benchmark's office, in the camera's frame; solvers are exchangeable."""

    def __init__(self, rng: np.random.Generator) -> None:
        """Pose the office and measure it once with noise."""
        world = scenes.office()
        T_camera_map = inverse(world.T_map_camera)
        self.names = list(world.objects)
        self.truth = np.array([T_camera_map @ world.T_map_object[name] for name in self.names])
        self.radii = np.array([0.5 * float(np.linalg.norm(np.ptp(m.vertices, axis=0))) for m in world.objects.values()])
        self.scene = RayScene()
        self.scene.add(world.meshes["static"], T_camera_map, instance=len(self.names))
        for k, name in enumerate(self.names):
            self.scene.add(world.meshes[name], self.truth[k], instance=k)
        self.camera = _Sensor(scenes.pinhole(), np.eye(4), 0.0)
        self.lidar = _Sensor(scenes.vlp16(), T_camera_map @ world.T_map_lidar, LIDAR_SIGMA)
        K = scenes.CAMERA
        self.intrinsics = np.array([K.fx, K.fy, K.cx, K.cy])
        self.pixel_noise = K.fx * 0.075
        for sensor in (self.camera, self.lidar):
            sensor.cast(self.scene)
            sensor.readings = self._noisy(sensor, rng)
        rays = len(self.camera.rays) + len(self.lidar.rays)
        self.points, self.edges = kernels.Points.room(rays), kernels.Edges.room(0)
        self.rays = rays

    def _noisy(self, sensor: _Sensor, rng: np.random.Generator) -> Float32:
        ranges = np.where(np.isfinite(sensor.hits.distances), sensor.hits.distances, 0.0).astype(np.float64)
        sigma = np.full(len(ranges), sensor.sigma)
        if sensor.sigma == 0.0:
            sigma = np.sqrt([kernels.axial_variance(max(z, 0.4), 0.8, self.pixel_noise) for z in ranges])
        noisy = np.where(ranges > 0.0, ranges + sigma * rng.standard_normal(len(ranges)), 0.0)
        return np.maximum(noisy, 0.0).astype(np.float32)

    def start(self, rng: np.random.Generator, shift: float = 0.02, turn: float = np.deg2rad(3.0)) -> Float64:
        """Poses (K, 4, 4) off by `shift` metres and `turn` radians in random directions."""
        offsets = rng.standard_normal((len(self.truth), 2, 3))
        offsets /= np.linalg.norm(offsets, axis=2, keepdims=True)
        steps = [np.concatenate([shift * o[0], turn * o[1]]) for o in offsets]
        return np.array([perturb(T, xi) for T, xi in zip(self.truth, steps, strict=True)])

    def errors(self, poses: Float64) -> Float64:
        """(K,) distances of the poses' origins from the true ones, metres."""
        return np.linalg.norm(poses[:, :3, 3] - self.truth[:, :3, 3], axis=1)

    def image(self, rng: np.random.Generator) -> Float32:
        """(H, W), what the depth camera reads of the true poses: the sensor's own noise, correlated as it is."""
        self.cast(self.truth)
        K, hits = scenes.CAMERA, self.camera.hits
        depth = np.where(hits.hit, hits.distances, np.float32(0.0)).reshape(K.height, K.width)
        return apply_depth_noise(depth, hits.normals.reshape(*depth.shape, 3), K, preset("xtion"), rng)

    def registration(self, config: RegistrationConfig) -> Registration:
        """The tracker's registration of the objects, instances by their number.

        The office's furniture is no instance of it: its rays tell of occlusion by their depth alone.
        """
        out, world = Registration(config), scenes.office()
        for k, name in enumerate(self.names):
            vertices = world.objects[name].vertices
            low, high = vertices.min(axis=0), vertices.max(axis=0)
            corners = np.array([[(low, high)[i >> a & 1][a] for a in range(3)] for i in range(8)])
            out.add(k, TrackedModel(world.meshes[name], corners, float(self.radii[k])))
        return out

    def cast(self, poses: Float64, *, again: bool = False) -> None:
        """Bring both sensors' hits up to date with the objects at `poses`.

        `again` says that nothing but the objects has moved since the last cast: rays that neither met an object then
        nor may meet one now have kept their hits, and are not traced.
        """
        self.scene.set_poses(range(len(poses)), poses)
        for sensor in (self.camera, self.lidar):
            sensor.cast(self.scene, range(len(poses)) if again else None)

    def correspond(self, gate: float) -> int:
        """Pair all rays of both sensors; returns the number of pairs."""
        count, pairs = len(self.names), 0
        row = np.append(np.arange(count, dtype=np.int32), np.int32(-1))
        counts = np.zeros((count, kernels.FIELDS), np.int64)
        for sensor in (self.camera, self.lidar):
            kernels.rows_of(sensor.hits.instances, row, sensor.rows)
            pairs = kernels.point_correspondences(
                sensor.pixels, sensor.directions, sensor.hits.distances, sensor.hits.normals, sensor.rows,
                sensor.readings, scenes.CAMERA.width, np.ones(count, np.int64), gate, 1.0, sensor.sigma, 0.0005,
                self.pixel_noise, 0.4 / self.intrinsics[0], sensor.origin, self.points, pairs, counts,
            )  # fmt: skip
        return pairs

    def solve(self, poses: Float64, pairs: int, method: Literal["gauss-newton", "umeyama"]) -> None:
        """Move the poses, in place: three Gauss-Newton steps, or the paper's ten Umeyama fits."""
        count = len(poses)
        centres, shifts = poses[:, :3, 3].copy(), np.zeros((count, 3))
        rotations = np.tile(np.eye(3), (count, 1, 1))
        covariance, active = np.tile(np.eye(6), (count, 1, 1)), np.ones(count, bool)
        if method == "umeyama":
            solver.umeyama(self.points, pairs, centres, rotations, shifts, 10)
        else:
            settings = solver.SolverSettings(4.0, 3.0, solver.EDGES_NEVER, 0.0015, 0.01, 0.03, np.deg2rad(5.0), 0.0)
            solver.gauss_newton(
                self.points, pairs, self.edges, 0, self.intrinsics, centres, rotations, shifts, self.radii,
                np.ones((count, 2)), active, settings, 3, covariance, np.zeros(count, np.int64), np.zeros((count, 3)),
            )  # fmt: skip
        solver.advance(poses, rotations, shifts, self.radii, covariance, active, np.zeros(count), np.zeros(count))

    def track(
        self,
        poses: Float64,
        method: Literal["gauss-newton", "umeyama"] = "gauss-newton",
        watch: Callable[[Float64], None] = lambda poses: None,
    ) -> Float64:
        """The whole frame from `poses`; `watch` sees the poses after each iteration."""
        poses = poses.copy()
        for iteration in range(ITERATIONS):
            self.cast(poses, again=iteration > 0)
            self.solve(poses, self.correspond(GATES[iteration]), method)
            watch(poses)
        return poses


def run(options: Options) -> Benchmark:
    """Measure; see the module."""
    result = Benchmark("tracking")
    rng = np.random.default_rng(options.seed)
    options.say("building the office")
    frame = PaperFrame(rng)
    start = frame.start(rng)
    repeats = 3 if options.quick else 15
    reference = yardstick(options.say)
    result.add("yardstick: embreex, 640x480 rays with normals", value=1e3 * reference, unit="ms")

    options.say("the paper's frame")
    frame.track(start, "umeyama")
    pairs = frame.correspond(GATES[-1])
    timings = measure(
        {
            "paper's frame: 4 casts of 336,384 rays, 5 objects": lambda: frame.track(start),
            "... with the paper's 10 Umeyama fits": lambda: frame.track(start, "umeyama"),
            "one cast of all rays": lambda: frame.cast(start),
            "one pairing of all rays": lambda: frame.correspond(GATES[0]),
            "one solution, three Gauss-Newton steps": lambda: frame.solve(start.copy(), pairs, "gauss-newton"),
        },
        repeats,
    )
    for number, (name, timing) in enumerate(timings.items()):
        result.add(name, timing, asked=scaled(0.1, reference) if number == 0 else None)
    whole = next(iter(timings.values())).cpu
    times = scaled(PUBLIC_PARTS, reference) / whole
    result.add("... times faster than built from public C++ parts", value=times, unit="x", asked=12.0, sense="at least")
    _convergence(result, frame, start)
    _adaptive(result, frame, rng, options, reference)
    result.notes.append("The public parts' 1.25 s were measured elsewhere and are scaled by the yardstick.")
    return result


def _convergence(result: Benchmark, frame: PaperFrame, start: Float64) -> None:
    for method in ("gauss-newton", "umeyama"):
        errors = [float(np.median(frame.errors(start)))]
        frame.track(start, method, lambda poses, errors=errors: errors.append(float(np.median(frame.errors(poses)))))
        result.series[f"error.{method}"] = errors
        result.add(f"median error after the paper's frame, {method}", value=1e3 * errors[-1], unit="mm")
    result.plots["tracking_error.png"] = lambda path: _plot(result, path)


def _plot(result: Benchmark, path: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.0, 3.6), layout="constrained")
    axes = figure.subplots()
    for method, label in (("gauss-newton", "Gauss-Newton, 3 steps"), ("umeyama", "the paper's Umeyama, 10 fits")):
        axes.semilogy([1e3 * e for e in result.series[f"error.{method}"]], "o-", label=label)
    axes.set(xlabel="ray-cast iteration", ylabel="median error, mm", xticks=range(ITERATIONS + 1))
    axes.grid(True, which="both", alpha=0.3)
    axes.legend()
    figure.savefig(path, dpi=120)


def _adaptive(
    result: Benchmark, frame: PaperFrame, rng: np.random.Generator, options: Options, reference: float
) -> None:
    """The tracker's registration of the five objects, as it is and at full resolution to the end."""
    options.say("the adaptive tracker")
    images, starts = [], []
    timed, looked_at = (4, 4) if options.quick else (12, 60)
    for _ in range(looked_at):
        images.append(frame.image(rng))
        shift, turn = np.exp(PREDICTION_SPREAD * rng.standard_normal(2)) * (PREDICTION_SHIFT, PREDICTION_TURN)
        starts.append(dict(enumerate(frame.start(rng, float(shift), float(turn)))))

    adaptive = frame.registration(RegistrationConfig())
    thorough = frame.registration(RegistrationConfig(max_rays=len(frame.camera.rays)))

    def run_all(register: Callable[..., Mapping[int, RegistrationResult]], count: int = timed) -> Float64:
        found = [register(image, scenes.CAMERA, poses) for image, poses in zip(images[:count], starts, strict=False)]
        return np.array([frame.errors(np.array([r[k].T_camera_object for k in sorted(r)])) for r in found])

    ways = {
        "adaptive tracker, 5 visible objects, a frame": partial(run_all, adaptive.track),
        "... with every pixel and the whole schedule": partial(run_all, thorough.register),
    }
    errors = {name: 1e3 * float(np.median(way(looked_at))) for name, way in ways.items()}
    for name, timing in measure(ways, 2 if options.quick else 5).items():
        each = Timing(timing.cpu / timed, timing.wall / timed, timing.repeats * timed)
        asked = scaled(0.02, reference) if name in list(ways)[:1] else None
        result.add(name, each, asked=asked, note=f"median error {errors[name]:.3f} mm")
    first, second = errors.values()
    result.add("median error, adaptive / every pixel", value=first / second, unit="x", asked=1.05)
    adaptive.close()
    thorough.close()
