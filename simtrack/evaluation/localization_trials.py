"""Trials of a localizer: it starts wrong, or is carried off, while the robot drives through a building.

Only what localization needs is simulated (lidar and wheel odometry over a drive along the floor plan, no physics), so
that many trials fit into minutes. The verdicts are those of the project's acceptance: recovered means closer than 5 cm
and 1 deg for good; confident and wrong means that the localizer says OK while it is not.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

import numpy as np

from simtrack.contracts import NANOSECONDS, Bool, Float64, LidarScan, Localization, Localizer, StaticMap, Status
from simtrack.errors import InvalidValueError
from simtrack.geometry.kinematics import KinematicTree
from simtrack.geometry.transforms import difference, inverse, perturb, transform_planar
from simtrack.raycast import RayBundle, RayScene, TriangleMesh
from simtrack.sensors.lidar import VLP16, LidarModel, LidarNoiseConfig, apply_lidar_noise
from simtrack.sensors.odometry import OdometryNoiseConfig, OdometrySensor

if TYPE_CHECKING:
    from simtrack.simulation.building.parts import StaticWorld

Kind = Literal["wrong-start", "kidnapped"]


@dataclass(frozen=True, slots=True)
class TrialConfig:
    """What is tried, and what counts."""

    start_offset: float = 0.5
    """m, in a random direction, by which a wrong start is off."""
    start_turn: float = np.radians(10.0)
    """rad, to a random side."""
    start_limit: float = 10.0
    """s in which a wrong start must be corrected ..."""
    start_duration: float = 16.0
    """... in a drive of so many s, in all the rest of which it must stay so."""
    tracked: float = 2.0
    """s of undisturbed driving before the robot is carried off."""
    kidnap_limit: float = 30.0
    """s in which a kidnapped robot must know its place."""
    settled: float = 3.0
    """s that a kidnapped robot's new pose must hold; the trial ends then."""
    translation: float = 0.05
    """m: closer is right."""
    rotation: float = np.radians(1.0)
    """rad: closer is right."""
    wrong_translation: float = 0.25
    """m: farther than this while the status is OK is confident and wrong ..."""
    wrong_rotation: float = np.radians(5.0)
    """rad: likewise ..."""
    grace: float = 1.0
    """... if it is so later than so many s after the robot was carried off, which nobody can notice at once."""
    speed: float = 0.7
    """m/s."""
    turn_rate: float = 0.8
    """rad/s."""

    def __post_init__(self) -> None:
        for name in ("start_limit", "start_duration", "kidnap_limit", "speed", "turn_rate", "translation", "rotation"):
            if not getattr(self, name) > 0:
                raise InvalidValueError(f"TrialConfig.{name}", getattr(self, name), "> 0")


@dataclass(frozen=True, slots=True)
class TrialOutcome:
    """One trial."""

    kind: Kind
    recovered: bool
    """In time, and for good."""
    seconds: float
    """Until it was right for good (and, if kidnapped, said so); inf if it never was."""
    confident_wrong: float
    """s during which it said OK while it was wrong (0.1 s each scan)."""
    translation_error: float
    """m, at the end."""
    rotation_error: float
    """rad, at the end."""
    status: Status
    """At the end."""
    start: Float64
    """(3,) x, y, yaw where the timed part of the trial began."""


@dataclass(frozen=True, slots=True)
class TrialSummary:
    """Many trials of one kind."""

    outcomes: tuple[TrialOutcome, ...]

    @property
    def recovered(self) -> float:
        """Share of trials that recovered in time."""
        return sum(o.recovered for o in self.outcomes) / max(len(self.outcomes), 1)

    @property
    def confident_wrong(self) -> int:
        """Trials in which it was ever confident and wrong."""
        return sum(o.confident_wrong > 0 for o in self.outcomes)

    @property
    def median_seconds(self) -> float:
        """Until it was right, over the trials that recovered; inf if none did."""
        times = [o.seconds for o in self.outcomes if o.recovered]
        return float(np.median(times)) if times else float("inf")


# ------------------------------------------------------------------------------------------------------------- driving


@dataclass
class FloorPlan:
    """Where a robot can drive in a building."""

    free: Bool
    """(X, Y), True where the robot's centre may be."""
    clearance: Float64
    """(X, Y), metres to the nearest obstacle."""
    origin: Float64
    """(2,), map x, y of the corner of cell (0, 0)."""
    resolution: float
    """m."""

    def route(self, start: Float64, length: float, rng: np.random.Generator) -> Float64:
        """(K, 2) way points of a drive from `start` (2,) to random goals, at least `length` metres long."""
        from skimage.graph import MCP_Geometric

        cost = np.where(self.free, 1.0 + 2.0 / np.maximum(self.clearance, 0.05) ** 2 * 0.1, np.inf)
        cells = [tuple(int(v) for v in np.floor((start - self.origin) / self.resolution))]
        total = 0.0
        while total < length:
            graph = MCP_Geometric(cost)
            costs, _ = graph.find_costs([cells[-1]])
            reached = np.argwhere(np.isfinite(costs))
            far = reached[np.abs(reached - cells[-1]).max(axis=1) * self.resolution > min(4.0, length)]
            if not len(far):
                break
            leg = graph.traceback(tuple(far[int(rng.integers(len(far)))]))
            cells += leg[1:]
            total += len(leg) * self.resolution
        return (np.array(cells) + 0.5) * self.resolution + self.origin

    def place(self, rng: np.random.Generator) -> Float64:
        """(2,) a random place in the largest connected free area."""
        from scipy.ndimage import label

        areas = np.empty(self.free.shape, np.int32)
        label(self.free, output=areas)
        sizes = np.bincount(areas.ravel())
        sizes[0] = 0
        cells = np.argwhere(areas == sizes.argmax())
        return (cells[int(rng.integers(len(cells)))] + 0.5) * self.resolution + self.origin


def floor_plan(world: "StaticWorld", radius: float = 0.35) -> FloorPlan:
    """Free space of a building for a round robot of the given radius in metres."""
    from scipy.ndimage import distance_transform_edt

    from simtrack.perception.localization.search_kernels import rasterise

    mesh, resolution = world.mesh(), 0.1
    origin = mesh.vertices[:, :2].min(axis=0) - 0.5
    shape = np.ceil((mesh.vertices[:, :2].max(axis=0) + 0.5 - origin) / resolution).astype(int) + 1
    bounds, faces = np.array([0.1, 1.5]), np.asarray(mesh.faces, np.int64)
    occupied, level = rasterise(mesh.vertices, faces, origin, resolution, bounds, 0.0, int(shape[0]), int(shape[1]))
    clearance = np.asarray(distance_transform_edt(~occupied[0])) * resolution
    return FloorPlan(level & (clearance > radius), clearance, origin, resolution)


def drive(route: Float64, heading: float, duration: float, config: TrialConfig, step: float = 0.01) -> Float64:
    """(T, 3) x, y, yaw every `step` seconds of a differential drive that follows way points (K, 2) by pure pursuit."""
    x, y, yaw, nearest = float(route[0, 0]), float(route[0, 1]), heading, 0
    v = w = 0.0
    out = np.empty((round(duration / step) + 1, 3))
    for k in range(len(out)):
        out[k] = x, y, yaw
        while nearest < len(route) - 1 and np.hypot(*(route[nearest] - (x, y))) < 0.4:
            nearest += 1
        dx, dy = route[nearest] - (x, y)
        bearing = (np.arctan2(dy, dx) - yaw + np.pi) % (2 * np.pi) - np.pi
        arrived = nearest == len(route) - 1 and np.hypot(dx, dy) < 0.2
        wanted_w = 0.0 if arrived else float(np.clip(2.0 * bearing, -config.turn_rate, config.turn_rate))
        wanted_v = 0.0 if arrived else config.speed * max(0.0, np.cos(bearing)) ** 3
        v += float(np.clip(wanted_v - v, -1.0 * step, 1.0 * step))
        w += float(np.clip(wanted_w - w, -3.0 * step, 3.0 * step))
        x, y, yaw = x + v * step * np.cos(yaw), y + v * step * np.sin(yaw), yaw + w * step
    return out


# -------------------------------------------------------------------------------------------------------------- sensing


@dataclass
class LidarWorld:
    """A building with a robot of which only the lidar and the odometry are simulated."""

    world: "StaticWorld"
    static_map: StaticMap
    robot: KinematicTree | None = None
    """Its body hides part of the view and is seen by the lidar."""
    joints: dict[str, float] = field(default_factory=dict)
    """Joint positions of the robot, rad or m."""
    lidar: LidarModel = VLP16
    lidar_noise: LidarNoiseConfig = field(default_factory=LidarNoiseConfig)
    odometry_noise: OdometryNoiseConfig = field(default_factory=OdometryNoiseConfig)

    def __post_init__(self) -> None:
        mesh = self.world.mesh()
        self.plan = floor_plan(self.world)
        self._scene = RayScene()
        self._scene.add(TriangleMesh(mesh.vertices, mesh.faces, source="world"))
        self._shots = self.lidar.shots()
        self._packing = RayBundle.from_directions(self._shots.directions, groups=self._shots.rings)
        self.T_base_lidar = transform_planar(0.0, 0.0, 0.0)
        self.T_base_lidar[2, 3] = 1.15
        self._body = np.full(len(self._shots.times), np.inf)
        if self.robot is not None:
            poses = self.robot.forward(self.joints)
            self.T_base_lidar = poses["lidar"]
            body = RayScene()
            for link in self.robot.links:
                if len(link.faces):
                    body.add(TriangleMesh(link.vertices, link.faces, source=link.name), poses[link.name])
            self._body = body.cast(self._packing, self.T_base_lidar, min_distance=0.06).distances.astype(np.float64)

    def scan(self, pose: Callable[[float], Float64], start: float, rng: np.random.Generator) -> LidarScan:
        """One turn that begins at `start` seconds; `pose` answers seconds with (3,) x, y, yaw of the base."""
        shots, keys = self._shots, 11
        period = self.lidar.period / NANOSECONDS
        track = np.array([pose(start + period * k / (keys - 1)) for k in range(keys)])
        track[:, 2] = np.unwrap(track[:, 2])
        phase = shots.times.astype(np.float64) / period * (keys - 1)
        x, y, yaw = (np.interp(phase, np.arange(keys), track[:, k]) for k in range(3))
        c, s = np.cos(yaw), np.sin(yaw)
        local = shots.directions @ self.T_base_lidar[:3, :3].T
        mount = self.T_base_lidar[:3, 3]
        directions = np.stack(
            [c * local[:, 0] - s * local[:, 1], s * local[:, 0] + c * local[:, 1], local[:, 2]], axis=1
        )
        origins = np.stack(
            [x + c * mount[0] - s * mount[1], y + s * mount[0] + c * mount[1], np.full(len(c), mount[2])], axis=1
        )
        hits = self._scene.cast_rays(origins, directions, max_distance=self.lidar.max_range, packing=self._packing)
        incidence = np.arccos(np.minimum(np.abs(np.einsum("ij,ij->i", hits.normals, directions)), 1.0))
        exact = np.minimum(hits.distances, self._body)
        ranges = apply_lidar_noise(exact, None, self.lidar_noise, rng, incidence)
        return LidarScan(
            stamp=round(start * NANOSECONDS),
            directions=shots.directions,
            ranges=ranges,
            times=shots.times,
            rings=shots.rings,
            intensities=np.zeros(len(ranges), np.float32),
            T_base_lidar=self.T_base_lidar,
        )


# --------------------------------------------------------------------------------------------------------------- trials


def _feed(
    world: LidarWorld, localizer: Localizer, legs: list[Float64], rng: np.random.Generator, step: float = 0.01
) -> Iterator[tuple[float, int, Float64, Localization]]:
    """Drive along `legs` (each (T, 3) poses every `step` s; between two the robot is carried) and feed the localizer.

    Yields the time in seconds at each scan's end, the leg, the true (4, 4) pose, and the answer.
    """
    wheels = OdometrySensor(world.odometry_noise, rng)
    felt, offset = np.eye(4), 0.0
    for number, leg in enumerate(legs):
        first = transform_planar(*leg[0])

        def pose(seconds: float, leg: Float64 = leg, offset: float = offset) -> Float64:
            k = np.clip((seconds - offset) / step, 0.0, len(leg) - 1.0)
            low = min(int(k), len(leg) - 2)
            return leg[low] + (k - low) * (leg[low + 1] - leg[low])

        readings = iter(np.arange(0.0, len(leg) * step - step / 2, 0.02) + offset)
        reading = next(readings)
        turns = int(np.floor((len(leg) - 1) * step * world.lidar.rate_hz + 1e-9))
        for turn in range(turns):
            start = offset + turn / world.lidar.rate_hz
            scan = world.scan(pose, start, rng)
            end = start + 1.0 / world.lidar.rate_hz
            while reading <= end + 1e-9:
                T = felt @ inverse(first) @ transform_planar(*pose(reading))
                localizer.predict(wheels.read(round(reading * NANOSECONDS), T))
                reading = next(readings, float("inf"))
            answer = localizer.update(scan)
            yield end, number, transform_planar(*pose(answer.stamp / NANOSECONDS)), answer
        felt = felt @ inverse(first) @ transform_planar(*leg[-1])
        offset += (len(leg) - 1) * step + 0.02  # picked up and put down between two readings of the wheels


def _errors(T_true: Float64, answer: Localization) -> tuple[float, float]:
    gap = difference(T_true, answer.T_map_base)
    return float(np.linalg.norm(gap[:3])), float(np.linalg.norm(gap[3:]))


def _leg(world: LidarWorld, duration: float, config: TrialConfig, rng: np.random.Generator) -> Float64:
    route = world.plan.route(world.plan.place(rng), config.speed * duration, rng)
    ahead = route[min(5, len(route) - 1)] - route[0]
    return drive(route, float(np.arctan2(ahead[1], ahead[0])) + rng.normal(0.0, 0.5), duration, config)


def wrong_start(
    world: LidarWorld,
    localizer: Localizer,
    initialise: Callable[[int, Float64], None],
    config: TrialConfig,
    rng: np.random.Generator,
) -> TrialOutcome:
    """Start a localizer off by `config.start_offset` and `config.start_turn`, drive, and see whether it recovers.

    `initialise(stamp, T_map_base)` tells the (fresh) localizer the wrong pose.
    """
    leg = _leg(world, config.start_duration, config, rng)
    heading, side = rng.uniform(-np.pi, np.pi), rng.choice([-1.0, 1.0])
    shift = config.start_offset * np.array([np.cos(heading), np.sin(heading)])
    initialise(0, perturb(transform_planar(*leg[0]), np.array([*shift, 0.0, 0.0, 0.0, side * config.start_turn])))
    right_since, wrong, last = float("inf"), 0.0, (float("inf"), float("inf"), Status.LOST)
    for time, _, T_true, answer in _feed(world, localizer, [leg], rng):
        translation, rotation = _errors(T_true, answer)
        right = translation < config.translation and rotation < config.rotation
        right_since = min(right_since, time) if right else float("inf")
        if answer.status is Status.OK and (translation > config.wrong_translation or rotation > config.wrong_rotation):
            wrong += 1.0 / world.lidar.rate_hz
        last = translation, rotation, answer.status
    return TrialOutcome("wrong-start", right_since <= config.start_limit, right_since, wrong, *last, start=leg[0])


def kidnapped(
    world: LidarWorld,
    localizer: Localizer,
    initialise: Callable[[int, Float64], None],
    config: TrialConfig,
    rng: np.random.Generator,
) -> TrialOutcome:
    """Let a localizer track for a while, carry the robot to another place, and see whether it finds itself.

    It has found itself once it says OK, is right, and stays both for `config.settled` seconds.
    """
    before = _leg(world, config.tracked, config, rng)
    after = _leg(world, config.kidnap_limit + config.settled, config, rng)
    initialise(0, transform_planar(*before[0]))
    found_since, wrong, last = float("inf"), 0.0, (float("inf"), float("inf"), Status.LOST)
    began = 0.0
    for time, leg, T_true, answer in _feed(world, localizer, [before, after], rng):
        if leg == 0:
            began = time
            continue
        translation, rotation = _errors(T_true, answer)
        right = translation < config.translation and rotation < config.rotation
        found_since = min(found_since, time) if right and answer.status is Status.OK else float("inf")
        astray = translation > config.wrong_translation or rotation > config.wrong_rotation
        if answer.status is Status.OK and astray and time - began > config.grace:
            wrong += 1.0 / world.lidar.rate_hz
        last = translation, rotation, answer.status
        if time - found_since >= config.settled:
            break
    seconds = found_since - began
    return TrialOutcome("kidnapped", seconds <= config.kidnap_limit, seconds, wrong, *last, start=after[0])


def run_trials(
    kind: Kind,
    count: int,
    world: LidarWorld,
    seed: int = 0,
    config: TrialConfig | None = None,
    report: Callable[[int, TrialOutcome], None] | None = None,
) -> TrialSummary:
    """Try `simtrack.perception.localization.MeshLocalizer` `count` times; trial k depends on (seed, k) alone.

    Args:
        kind: what is tried.
        count: how often.
        world: the building, its survey and the robot.
        seed: of everything random.
        config: settings, the defaults if None.
        report: is told each outcome as it comes.
    """
    from simtrack.perception.localization import MeshLocalizer
    from simtrack.perception.self_filter import SelfFilter

    config = config or TrialConfig()
    body = SelfFilter(world.robot) if world.robot is not None else None
    mask = None if body is None else lambda scan: body.lidar_mask(scan, world.joints)
    localizer = MeshLocalizer(world.static_map, lidar_mask=mask)
    certain = np.diag(np.square([0.02, 0.02, 0.01, 0.01, 0.01, 0.01]))
    outcomes: list[TrialOutcome] = []
    for k in range(count):
        rng = np.random.default_rng([seed, k])
        localizer.reset()
        if kind == "wrong-start":
            outcome = wrong_start(world, localizer, localizer.initialise, config, rng)
        else:
            outcome = kidnapped(world, localizer, lambda t, T: localizer.initialise(t, T, certain), config, rng)
        outcomes.append(outcome)
        if report is not None:
            report(k, outcome)
    return TrialSummary(tuple(outcomes))
