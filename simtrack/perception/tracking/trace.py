"""What one registration of the tracker was given and gave: enough to do it again."""

from collections.abc import Mapping
from dataclasses import dataclass

from simtrack.contracts import CameraIntrinsics, Float32, Float64, PoseHypothesis
from simtrack.perception.tracking.registration import RegistrationResult


@dataclass(frozen=True, slots=True, eq=False)
class RegistrationTrace:
    """One frame's registration: `Registration.track` of the same inputs gives the same results to the bit."""

    stamp: int
    """Nanoseconds."""
    depth: Float32
    """(H, W), metres, 0 = no reading."""
    intrinsics: CameraIntrinsics
    T_map_camera: Float64
    """(4, 4), believed."""
    classes: Mapping[int, str]
    """Track id -> class name, in the order in which they were handed over."""
    predicted: Mapping[int, Float64]
    """Track id -> (4, 4) T_camera_object as the filter predicted it."""
    results: Mapping[int, RegistrationResult]
    """Of the tracks that project into the image."""
    hypotheses: tuple[PoseHypothesis, ...]
    """Of detections that came in with the frame."""
