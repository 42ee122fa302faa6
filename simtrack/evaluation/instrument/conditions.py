"""Under which conditions a scene is run: how much sensors, models, calibration and detector err, and what moves.

Every condition is a change of the scene file or of the oracle detector, nothing else: a run under conditions is a run.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from simtrack.errors import FileFormatError, InvalidValueError, UnknownNameError
from simtrack.objects import TrackerModelConfig
from simtrack.sensors.depth_noise import PRESETS, DepthNoiseConfig
from simtrack.sensors.faults import CalibrationFaults
from simtrack.sensors.lidar import LidarNoiseConfig
from simtrack.sensors.odometry import EncoderNoiseConfig, OdometryNoiseConfig
from simtrack.simulation.oracles import OracleDetectorConfig
from simtrack.simulation.scene_file import Carry, Placement, Push, SceneFile, SceneObject

OCCLUDERS = ("thermos", "spray_bottle", "cardboard_box", "tape_dispenser", "mug")
"""Catalogue things without a tracker model that stand in the way, in turn."""
MOST_OCCLUDERS = 20
_SWITCHED_OFF: Mapping[str, object] = {
    "lateral": "none", "shadow_baseline": 0.0, "grazing_dropout": np.pi / 2, "albedo_floor": 0.0,
}  # fmt: skip
"""Of a depth camera without noise: what is no amount."""
_DEPTH = (
    "axial_offset", "axial_quadratic", "axial_grazing", "lateral_sigma", "lateral_grazing", "disparity_step",
    "dropout", "flying_pixels",
)  # fmt: skip
_LIDAR, _ENCODERS = ("sigma", "resolution", "dropout"), ("sigma", "resolution")
_ODOMETRY = ("travel_from_travel", "travel_from_turn", "turn_from_travel", "turn_from_turn")
"""Variances: they grow with the square of the factor."""
_SHARES = ("dropout", "flying_pixels")
_DETECTOR_ERRORS = ("keypoint_error", "miss_rate", "hard_misses", "false_positive_rate", "wrong_class_rate")


@dataclass(frozen=True, slots=True)
class Conditions:
    """Changes of a scene; the defaults change nothing."""

    noise: float = 1.0
    """Factor on the noise of every sensor (standard deviations, quantisation, losses); 0: exact readings."""
    model_error: float = 1.0
    """Factor on the errors of the tracker's models; 0: the true shapes."""
    model_scale: float = 0.0
    """Share by which the tracker's models are too large, at random up to this; 0: as the scene says."""
    false_symmetry: int = 0
    """1: the tracker's models are said to look the same after half a turn about z."""
    calibration: float = 1.0
    """Factor on the scene's own calibration faults; 0: none."""
    extrinsics: float = 0.0
    """Degrees by which the believed camera is turned about the base's y axis (nodding)."""
    time_offset: float = 0.0
    """Seconds added to the stamps of camera frames."""
    lidar_mirrored: int = 0
    """1: the lidar's lasers are taken for each other, the highest for the lowest."""
    detection: float = 1.0
    """Factor on the detector's errors; 0: a perfect detector, if late."""
    detector_bias: float = 0.0
    """Share of an object's image size by which its detected keypoints lie too far to the right."""
    latency: float | None = None
    """Seconds from an image to its detections; the detector's own if None."""
    speed: float = 1.0
    """Factor on the speed of the hand."""
    occlusion: int = 0
    """Things without model that are put among the objects of the first support."""

    def __post_init__(self) -> None:
        limits = {"noise": 10.0, "model_error": 20.0, "calibration": 20.0, "detection": 20.0, "model_scale": 0.5}
        for name, most in limits.items():
            if not 0.0 <= getattr(self, name) <= most:
                raise InvalidValueError(name, getattr(self, name), f"0 to {most:g}")
        if not 0.05 <= self.speed <= 2.5:
            raise InvalidValueError("speed", self.speed, "0.05 to 2.5")
        for name, most in (("extrinsics", 45.0), ("detector_bias", 1.0), ("time_offset", 1.0)):
            if not abs(getattr(self, name)) <= most:
                raise InvalidValueError(name, getattr(self, name), f"-{most:g} to {most:g}")
        if self.latency is not None and not 0.0 <= self.latency <= 5.0:
            raise InvalidValueError("latency", self.latency, "0 to 5 s")
        for name in ("lidar_mirrored", "false_symmetry"):
            if getattr(self, name) not in (0, 1):
                raise InvalidValueError(name, getattr(self, name), "0 or 1")
        if not 0 <= self.occlusion <= MOST_OCCLUDERS or self.occlusion != int(self.occlusion):
            raise InvalidValueError("occlusion", self.occlusion, f"a whole number from 0 to {MOST_OCCLUDERS}")

    def changed(self) -> dict[str, float]:
        """The conditions that are not the defaults, by name."""
        return {f.name: getattr(self, f.name) for f in fields(self) if getattr(self, f.name) != f.default}

    def scene(self, scene: SceneFile) -> SceneFile:
        """The scene under these conditions."""
        for change in (self._with_noise, self._with_models, self._with_calibration, self._with_speed, self._occluded):
            changed = change(scene)
            changed._path = scene.path
            scene = changed
        return scene

    def detector(self, config: OracleDetectorConfig) -> OracleDetectorConfig:
        """The oracle detector under these conditions."""
        errors = {name: min(self.detection * getattr(config, name), 1.0) for name in _DETECTOR_ERRORS}
        if self.latency is not None:
            errors["latency"] = self.latency
        return replace(config, **errors, bias=self.detector_bias)

    # ---------------------------------------------------------------------------------------------------- of the scene

    def _with_noise(self, scene: SceneFile) -> SceneFile:
        if self.noise == 1.0:
            return scene
        sensors = scene.sensors
        if sensors.depth not in PRESETS:
            raise FileFormatError(scene.path, "sensors.depth", f"unknown preset; allowed: {', '.join(sorted(PRESETS))}")
        depth = self._scaled(_DEPTH, PRESETS[sensors.depth], sensors.depth_noise)
        lidar = self._scaled(_LIDAR, LidarNoiseConfig(), sensors.lidar_noise)
        if self.noise == 0.0:
            depth |= _SWITCHED_OFF
            if (preset := PRESETS[sensors.depth]).simkinect:
                depth |= {"simkinect": not preset.simkinect}
            lidar |= {"grazing_angle": np.pi / 2, "reflectivity_floor": 0.0}
        changed = {
            "depth_noise": depth,
            "lidar_noise": lidar,
            "odometry": self._scaled(_ODOMETRY, OdometryNoiseConfig(), sensors.odometry, power=2),
            "encoders": self._scaled(_ENCODERS, EncoderNoiseConfig(), sensors.encoders),
        }
        return scene.model_copy(update={"sensors": sensors.model_copy(update=changed)})

    def _scaled(
        self,
        names: tuple[str, ...],
        preset: DepthNoiseConfig | LidarNoiseConfig | OdometryNoiseConfig | EncoderNoiseConfig,
        given: Mapping[str, Any],
        power: int = 1,
    ) -> dict[str, Any]:
        out = dict(given)
        for name in names:
            amount = self.noise**power * float(given.get(name, getattr(preset, name)))
            out[name] = min(amount, 1.0) if name in _SHARES else amount
        return out

    def _with_models(self, scene: SceneFile) -> SceneFile:
        if self.model_error == 1.0 and self.model_scale == 0.0 and not self.false_symmetry:
            return scene
        given, standard, factor = dict(scene.tracker_models), TrackerModelConfig(), self.model_error
        for name, most in (("noise", 0.05), ("max_scale_error", 0.5)):
            given[name] = min(factor * float(given.get(name, getattr(standard, name))), most)
        if factor == 0.0:
            given["face_share"] = 1.0
        given["max_scale_error"] = max(given["max_scale_error"], self.model_scale)
        given["false_symmetry"] = bool(self.false_symmetry)
        return scene.model_copy(update={"tracker_models": given})

    def _with_calibration(self, scene: SceneFile) -> SceneFile:
        if (self.calibration, self.extrinsics, self.time_offset, self.lidar_mirrored) == (1.0, 0.0, 0.0, 0):
            return scene
        given, standard = dict(scene.sensors.calibration), CalibrationFaults()
        for name in ("camera", "lidar"):
            given[name] = [self.calibration * float(x) for x in given.get(name, getattr(standard, name))]
        for name in ("camera_time_offset", "lidar_time_offset"):
            given[name] = self.calibration * float(given.get(name, 0.0))
        given["encoder_bias"] = {k: self.calibration * float(v) for k, v in given.get("encoder_bias", {}).items()}
        given["camera"][4] += float(np.deg2rad(self.extrinsics))
        given["camera_time_offset"] += self.time_offset
        given["lidar_mirrored"] = bool(self.lidar_mirrored)
        return scene.model_copy(update={"sensors": scene.sensors.model_copy(update={"calibration": given})})

    def _with_speed(self, scene: SceneFile) -> SceneFile:
        if self.speed == 1.0 or scene.hand is None:
            return scene

        def faster(action: Any) -> Any:
            if not isinstance(action, Carry | Push):
                return action
            most = 1.0 if isinstance(action, Carry) else 0.5
            return action.model_copy(update={"speed": min(self.speed * action.speed, most)})

        script = tuple(faster(action) for action in scene.hand.script)
        return scene.model_copy(update={"hand": scene.hand.model_copy(update={"script": script})})

    def _occluded(self, scene: SceneFile) -> SceneFile:
        support = next((thing.place.on for thing in scene.objects if thing.place.on is not None), None)
        if self.occlusion == 0 or support is None:
            return scene
        added = tuple(
            SceneObject(
                model=OCCLUDERS[k % len(OCCLUDERS)], name=f"occluder-{k + 1}",
                place=Placement(on=support, separation=0.0),
            )
            for k in range(int(self.occlusion))
        )  # fmt: skip
        return scene.model_copy(update={"clutter": (*scene.clutter, *added)})


_WHOLE = ("occlusion", "lidar_mirrored", "false_symmetry")
AXES: Mapping[str, Callable[[float], object]] = {
    field.name: int if field.name in _WHOLE else float for field in fields(Conditions)
}
"""What can be swept, and the type of its values."""


def changed(conditions: Conditions, name: str, value: float) -> Conditions:
    """Conditions with one of them changed.

    Raises:
        UnknownNameError: there is no such condition.
        InvalidValueError: the value is out of its range.
    """
    if name not in AXES:
        raise UnknownNameError("condition", name, AXES)
    if AXES[name] is int and value != int(value):
        raise InvalidValueError(name, value, "a whole number")
    return replace(conditions, **{name: AXES[name](value)})


def parse_conditions(text: str) -> Conditions:
    """Conditions such as ``noise=2,extrinsics=1``; the defaults for an empty text.

    Raises:
        SimtrackError: an unknown condition, one that occurs twice, or a value that cannot be used.
    """
    conditions, seen = Conditions(), set[str]()
    for part in filter(None, text.split(",")):
        name, equals, value = (piece.strip() for piece in part.partition("="))
        if not equals or name in seen:
            raise InvalidValueError("given", part, f"NAME=VALUE, every condition once, of {', '.join(AXES)}")
        seen.add(name)
        try:
            number = float(value)
        except ValueError as error:
            raise InvalidValueError(name, value, "a number") from error
        conditions = changed(conditions, name, number)
    return conditions
