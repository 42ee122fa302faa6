"""Camera poses with the errors of a visual SLAM system such as ORB-SLAM2 with an RGB-D camera (Mur-Artal et al., 2017).

The error is what drifts and is pulled back where places are seen again (a Gauss-Markov process), what each image adds,
and now and then the loss of the track, from which it returns with another error. Deviations are those of the paper's
table on the TUM benchmark: absolute errors of 0.5 to 2.5 cm.
"""

from dataclasses import dataclass

import numpy as np

from simtrack.contracts import NANOSECONDS, Float64
from simtrack.errors import InvalidValueError
from simtrack.geometry.transforms import perturb


@dataclass(frozen=True, slots=True)
class PoseErrors:
    """Standard deviations of the errors: metres for each axis, radians for each axis."""

    drift: tuple[float, float] = (0.009, 0.004)
    """Of what drifts ..."""
    correlation: float = 8.0
    """... and is forgotten within so many seconds."""
    jitter: tuple[float, float] = (0.002, 0.0012)
    """Of what each image adds."""
    lost: float = 0.02
    """Share of images whose pose is not known."""
    jumps: float = 0.005
    """Share of images with a pose far off (a wrong relocalization)."""
    jump: float = 0.6
    """Metres, standard deviation of those for each axis."""

    def __post_init__(self) -> None:
        for name in ("lost", "jumps"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise InvalidValueError(f"PoseErrors.{name}", getattr(self, name), "a share, 0 to 1")
        if not 0.0 < self.correlation < 1e6:
            raise InvalidValueError("PoseErrors.correlation", self.correlation, "seconds > 0")
        for name in ("drift", "jitter", "jump"):
            if not np.all((np.array(getattr(self, name)) >= 0.0) & (np.array(getattr(self, name)) < 10.0)):
                raise InvalidValueError(f"PoseErrors.{name}", getattr(self, name), "0 or more, below 10")


class NoisyPoses:
    """Gives true poses the errors of a SLAM system, image by image."""

    def __init__(self, rng: np.random.Generator, errors: PoseErrors | None = None) -> None:
        """The first pose is true: it is what the map's frame is fixed to."""
        self.errors, self._rng = errors or PoseErrors(), rng
        self._drift, self._stamp = np.zeros(6), -1

    def pose(self, stamp: int, T_map_camera: Float64) -> Float64 | None:
        """The estimated pose (4, 4) of an image of that stamp, nanoseconds; None where the track is lost."""
        errors, rng = self.errors, self._rng
        seconds = 0.0 if self._stamp < 0 else (stamp - self._stamp) / NANOSECONDS
        first, self._stamp = self._stamp < 0, stamp
        kept = float(np.exp(-max(seconds, 0.0) / errors.correlation))
        draws = rng.standard_normal((3, 6))
        luck = rng.random(2)
        self._drift = kept * self._drift + np.sqrt(1.0 - kept**2) * np.repeat(errors.drift, 3) * draws[0]
        if first:
            return T_map_camera.copy()
        if luck[0] < errors.lost:
            return None
        off = self._drift + np.repeat(errors.jitter, 3) * draws[1]
        if luck[1] < errors.jumps:
            off[:3] += errors.jump * draws[2, :3]
        # Rotations perturb about the camera, not about the map's origin.
        return perturb(T_map_camera, off)
