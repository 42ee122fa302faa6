"""The clock: runs physics, hand and robot, and lets every sensor look at its own time."""

from collections.abc import Callable, Collection, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import repeat
from types import TracebackType
from typing import TYPE_CHECKING

import numpy as np

from simtrack.contracts import (
    NANOSECONDS,
    Command,
    Float64,
    JointState,
    LidarScan,
    RgbdFrame,
    SensorFrame,
    StaticMap,
)
from simtrack.errors import FileFormatError, InvalidValueError, RenderingError, SimtrackError, UnknownNameError
from simtrack.geometry.kinematics import KinematicTree
from simtrack.geometry.transforms import inverse, rotation_from_rpy, transform, transform_planar
from simtrack.objects import ObjectModel, TrackerModelConfig, tracker_model
from simtrack.perception.beside import AtOnce
from simtrack.raycast import RayBundle
from simtrack.raycast.sweep import sweep
from simtrack.sensors.camera import XTION, CameraModel
from simtrack.sensors.faults import CalibrationFaults, FaultyFeed, FeedFaults
from simtrack.sensors.lidar import VLP16, LidarModel, LidarNoiseConfig, apply_lidar_noise, reflected_intensity
from simtrack.sensors.odometry import EncoderNoiseConfig, OdometryNoiseConfig, OdometrySensor, read_encoders
from simtrack.simulation.changes import ChangeDirector, UnseenChange
from simtrack.simulation.ground_truth import GroundTruth
from simtrack.simulation.hand_script import HandDirector
from simtrack.simulation.history import KEY_NS, History
from simtrack.simulation.randomness import stream
from simtrack.simulation.rendering import EmbreeRenderer, make_renderer
from simtrack.simulation.scene_file import SceneFile
from simtrack.simulation.settling import rearrange
from simtrack.simulation.world import SENSOR_BODIES, TIMESTEP_NS, build_world, configured
from simtrack.simulation.world_rays import WorldRays

if TYPE_CHECKING:
    import mujoco

    from simtrack.sensors.depth_noise import DepthDraws

PROPRIOCEPTION_NS = 20_000_000
"""Nanoseconds between odometry readings and between joint states, unless told otherwise: 50 Hz."""
START_SIGMA = np.array([0.03, 0.03, np.deg2rad(2.0)])
"""How well the robot is told where it starts: standard deviations of x, y, metres, and heading, radians."""
SENSORS = ("camera", "lidar", "proprioception")
"""What can look: the RGB-D camera, the lidar, and odometry with the joint encoders."""
FAR = 10.0
"""Metres beyond which a depth camera of this kind reads nothing, so that nothing is rendered there."""


class Simulation:
    """A world that runs in simulated time and sends sensor frames; a context manager that releases OpenGL at its end.

    Every purpose (placement, hand, camera noise, lidar noise, ...) has a random stream of its own, so that rendering or
    not rendering RGB, say, changes nothing else. A sensor that is off draws nothing and costs nothing.
    """

    def __init__(
        self,
        scene: SceneFile,
        seed: int = 0,
        renderer: str = "mujoco",
        camera: CameraModel = XTION,
        lidar: LidarModel = VLP16,
        *,
        sensors: Collection[str] = SENSORS,
        sleep: bool = False,
        memory: int | None = None,
        proprioception: int = PROPRIOCEPTION_NS,
        scan_key: int = KEY_NS,
        servo: int = TIMESTEP_NS,
        key: int = KEY_NS,
        threads: bool = True,
    ) -> None:
        """Build the world of `scene` for `seed` and let it settle; stamp 0 is the moment after.

        Args:
            scene: from `load_scene`.
            seed: of everything random.
            renderer: ``mujoco`` (falls back to rays, with a warning, where EGL is missing) or ``embree``.
            camera: the camera in the head; its rate is also that of `advance`, be it on or off.
            lidar: the lidar on the mast.
            sensors: which of `SENSORS` are on.
            sleep: leave things that rest out of the physics until something touches them.
            memory: nanoseconds of the past that `truth` can be asked about at least; all of it if None.
            proprioception: nanoseconds between odometry readings and between joint states.
            scan_key: nanoseconds between the moments of a lidar's turn that its motion is interpolated from.
            servo: nanoseconds between the setpoints of robot and hand: physics steps of which some fill a `key`.
            key: nanoseconds between the states that are remembered; those in between are interpolated.
            threads: lidar and noise have a thread of their own, where that saves time; frames are the same without.

        Raises:
            SimtrackError: whatever is wrong with the scene; see `build_world`.
        """
        import mujoco

        if key < KEY_NS or key % KEY_NS:
            raise InvalidValueError("key", key, f"a multiple of {KEY_NS} ns")
        if servo < TIMESTEP_NS or servo % TIMESTEP_NS or key % servo:
            raise InvalidValueError("servo", servo, f"a multiple of {TIMESTEP_NS} ns that divides the key, {key} ns")
        if unknown := sorted(set(sensors) - set(SENSORS)):
            raise UnknownNameError("sensor", unknown[0], SENSORS)
        self.scene, self.seed = scene, seed
        self._building = seed
        self.camera, self.lidar, self._sensors = camera, lidar, frozenset(sensors)
        self._proprioception, self._scan_key, self._servo = proprioception, scan_key, servo
        intrinsics = camera.intrinsics
        fovy = 2.0 * np.arctan(intrinsics.height / (2.0 * intrinsics.fy))
        self.world = build_world(scene, seed, float(fovy), (intrinsics.width, intrinsics.height), sleep)
        self._data = self.world.data
        self._scratch = mujoco.MjData(self.world.model)
        self._scan_scratch = mujoco.MjData(self.world.model)
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="simtrack-sensors") if threads else AtOnce()
        self._history = History(self.world.model, memory, key)
        self._rays = WorldRays(self.world)
        self.truth = GroundTruth(self.world, self._history, self._rays, intrinsics)
        self._renderer = make_renderer(renderer, self.world, self._rays, intrinsics, FAR)
        self._lidar_body = self.world.model.body(SENSOR_BODIES["lidar"]).id
        self._T_base_lidar = self.robot.forward({})["lidar"]
        self._shots = lidar.shots()
        self._packing = RayBundle.from_directions(self._shots.directions, self._shots.rings)
        self._closed = False
        self._static_map: StaticMap | None = None
        self._models: dict[str, ObjectModel] | None = None
        self._begin(seed)

    def restart(self, seed: int) -> None:
        """Begin anew at stamp 0 with everything random drawn from `seed`, but in the same building.

        The survey and the tracker's models stay, too: they belong to the building and to the catalogue. So the same
        seed gives the same course of events, whatever was simulated before.

        Args:
            seed: of places, hand, sensors and start.

        Raises:
            FileFormatError: there is no room for the things of the scene; see `rearrange`.
            RenderingError: the simulation is closed.
        """
        if self._closed:
            raise RenderingError("the simulation is closed; make a new one")
        self._draws.cancel()
        if not self._draws.cancelled():
            self._draws.result()
        rearrange(self.world, seed)
        self._history.clear()
        self.truth.clear()
        self._begin(seed)

    def _begin(self, seed: int) -> None:
        """What each course of events has for itself, from the settled world on."""
        self.seed = seed
        self._configure()
        self._hand = HandDirector(self.world, stream(seed, "hand")) if self.scene.hand is not None else None
        self._changes = ChangeDirector(self.world, self.camera.intrinsics, seed)
        self._counts: dict[str, int] = dict.fromkeys(SENSORS, 0)
        self.world.controller.timestep = self._servo / NANOSECONDS
        self._now = 0
        self._T_wheels_map = np.eye(4)
        self._remember()
        self._draws = self._worker.submit(self._draw_noise)

    def _configure(self) -> None:
        """Sensor configurations from the scene file; raises FileFormatError."""
        from simtrack.sensors.depth_noise import PRESETS

        scene, sensors, seed = self.scene, self.scene.sensors, self.seed
        if sensors.depth not in PRESETS:
            raise FileFormatError(scene.path, "sensors.depth", f"unknown preset; allowed: {', '.join(sorted(PRESETS))}")
        preset = PRESETS[sensors.depth]
        self.depth_noise = configured(type(preset), sensors.depth_noise, scene, "sensors.depth_noise", preset)
        self.lidar_noise = configured(LidarNoiseConfig, sensors.lidar_noise, scene, "sensors.lidar_noise")
        self.odometry_noise = configured(OdometryNoiseConfig, sensors.odometry, scene, "sensors.odometry")
        self.encoder_noise = configured(EncoderNoiseConfig, sensors.encoders, scene, "sensors.encoders")
        self.calibration = configured(CalibrationFaults, sensors.calibration, scene, "sensors.calibration")
        faults = {
            name: configured(FeedFaults, values, scene, f"sensors.feed.{name}") for name, values in sensors.feed.items()
        }
        try:
            self._feed = FaultyFeed(faults, stream(seed, "feed"))
        except SimtrackError as error:
            raise FileFormatError(scene.path, "sensors.feed", str(error)) from error
        self._odometry = OdometrySensor(self.odometry_noise, stream(seed, "odometry"))
        self._rng_depth, self._rng_lidar = stream(seed, "camera"), stream(seed, "lidar")
        self._rng_encoders, self._rng_camera_pose = stream(seed, "encoders"), stream(seed, "camera pose")

    # --------------------------------------------------------------------------------------------- what the robot knows

    @property
    def robot(self) -> KinematicTree:
        """The robot's own description."""
        return self.world.robot

    @property
    def static_map(self) -> StaticMap:
        """The survey of the building, made once on first use: noisy, decimated, slightly outdated."""
        if self._static_map is None:
            from simtrack.simulation.survey import SurveyConfig, survey

            config = configured(SurveyConfig, self.scene.survey, self.scene, "survey")
            self._static_map = survey(self.world.static, config, stream(self._building, "survey"))
        return self._static_map

    def use_map(self, static_map: StaticMap) -> None:
        """Give estimators this map in the place of the survey of the building."""
        self._static_map = static_map

    @property
    def models(self) -> dict[str, ObjectModel]:
        """The tracker's imperfect models of the scene's catalogue objects, by model name."""
        if self._models is None:
            config = configured(TrackerModelConfig, self.scene.tracker_models, self.scene, "tracker_models")
            exact = {self.world.objects[thing.id].name: self.world.objects[thing.id] for thing in self.scene.objects}
            names = sorted(exact)
            streams = [stream(self._building, f"tracker model {name}") for name in names]
            with ThreadPoolExecutor() as workers:
                made = workers.map(tracker_model, (exact[name] for name in names), repeat(config), streams)
                self._models = dict(zip(names, made, strict=True))
        return self._models

    @property
    def start(self) -> Float64:
        """(4, 4) T_map_base at stamp 0, as an operator would state it: off by a few centimetres and degrees."""
        x, y, yaw = START_SIGMA * stream(self.seed, "start").standard_normal(3)
        told = self.truth.at(0).T_map_base @ transform(rotation_from_rpy(0.0, 0.0, yaw))
        told[:2, 3] += x, y
        return told

    # -------------------------------------------------------------------------------------------------------- the clock

    @property
    def now(self) -> int:
        """Nanoseconds: the stamp of the last camera frame, 0 before the first."""
        return self._now

    @property
    def camera_period(self) -> int:
        """Nanoseconds between camera stamps."""
        return self.camera.period

    @property
    def renderer(self) -> str:
        """Name of the renderer in use."""
        return self._renderer.name

    def advance(self, command: Command, want_rgb: bool = False) -> list[SensorFrame]:
        """Run under `command` until the next camera stamp; what arrived meanwhile, in arrival order.

        Args:
            command: held from `now` on.
            want_rgb: render colour for the camera frame at the end.

        Raises:
            RenderingError: the simulation is closed.
        """
        if self._closed:
            raise RenderingError("the simulation is closed; make a new one")
        self._counts["camera"] += 1
        target = self._counts["camera"] * self.camera_period
        self._changes.step(self._now)
        while self._history.end < target:
            self._step(command)
        self._due(self._proprioception, "proprioception", target, self._send_proprioception)
        self._now = target
        # The lidar looks while the camera is rendered, unless both cast rays into the same scene.
        scans = self._worker.submit(self._due, self.lidar.period, "lidar", target - self.lidar.period, self._send_scan)
        if self.renderer != "mujoco":
            scans.result()
        if "camera" in self._sensors:
            self._send(self._take_image(target, want_rgb), target)
            self._draws = self._worker.submit(self._draw_noise)
        scans.result()
        return self._feed.receive(target)

    def state(self, stamp: int) -> "mujoco.MjData":
        """Body poses at a stamp, to be read before the next call: for what acts inside of the world."""
        self._history.load(stamp, self._scratch)
        return self._scratch

    @property
    def changes(self) -> Sequence[UnseenChange]:
        """What has happened unseen so far."""
        return self._changes.done

    @property
    def pending_changes(self) -> int:
        """How many changes of the scene have not happened yet."""
        return self._changes.pending

    def carry_robot(self, x: float, y: float, yaw: float) -> None:
        """Lift the robot and put it down at rest elsewhere, now: its wheels do not feel it (kidnapping).

        Args:
            x: metres, map.
            y: metres, map.
            yaw: radians.
        """
        controller = self.world.controller
        before = transform_planar(*controller.base(self._data.qpos))
        controller.carry(self._data, x, y, yaw)
        self._T_wheels_map = self._T_wheels_map @ before @ inverse(transform_planar(x, y, yaw))

    def _due(self, period: int, sensor: str, until: int, send: Callable[[int], None]) -> None:
        """Let a sensor look at each of its stamps that has come."""
        if sensor not in self._sensors:
            return
        while self._counts[sensor] * period <= until:
            send(self._counts[sensor] * period)
            self._counts[sensor] += 1

    def _step(self, command: Command) -> None:
        """Physics from one key of the history to the next."""
        import mujoco

        steps = self._servo // TIMESTEP_NS
        for _ in range(self._history.key // self._servo):
            self.world.controller.step(self._data, command)
            if self._hand is not None:
                self._hand.step(self._data, steps)
            mujoco.mj_step(self.world.model, self._data, nstep=steps)
        self._remember()

    def _remember(self) -> None:
        self._history.append(self._data)
        self.truth.record(self._data)

    # ------------------------------------------------------------------------------------------------------ the sensors

    def _send_proprioception(self, stamp: int) -> None:
        qpos = self._history.qpos(stamp)
        T_map_base = transform_planar(*self.world.controller.base(qpos))
        self._feed.send(self._odometry.read(stamp, self._T_wheels_map @ T_map_base), stamp)
        self._feed.send(self._encoders(qpos, stamp, self._rng_encoders), stamp)

    def _encoders(self, qpos: Float64, stamp: int, rng: np.random.Generator) -> JointState:
        controller = self.world.controller
        positions = dict(zip(controller.joint_names, controller.joint_positions(qpos).tolist(), strict=True))
        reading = self.calibration.apply(read_encoders(stamp, positions, self.encoder_noise, rng))
        assert isinstance(reading, JointState)
        return reading

    def _draw_noise(self) -> "DepthDraws | None":
        if "camera" not in self._sensors:
            return None
        from simtrack.sensors.depth_noise import draw_depth_noise

        return draw_depth_noise(self.camera.intrinsics, self.depth_noise, self._rng_depth)

    def _take_image(self, stamp: int, want_rgb: bool) -> RgbdFrame:
        from simtrack.sensors.depth_noise import apply_depth_noise

        self._history.load(stamp, self._scratch)
        exact = self._renderer.depth(self._scratch)
        if isinstance(self._renderer, EmbreeRenderer):
            self.truth.record_image(stamp, self._renderer.hits)
        draws = self._draws.result()
        depth = apply_depth_noise(exact, None, self.camera.intrinsics, self.depth_noise, self._rng_depth, draws=draws)
        rgb = self._renderer.rgb(self._scratch) if want_rgb else None
        joints = self._encoders(self._history.qpos(stamp), stamp, self._rng_camera_pose)
        believed = self.robot.pose("camera", dict(zip(joints.names, joints.positions.tolist(), strict=True)))
        sequence = self._counts["camera"] - 1
        return RgbdFrame(stamp, depth, rgb, self.camera.intrinsics, believed, sequence)

    def _send_scan(self, stamp: int) -> None:
        """One turn: each shot is cast from where sensor and objects are at its own time."""
        shots, keys = self._shots, round(self.lidar.period / self._scan_key) + 1
        poses, sensor = [], np.empty((keys, 4, 4))
        for k in range(keys):
            self._history.load(stamp + k * self.lidar.period / (keys - 1), self._scan_scratch)
            poses.append(self._rays.poses(self._scan_scratch))
            R = self._scan_scratch.xmat[self._lidar_body].reshape(3, 3)
            sensor[k] = transform(R, self._scan_scratch.xpos[self._lidar_body])
        self._rays.move(poses)
        times = shots.times * np.float32(NANOSECONDS / self.lidar.period)
        origins, directions = sweep(shots.directions, times, 1.0 / (keys - 1), sensor)
        hits = self._rays.scene.cast_rays(
            origins, directions, times, self.lidar.max_range, min_distance=0.06, packing=self._packing
        )
        incidence = np.arccos(np.minimum(np.abs(np.einsum("ij,ij->i", hits.normals, directions)), 1.0))
        intensities = reflected_intensity(self._rays.albedos(hits), incidence)
        ranges = apply_lidar_noise(hits.distances, intensities, self.lidar_noise, self._rng_lidar, incidence)
        self.truth.record_scan(stamp, self._rays.ids(hits))
        scan = LidarScan(
            stamp, shots.directions, ranges, shots.times, shots.rings,
            np.where(np.isfinite(ranges), intensities, 0.0).astype(np.float32), self._T_base_lidar,
            self._counts["lidar"],
        )  # fmt: skip
        self._send(scan, stamp + self.lidar.period)

    def _send(self, frame: RgbdFrame | LidarScan, complete: int) -> None:
        """Send a frame that is complete at a stamp. Where its clock is ahead it has taken so long on its way: what
        arrives is never from the future.
        """
        told = self.calibration.apply(frame)
        self._feed.send(told, complete + max(0, told.stamp - frame.stamp))

    # ---------------------------------------------------------------------------------------------------------- the end

    def close(self) -> None:
        """Release OpenGL and ray scenes; may be called twice. What was measured stays readable."""
        self._closed = True
        self._worker.shutdown(wait=True)
        self._renderer.close()
        self.truth.close()
        self._rays.close()

    def __enter__(self) -> "Simulation":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
