"""What is to be run, checked before anything is built, and what of it is written down."""

import platform
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path

import simtrack
from simtrack.contracts import Command
from simtrack.errors import InvalidValueError, UnknownNameError
from simtrack.evaluation.detector_choice import ORACLE, DetectorChoice, choose_detector
from simtrack.perception.detection.loading import ALLOWED as IMAGE_DETECTORS
from simtrack.perception.detection.loading import check_image_detector, is_image_detector
from simtrack.perception.foreign import check_stage
from simtrack.perception.foreign.guards import DEFAULT_LIMIT
from simtrack.perception.stack_config import StackConfig
from simtrack.simulation.agents import AGENTS
from simtrack.simulation.oracles import OracleDetectorConfig
from simtrack.simulation.scene_file import SceneFile
from simtrack.simulation.survey_files import check_survey

RENDERERS = ("mujoco", "embree")
DEFAULT_AGENT, FIXED_GAZE = "explorer", "fixed-gaze"
_PACKAGES = ("mujoco", "numpy", "numba", "embreex", "opencv-python-headless", "scipy", "pyoxigraph", "onnxruntime")


@dataclass(frozen=True, slots=True)
class RunConfig:
    """Settings of a run."""

    scene: SceneFile
    out: Path
    duration: float | None = None
    """Simulated seconds; the scene's own if None."""
    seed: int = 0
    agent: str | None = None
    """The scene's own, or the explorer, if None."""
    detector: str | None = None
    """The oracle, one of simtrack's own that look at images (`simtrack.perception.detection.loading`), or
    ``package.module:Class``; if None, see `simtrack.evaluation.detector_choice`."""
    oracle: OracleDetectorConfig = field(default_factory=OracleDetectorConfig)
    """How the oracle detector errs."""
    tracker: str | None = None
    """``package.module:Class`` or ``exec:program``; simtrack's own if None."""
    localizer: str | None = None
    """``package.module:Class``, or the oracle; simtrack's own if None."""
    scene_graph: str | None = None
    """``package.module:Class``; simtrack's own if None."""
    stage_limit: float = DEFAULT_LIMIT
    """Seconds of the wall clock that a stage of somebody else's has for a frame."""
    renderer: str = "mujoco"
    overwrite: bool = False
    log: Path | None = None
    """MCAP file to record the sensor feed to."""
    compare_gaze: bool = False
    """Run the fixed gaze on the same seed, too."""
    threads: int | None = None
    """Threads of the compiled kernels; all that there are if None."""
    static_map: Path | None = None
    """Folder of a survey that the robot is localized in; None: the scene's own."""
    stack: StackConfig = field(default_factory=StackConfig)
    script: tuple[Command, ...] | None = None
    """Commands, one a camera period, that are given instead of the agent's: those of another run, to repeat its way."""

    def __post_init__(self) -> None:
        if self.duration is not None and not 0.0 < self.duration <= 3600.0:
            raise InvalidValueError("duration", self.duration, "more than 0 and at most 3600 seconds")
        if self.seed < 0:
            raise InvalidValueError("seed", self.seed, "0 or a positive integer")
        for kind, name, known in (
            ("renderer", self.renderer, RENDERERS),
            ("agent", self.agent_name, AGENTS),
        ):
            if name not in known:
                raise UnknownNameError(kind, name, known)
        detector = self.detector_choice.name
        if is_image_detector(detector):
            check_image_detector(detector)
        elif ":" not in detector and detector != ORACLE:
            raise UnknownNameError("detector", detector, (ORACLE, *IMAGE_DETECTORS, "package.module:Class"))
        if not 0.0 < self.stage_limit <= 3600.0:
            raise InvalidValueError("stage_limit", self.stage_limit, "more than 0 and at most 3600 seconds")
        for stage, given in self.foreign.items():
            check_stage(stage, given)
        if self.static_map is not None:
            check_survey(self.static_map)

    @property
    def seconds(self) -> float:
        """Simulated seconds."""
        return self.duration if self.duration is not None else self.scene.duration

    @property
    def foreign(self) -> dict[str, str]:
        """Stage -> what was given for it, of those that are not simtrack's."""
        given = {
            "tracker": self.tracker, "localizer": self.localizer, "detector": self.detector,
            "scene graph": self.scene_graph,
        }  # fmt: skip
        if self.detector is not None and is_image_detector(self.detector):
            del given["detector"]
        return {stage: name for stage, name in given.items() if name is not None and name != ORACLE}

    @property
    def detector_choice(self) -> DetectorChoice:
        """The detector that finds objects, and why it is this one."""
        if self.detector is not None:
            return DetectorChoice(self.detector, "it was asked for")
        classes = {thing.model for thing in self.scene.objects}
        return choose_detector(classes, self.oracle != OracleDetectorConfig())

    @property
    def agent_name(self) -> str:
        """The agent that drives."""
        return self.agent or self.scene.agent or DEFAULT_AGENT

    def resolved(self) -> dict[str, object]:
        """Everything that the run depends on, as plain data for YAML: settings, scene, versions, machine."""
        return {
            "scene": self.scene.name,
            "seed": self.seed,
            "duration": self.seconds,
            "agent": self.agent_name,
            "detector": self.detector_choice.name,
            "detector_reason": self.detector_choice.reason,
            "tracker": self.tracker,
            "localizer": self.localizer,
            "scene_graph": self.scene_graph,
            "static_map": None if self.static_map is None else str(self.static_map),
            "oracle": plain(asdict(self.oracle)),
            "stage_limit": self.stage_limit,
            "renderer": self.renderer,
            "threads": self.threads,
            "scene_file": plain(self.scene.model_dump(mode="json")),
            "stack": plain(asdict(self.stack)),
            "versions": versions(),
            "machine": {"system": platform.platform(), "processor": _processor()},
        }


def versions() -> dict[str, str]:
    """Versions of simtrack, Python and the packages that results depend on."""
    from importlib.metadata import PackageNotFoundError, version

    found = {"simtrack": simtrack.__version__, "python": platform.python_version()}
    for package in _PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "not installed"
    return found


def plain(value: object) -> object:
    """Nested settings as dicts, lists, strings and numbers."""
    match value:
        case Mapping():
            return {str(key): plain(entry) for key, entry in value.items()}
        case list() | tuple():
            return [plain(entry) for entry in value]
        case set() | frozenset():
            return sorted(str(entry) for entry in value)
        case bool() | int() | float() | str() | None:
            return float(value) if isinstance(value, float) else value
        case _:
            return str(value)


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor()
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), "unknown")
