"""Settings of the localizer, validated where they are made."""

from dataclasses import dataclass, field, fields

from simtrack.errors import InvalidValueError


def _positive(config: object, *names: str) -> None:
    for name in names:
        value = getattr(config, name)
        if not (value > 0.0 and value < float("inf")):
            raise InvalidValueError(f"{type(config).__name__}.{name}", value, "a finite number > 0")


@dataclass(frozen=True, slots=True)
class MotionConfig:
    """How far odometry is trusted: standard deviations that grow with the motion between two corrections.

    The four-parameter model of Thrun et al., Probabilistic Robotics, sec. 5.4, plus a floor that grows with time and
    covers small slips. The errors of one interval are taken as fully correlated, which is the cautious choice.
    """

    translation_per_metre: float = 0.03
    """m/m."""
    translation_per_radian: float = 0.01
    """m/rad."""
    rotation_per_metre: float = 0.01
    """rad/m."""
    rotation_per_radian: float = 0.03
    """rad/rad."""
    drift_translation: float = 0.002
    """m/sqrt(s), moving or not."""
    drift_rotation: float = 0.001
    """rad/sqrt(s), likewise."""
    blind_speed: float = 0.5
    """m/s, standard deviation of the speed where there is no odometry at all."""
    blind_turn_rate: float = 0.5
    """rad/s, likewise."""
    max_extrapolation: float = 0.25
    """s: how long the last speeds of the odometry are carried on when its readings stop."""
    horizon: float = 6.0
    """s of odometry and of corrections that are kept for late stamps."""

    def __post_init__(self) -> None:
        _positive(self, *(f.name for f in fields(self)))


@dataclass(frozen=True, slots=True)
class RegistrationConfig:
    """MICP-L: how one measurement is registered to the mesh map."""

    strides: tuple[int, ...] = (5, 3, 2)
    """Every how many-th block of shots takes part, one entry a ray-casting iteration. Coarse first: the last one
    decides."""
    settled: float = 0.01
    """m, at the median range: an iteration that moves the pose by less is followed by the last one at once."""
    inner_iterations: int = 5
    """Gauss-Newton steps on the correspondences of one ray-casting iteration."""
    step_tolerance: float = 5e-5
    """m, at the median range: smaller Gauss-Newton steps end the inner iterations."""
    range_sigma: float = 0.008
    """m, along the ray, white."""
    pointing_sigma: float = 0.001
    """rad, of a shot's direction: beam divergence and what de-skewing leaves."""
    normal_sigma: float = 0.02
    """rad, of the map's (smoothed) normals; decides which directions the data really constrain."""
    systematic_sigma: float = 0.0005
    """m, of the pose: discretisation and calibration errors that no averaging removes."""
    systematic_angle: float = 0.0002
    """rad, likewise."""
    min_gate: float = 0.06
    """m, smallest point-to-plane distance at which a correspondence is still taken."""
    max_gate: float = 1.0
    """m, largest."""
    min_kernel: float = 0.02
    """m, smallest scale of the Geman-McClure kernel."""
    min_correspondences: int = 60
    """Fewer than these: no correction."""
    observability: float = 4.0
    """A direction counts as observed if its information is this many times what noisy normals alone would feign."""
    floor_sigma: float = 0.02
    """m: how closely the base keeps to the map's floor."""
    tilt_sigma: float = 0.01
    """rad: how closely the base stays upright."""

    def __post_init__(self) -> None:
        _positive(self, *(f.name for f in fields(self) if f.name != "strides"))
        if not self.strides or min(self.strides) < 1:
            raise InvalidValueError("RegistrationConfig.strides", self.strides, "one or more integers >= 1")


@dataclass(frozen=True, slots=True)
class SearchConfig:
    """The correlative search over the floor (global, or in a window)."""

    resolution: float = 0.1
    """m, of the likelihood field."""
    heights: tuple[float, ...] = (0.15, 0.6, 1.1, 1.7, 2.4)
    """m above the floor: bounds of the layers that the map is sliced into."""
    sigma: float = 0.12
    """m, of the likelihood field."""
    coarse_cell: float = 0.4
    """m, side of the position cells that the search starts with."""
    coarse_yaw: float = 0.07
    """rad, likewise of yaw."""
    levels: int = 3
    """Coarse to fine; each level halves the cells and the yaw step."""
    points: tuple[int, ...] = (64, 128, 256)
    """Scan points looked up per pose, one entry a level."""
    beam: tuple[int, ...] = (24_000, 6_000, 1_500)
    """Poses kept after each level."""
    keep: float = 0.75
    """Poses whose bound lies below this share of the best one are pruned."""
    modes: int = 32
    """Distinct maxima that are handed on to registration."""
    max_range: float = 25.0
    """m: farther points are left out."""
    clearance: float = 0.2
    """m that a robot's centre keeps from obstacles; nearer poses are not considered."""

    def __post_init__(self) -> None:
        _positive(self, "resolution", "sigma", "coarse_cell", "coarse_yaw", "max_range", "clearance")
        if len(self.points) != self.levels or len(self.beam) != self.levels:
            raise InvalidValueError(
                "SearchConfig.points, beam", (self.points, self.beam), f"{self.levels} entries each"
            )
        if len(self.heights) < 2 or list(self.heights) != sorted(self.heights):
            raise InvalidValueError("SearchConfig.heights", self.heights, "two or more ascending heights")


@dataclass(frozen=True, slots=True)
class RecoveryConfig:
    """When the pose counts as lost, and what it takes to believe a new one."""

    collapse: float = 0.6
    """Lost if the explained share of the structure falls below this share of its running level ..."""
    collapse_scans: int = 3
    """... in so many consecutive scans."""
    min_share: float = 0.3
    """Below this explained share of the structure no pose is believed at all."""
    jump_translation: float = 0.25
    """m: a correction beyond this (and beyond 5 sigma) contradicts odometry and calls for a search."""
    jump_rotation: float = 0.12
    """rad, likewise."""
    accept_share: float = 0.6
    """Explained share of the structure that a found pose must reach."""
    accept_lead: float = 0.4
    """(wins - losses) / (wins + losses) over every rival, on the shots that tell them apart, after some travel ..."""
    accept_lead_still: float = 0.6
    """... and before that travel."""
    min_difference: float = 0.02
    """Two poses whose explanations of the scans differ in a smaller share of the shots cannot be told apart."""
    accept_scans: int = 6
    """Scans over which a found pose must lead."""
    accept_searches: int = 3
    """Global searches in a row that must find nothing better."""
    accept_travel: float = 2.0
    """m (a radian of turning counts as half a metre)."""
    search_period: float = 1.0
    """s between two global searches while no pose is believed."""
    hypotheses: int = 10
    """Kept at most."""
    window: float = 1.2
    """m, half side of the local search around a start that is not trusted."""
    window_yaw: float = 0.4
    """rad, likewise."""


@dataclass(frozen=True, slots=True)
class LocalizerConfig:
    """Settings of `MeshLocalizer`."""

    motion: MotionConfig = field(default_factory=MotionConfig)
    registration: RegistrationConfig = field(default_factory=RegistrationConfig)
    search: SearchConfig = field(default_factory=SearchConfig)
    recovery: RecoveryConfig = field(default_factory=RecoveryConfig)
    trusted_sigma: float = 0.1
    """m: a start pose that is surer than this ..."""
    trusted_sigma_yaw: float = 0.05
    """rad: ... and this is tracked from at once, if the first scan agrees with it; otherwise it is searched around."""
    initial_sigma: float = 0.25
    """m: standard deviation of a start pose that is given without covariance."""
    initial_sigma_yaw: float = 0.1
    """rad, likewise."""
    min_range: float = 0.3
    """m: shorter lidar ranges are not used."""
    max_range: float = 100.0
    """m: longer ones neither."""
    depth_stride: int = 8
    """Every how many-th row and column of a depth image is used."""
    depth_max_range: float = 6.0
    """m."""

    def __post_init__(self) -> None:
        _positive(
            self, "initial_sigma", "initial_sigma_yaw", "min_range", "max_range", "depth_stride", "depth_max_range"
        )
