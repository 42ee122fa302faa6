"""Settings of all stages of the perception stack."""

from dataclasses import dataclass, field

from simtrack.perception.detection.runner import RunnerConfig
from simtrack.perception.localization import LocalizerConfig
from simtrack.perception.scene_graph import SceneGraphConfig
from simtrack.perception.tracking.articulation import ArticulationConfig
from simtrack.perception.tracking.presegmentation import PresegmentationConfig
from simtrack.perception.tracking.registration_config import RegistrationConfig
from simtrack.perception.tracking.target import TrackerConfig

LIVE_PATIENCE = 0.008
"""Seconds; where nothing is in their way, the casts before the last one take half of it."""


@dataclass(frozen=True, slots=True)
class StackConfig:
    """Settings of all stages."""

    runner: RunnerConfig = field(default_factory=RunnerConfig)
    tracker: TrackerConfig = field(default_factory=TrackerConfig)
    localizer: LocalizerConfig = field(default_factory=LocalizerConfig)
    presegmentation: PresegmentationConfig = field(default_factory=PresegmentationConfig)
    scene_graph: SceneGraphConfig = field(default_factory=SceneGraphConfig)
    articulation: ArticulationConfig = field(default_factory=ArticulationConfig)
    lidar_silence: float = 0.5
    """Without a scan for this long, seconds, depth images localize the robot."""
    lidar_presegmentation_every: int = 2
    """Every how many-th scan is segmented."""
    correction_time: float = 0.06
    """A scan's correction of the pose is used this long after the scan's last shot, seconds of the sensor's clock."""
    segmentation_time: float = 0.06
    """What is segmented beside the frames is used this long after it was begun, likewise."""
    wait: bool = True
    """Frames wait for what is due and not there yet, so that beliefs are the same on every machine; `live` does not."""
    threads: bool = True
    """What is done beside the frames is done by threads of its own; else at once, with the same answers."""

    @staticmethod
    def live() -> "StackConfig":
        """For a robot, or a feed at the pace of its clock: a late answer is taken up by the frame that finds it, and a
        frame that has taken long already is done without the last cast.
        """
        registration = RegistrationConfig(patience=LIVE_PATIENCE)
        return StackConfig(wait=False, tracker=TrackerConfig(wait=False, registration=registration))
