"""``simtrack bench localization``: MICP-L corrections of a VLP-16 scan on the office floor, beside point-cloud peers.

One scan without noise is registered from starts that are 0.10 m and 3 deg off: time of one correction (a cast and five
Gauss-Newton steps), error after each cast, and the same with the closed-form fit to projected points (Umeyama) that
rmcl and the tracking paper use. `small_gicp` and `Open3D` register the same scan to the map as a cloud, from the same
starts. Last, the whole localizer follows a drive with sensor noise.
"""

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from simtrack.benchmarks.harness import Benchmark, Options, Timing, measure
from simtrack.benchmarks.office import Office, office
from simtrack.benchmarks.yardstick import scaled, yardstick
from simtrack.contracts import NANOSECONDS, Float64, LidarScan, StaticMap
from simtrack.geometry.meshes import Mesh
from simtrack.geometry.transforms import difference, perturb, transform, transform_planar, yaw_of
from simtrack.objects.tiago import LIDAR, TUCKED, tiago
from simtrack.perception.localization import MeshLocalizer, MotionConfig, RegistrationConfig
from simtrack.perception.localization.measurement import Measurement, deskew
from simtrack.perception.localization.motion import OdometryTrack
from simtrack.perception.localization.registration import Registration, register
from simtrack.perception.localization.surface import MapSurface
from simtrack.perception.self_filter import SelfFilter
from simtrack.raycast import RayBundle
from simtrack.sensors.lidar import VLP16, LidarNoiseConfig, LidarShots, apply_lidar_noise
from simtrack.sensors.odometry import OdometryNoiseConfig, OdometrySensor

OFFSET, TURN = 0.10, np.radians(3.0)
"""Metres and radians by which starts are off."""
CASTS = 4
"""Ray-casting iterations that are looked at."""
ASKED_TIME, ASKED_ERROR = 0.004, 0.5
"""Seconds of a correction where the yardstick is its reference; millimetres after two casts."""
_PRIOR = np.diag(np.square([OFFSET, OFFSET, 0.01, 0.01, 0.01, TURN]))
"""(6, 6) covariance that the starts are given with."""


def run(options: Options) -> Benchmark:
    """Measure; see the module."""
    result = Benchmark("localization")
    options.say("building the office and its map")
    site = Site.build(options.quick)
    shots = site.measured()
    rng = np.random.default_rng(options.seed)
    starts = [_start(site.T_map_base, rng) for _ in range(2 if options.quick else 12)]
    repeats = 3 if options.quick else 21

    options.say("convergence")
    _convergence(result, site, shots, starts)
    asked = None if options.quick else scaled(ASKED_TIME, yardstick(options.say))
    options.say("corrections")
    _corrections(result, site, shots, starts[0], asked, repeats)
    options.say("peers")
    _peers(result, site, shots, starts, repeats, options.threads)
    options.say("a drive")
    _drive(result, site, 5 if options.quick else 60, rng)
    result.notes.append(
        "rmcl 2.4 (C++, one thread) needed 9.0 ms for a correction of five inner iterations on such a floor, on an "
        "AVX-512 machine on which embreex needed 58 ms for the pinhole scan with normals."
    )
    return result


# --------------------------------------------------------------------------------------------------------------- set-up


@dataclass(frozen=True, slots=True, eq=False)
class Site:
    """The office as the localizer's map, and a robot in it."""

    localizer: MeshLocalizer
    robot: SelfFilter
    T_map_base: Float64
    """(4, 4), where the robot stands."""
    T_base_lidar: Float64
    """(4, 4)."""
    joints: dict[str, float]

    @staticmethod
    def build(small: bool = False) -> "Site":
        """Build the map; only what lies within 12 m of the robot if `small`."""
        world, robot, joints = office(), tiago(), dict(TUCKED)
        mesh = _around(world, 12.0) if small else world.static
        static_map = StaticMap(mesh.vertices.astype(np.float32), mesh.faces.astype(np.int32), noise=0.005)
        body = SelfFilter(robot)
        localizer = MeshLocalizer(static_map, lidar_mask=lambda scan: body.lidar_mask(scan, joints))
        T, x, y = world.T_map_lidar, *world.T_map_lidar[:2, 3]
        return Site(localizer, body, transform_planar(x, y, yaw_of(T)), robot.forward(joints)[LIDAR], joints)

    @property
    def surface(self) -> MapSurface:
        """The map that rays are cast at."""
        return self.localizer.surface

    def measured(self) -> Measurement:
        """The 29,184 shots of a turn as drivers pack it, from `T_map_base`, without noise."""
        shots = VLP16.shots(columns=VLP16.driver_columns)
        scan = self.scan(shots, 0, np.broadcast_to(self.T_map_base, (len(shots), 4, 4)))
        return deskew(scan, OdometryTrack(MotionConfig()), 0.008, 0.3, 100.0)

    def scan(
        self,
        shots: LidarShots,
        stamp: int,
        T_map_base: Float64,
        noise: tuple[LidarNoiseConfig, np.random.Generator] | None = None,
    ) -> LidarScan:
        """One turn that starts at `stamp` nanoseconds, each shot taken from its own pose (N, 4, 4)."""
        T = T_map_base @ self.T_base_lidar
        directions = np.einsum("nij,nj->ni", T[:, :3, :3], shots.directions)
        packing = RayBundle.from_directions(shots.directions, groups=shots.rings)
        hits = self.surface.scene.cast_rays(T[:, :3, 3], directions, packing=packing)
        ranges = hits.distances
        if noise is not None:
            incidence = np.arccos(np.minimum(np.abs(np.einsum("ij,ij->i", hits.normals, directions)), 1.0))
            ranges = apply_lidar_noise(ranges, None, *noise, incidence)
        none = np.zeros(len(shots), np.float32)
        return LidarScan(stamp, shots.directions, ranges, shots.times, shots.rings, none, self.T_base_lidar)

    def errors(self, T_map_base: Float64) -> tuple[float, float]:
        """Millimetres and degrees from the truth."""
        gap = difference(T_map_base, self.T_map_base)
        return 1e3 * float(np.linalg.norm(gap[:3])), float(np.degrees(np.linalg.norm(gap[3:])))


def _around(world: Office, radius: float) -> Mesh:
    centres = world.static.vertices[world.static.faces].mean(axis=1)
    faces = world.static.faces[np.linalg.norm(centres - world.T_map_lidar[:3, 3], axis=1) < radius]
    used, renumbered = np.unique(faces, return_inverse=True)
    return Mesh(world.static.vertices[used], renumbered.reshape(-1, 3).astype(np.int32))


def _start(T: Float64, rng: np.random.Generator) -> Float64:
    """(4, 4) pose that is off by `OFFSET` in a random direction on the floor and by `TURN` to a random side."""
    heading, side = rng.uniform(-np.pi, np.pi), rng.choice([-1.0, 1.0])
    return perturb(T, np.array([OFFSET * np.cos(heading), OFFSET * np.sin(heading), 0.0, 0.0, 0.0, side * TURN]))


# ---------------------------------------------------------------------------------------------------------- convergence


def _convergence(result: Benchmark, site: Site, shots: Measurement, starts: list[Float64]) -> None:
    config = replace(RegistrationConfig(), settled=1e-9)
    errors = {"gauss-newton": np.empty((len(starts), CASTS)), "umeyama": np.empty((len(starts), CASTS))}
    for row, start in enumerate(starts):
        T = start
        for cast in range(CASTS):
            found = register(shots, site.surface, start, _PRIOR, config, strides=(1,) * (cast + 1))
            T = umeyama(shots, site.surface, T, config.inner_iterations)
            errors["gauss-newton"][row, cast] = site.errors(found.T_map_base)[0]
            errors["umeyama"][row, cast] = site.errors(T)[0]
    for method, values in errors.items():
        for kind, figures in (("median", np.median(values, axis=0)), ("worst", values.max(axis=0))):
            result.series[f"{method}.error_mm.{kind}"] = [float(value) for value in figures]
        for cast in range(CASTS):
            worst = float(values[:, cast].max())
            note = f"worst of {len(starts)} starts; median {np.median(values[:, cast]):.2g} mm"
            asked = ASKED_ERROR if (method, cast) == ("gauss-newton", 1) else None
            casts = f"{cast + 1} cast{'s' if cast else ''}"
            result.add(f"error after {casts}: {method}", value=worst, unit="mm", asked=asked, note=note)
    result.plots["localization_error.png"] = partial(_plot, result.series)


def umeyama(shots: Measurement, surface: MapSurface, T: Float64, iterations: int, gate: float = 1.0) -> Float64:
    """One correction as rmcl makes it: closed-form rigid fits of the points to their projections on the planes.

    Args:
        shots: in the base frame.
        surface: the map.
        T: (4, 4) T_map_base to correct.
        iterations: fits on the correspondences of the one cast (Umeyama 1991, eqs. 40-42, without scale).
        gate: metres, correspondences farther apart are left out.

    Returns:
        (4, 4) T_map_base.
    """
    pairs, count = surface.pair(T, surface.cast(T, shots), gate, RegistrationConfig().pointing_sigma)
    points, normals = pairs[:3, :count].T.astype(np.float64), pairs[3:6, :count].T.astype(np.float64)
    distances, motion = pairs[6, :count].astype(np.float64), np.eye(4)
    for _ in range(iterations):
        moved = points @ motion[:3, :3].T + motion[:3, 3]
        off = distances + np.einsum("ij,ij->i", normals, moved - points)
        projected = moved - off[:, None] * normals
        mean, target = moved.mean(axis=0), projected.mean(axis=0)
        U, _, Vt = np.linalg.svd((projected - target).T @ (moved - mean))
        R = (U * [1.0, 1.0, np.linalg.det(U) * np.linalg.det(Vt)]) @ Vt
        motion = transform(R, target - R @ mean) @ motion
    return transform(motion[:3, :3] @ T[:3, :3], T[:3, 3] + motion[:3, 3])


def _plot(series: dict[str, list[float]], path: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 4.2), layout="constrained")
    axes = figure.add_subplot()
    casts = np.arange(1, CASTS + 1)
    for method, style, label in (
        ("gauss-newton", "o-", "Gauss-Newton, point to plane"),
        ("umeyama", "s-", "projected points and Umeyama"),
    ):
        line = axes.plot(casts, series[f"{method}.error_mm.median"], style, label=label)[0]
        median, worst = series[f"{method}.error_mm.median"], series[f"{method}.error_mm.worst"]
        axes.fill_between(casts, median, worst, color=line.get_color(), alpha=0.2, linewidth=0)
    axes.axhline(ASKED_ERROR, color="0.5", linestyle=":", linewidth=1)
    axes.set(yscale="log", xticks=casts, xlabel="ray-casting iterations", ylabel="error, mm: median to worst")
    axes.grid(alpha=0.3)
    axes.legend()
    figure.savefig(path, dpi=120)


# ---------------------------------------------------------------------------------------------- corrections, and peers


def _corrected(site: Site, shots: Measurement, T: Float64, strides: tuple[int, ...]) -> Registration:
    return register(shots, site.surface, T, _PRIOR, RegistrationConfig(), strides=strides)


def _corrections(
    result: Benchmark, site: Site, shots: Measurement, start: Float64, asked: float | None, repeats: int
) -> None:
    contestants: dict[str, Callable[[], object]] = {
        "all": lambda: _corrected(site, shots, start, (1,)),
        "cast": lambda: site.surface.cast(start, shots, reach=np.inf),
        "half": lambda: _corrected(site, shots, start, (2,)),
    }
    timings = measure(contestants, repeats, primed=True)
    steps = _corrected(site, shots, start, (1,)).steps
    name = f"correction, {len(shots):,} rays, {steps} steps"
    result.add(name, timings["all"], asked=asked, note="one cast, all rays")
    result.add("correction: of which casting", timings["cast"])
    result.add("correction on half of the rays", timings["half"], note="as the localizer's last iteration")


def _peers(
    result: Benchmark, site: Site, shots: Measurement, starts: list[Float64], repeats: int, threads: int
) -> None:
    """Times from the first start; final errors over all starts."""
    strides = RegistrationConfig().strides
    aligners: dict[str, Callable[[Float64], Float64]] = {
        "simtrack": lambda T: _corrected(site, shots, T, strides).T_map_base
    }
    for name, prepare in (("small_gicp", _small_gicp), ("Open3D", _open3d)):
        try:
            aligners |= prepare(site.surface.static_map, shots.points, threads)
        except ImportError:
            result.notes.append(f"{name} is not installed (extra bench): no comparison with it.")
    timings = measure({name: partial(align, starts[0]) for name, align in aligners.items()}, repeats, primed=True)
    for name, align in aligners.items():
        final = [site.errors(align(T)) for T in starts]
        millimetres, degrees = np.median(final, axis=0)
        note = f"median error {millimetres:.2g} mm, {degrees:.2g} deg"
        result.add(f"scan to map: {name}", timings[name], note=note)
        result.series[f"final_error_mm.{name}"] = [error for error, _ in final]
        if name != "simtrack":
            ratio = timings[name].cpu / timings["simtrack"].cpu
            result.add(f"{name} / simtrack", value=ratio, unit="x", note="CPU time")


def _small_gicp(static_map: StaticMap, points: Float64, threads: int) -> dict[str, Callable[[Float64], Float64]]:
    """Registration to the middles of the map's faces; the map is prepared once, the scan each time."""
    import small_gicp  # pyright: ignore[reportMissingImports] - extra `bench`

    resolution = 0.1
    centres = static_map.vertices.astype(np.float64)[static_map.faces].mean(axis=1)
    target, tree = small_gicp.preprocess_points(centres, downsampling_resolution=resolution, num_threads=threads)

    def align(kind: str, T: Float64) -> Float64:
        source, _ = small_gicp.preprocess_points(points, downsampling_resolution=resolution, num_threads=threads)
        found = small_gicp.align(
            target, source, tree, T, registration_type=kind, max_correspondence_distance=1.0, num_threads=threads
        )
        return np.asarray(found.T_target_source, dtype=np.float64)

    return {"small_gicp GICP": partial(align, "GICP"), "small_gicp plane ICP": partial(align, "PLANE_ICP")}


def _open3d(static_map: StaticMap, points: Float64, threads: int) -> dict[str, Callable[[Float64], Float64]]:
    """Point-to-plane ICP to the middles of the map's faces with the faces' normals."""
    import open3d  # pyright: ignore[reportMissingImports] - extra `bench`

    geometry, registration = open3d.geometry, open3d.pipelines.registration
    corners = static_map.vertices.astype(np.float64)[static_map.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    target = geometry.PointCloud(open3d.utility.Vector3dVector(corners.mean(axis=1)))
    target.normals = open3d.utility.Vector3dVector(normals / np.linalg.norm(normals, axis=1)[:, None])
    source = geometry.PointCloud(open3d.utility.Vector3dVector(points))

    def align(T: Float64) -> Float64:
        method = registration.TransformationEstimationPointToPlane()
        return np.asarray(registration.registration_icp(source, target, 1.0, T, method).transformation)

    return {"Open3D point-to-plane": align}


# ------------------------------------------------------------------------------------------------------- whole updates


def _drive(result: Benchmark, site: Site, scans: int, rng: np.random.Generator) -> None:
    """The localizer on a circle of 0.6 m at 0.3 m/s, with the noise of lidar and wheels, the robot's body masked."""
    wheels, shots = OdometrySensor(OdometryNoiseConfig(), rng), VLP16.shots()
    noise = LidarNoiseConfig(), rng
    site.localizer.reset()
    site.localizer.initialise(0, _on_circle(site.T_map_base, 0.0), np.diag(np.square([0.02] * 3 + [0.01] * 3)))
    cpu, wall, errors, reading = [], [], [], 0
    for number in range(scans):
        start = number * VLP16.period
        poses = np.stack(
            [_on_circle(site.T_map_base, (start + k * VLP16.period / 64) / NANOSECONDS) for k in range(65)]
        )
        phase = shots.times.astype(np.float64) * NANOSECONDS / VLP16.period * 64
        below = np.minimum(phase.astype(int), 63)
        share = (phase - below)[:, None, None]
        scan = site.scan(shots, start, (1.0 - share) * poses[below] + share * poses[below + 1], noise)
        while reading <= start + VLP16.period:
            site.localizer.predict(wheels.read(reading, _on_circle(site.T_map_base, reading / NANOSECONDS)))
            reading += wheels.period
        cpu_start, wall_start = time.process_time(), time.perf_counter()
        answer = site.localizer.update(scan)
        wall.append(time.perf_counter() - wall_start)
        cpu.append(time.process_time() - cpu_start)
        gap = difference(answer.T_map_base, _on_circle(site.T_map_base, answer.stamp / NANOSECONDS))
        errors.append(1e3 * float(np.linalg.norm(gap[:3])))
    first = min(len(cpu) - 1, 3)  # caches
    timing = Timing(statistics.median(cpu[first:]), statistics.median(wall[first:]), len(cpu) - first)
    result.add("update of the localizer", timing, note="mask, de-skewing, casts, covariance; ten a second")
    rmse = float(np.sqrt(np.mean(np.square(errors))))
    result.add("update: RMS position error", value=rmse, unit="mm", note=f"{scans} scans with noise, driving")
    result.series["update.cpu_ms"] = [1e3 * seconds for seconds in cpu]
    result.series["update.error_mm"] = errors


def _on_circle(T_map_base: Float64, seconds: float | Float64) -> Float64:
    """(..., 4, 4) poses after so many seconds of a drive that starts at `T_map_base`."""
    speed, radius = 0.3, 0.6
    angle = np.asarray(speed / radius * seconds, dtype=np.float64)
    motion = np.zeros((*angle.shape, 4, 4))
    motion[..., 0, 0] = motion[..., 1, 1] = np.cos(angle)
    motion[..., 1, 0], motion[..., 0, 1] = np.sin(angle), -np.sin(angle)
    motion[..., 2, 2] = motion[..., 3, 3] = 1.0
    motion[..., 0, 3], motion[..., 1, 3] = radius * np.sin(angle), radius * (1.0 - np.cos(angle))
    return T_map_base @ motion
