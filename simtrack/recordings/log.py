"""A recording that is one sensor's frames and perhaps its poses: what folders of images and packet captures hold."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from simtrack.contracts import Float64, LidarScan, RgbdFrame
from simtrack.objects import ObjectModel


class RecordingWarning(UserWarning):
    """A recording that can be used, but not as a whole, or not without an assumption."""


@dataclass(frozen=True, slots=True, eq=False)
class LabelledObject:
    """An object that a recording's authors annotated."""

    class_name: str
    """Name of its model."""
    T_camera_object: Float64
    """(4, 4), object frame as in `ObjectModel`."""
    visible_fraction: float
    """0 to 1; 1 where the recording says nothing."""


@dataclass(frozen=True, slots=True, eq=False)
class PosedFrame:
    """A frame, and where its sensor was if the recording says so."""

    frame: RgbdFrame | LidarScan
    """The sensor is its own base: T_base_camera or T_base_lidar is the identity."""
    T_map_sensor: Float64 | None = None
    """(4, 4), as stated by the recording, in its own fixed frame; None if it says nothing of this frame."""
    labels: tuple[LabelledObject, ...] = ()
    """Annotated objects whose models the recording has; not for estimators."""


@dataclass(frozen=True, slots=True, eq=False)
class SensorLog:
    """The frames of one sensor. They are read when asked for, one at a time."""

    path: Path
    format: str
    """For people: ``TUM RGB-D folder``."""
    sensor: Literal["camera", "lidar"]
    count: int | None
    """Number of frames, None where only reading all of it would tell."""
    read: Callable[[], Iterator[PosedFrame]]
    """Frames in order, anew at each call. Raises `FileFormatError` for a frame that is damaged."""
    models: Mapping[str, ObjectModel] = field(default_factory=dict)
    """Object models that come with it, by name."""
    posed: bool = False
    """Whether poses are stated, of some frames at least."""
    noise: float = 0.0
    """Metres, standard deviation of a lidar range as the sensor's data sheet states it; 0 for a camera."""

    def sensor_frames(self) -> Iterator[RgbdFrame | LidarScan]:
        """The frames without what is stated of their poses."""
        for entry in self.read():
            yield entry.frame
