"""Parts of a map that are far from the camera, on disk: memory is bounded by what is near, however long the run.

Blocks are kept in cubic regions. Before a frame is fused, the regions that its readings can reach are brought back;
what lies farther than a greater distance is written away. The map is the same, voxel by voxel, as if it never was.
"""

import tempfile
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

import numpy as np

from simtrack.contracts import Float64
from simtrack.errors import InvalidValueError
from simtrack.objects.cache import open_arrays, write_arrays
from simtrack.perception.mapping.panoptic.volume import STORED, Volume
from simtrack.perception.mapping.panoptic.volume_kernels import SIDE, block_coordinates


@dataclass(frozen=True, slots=True)
class SwapConfig:
    """Settings of `SwappedRegions`."""

    distance: float = 8.0
    """Metres from the camera from which regions are written away; beyond the reach of its readings."""
    region: int = 8
    """Blocks a side."""
    every: int = 10
    """Frames from one look for what is far to the next."""

    def __post_init__(self) -> None:
        if not 0.5 <= self.distance <= 10_000.0:
            raise InvalidValueError("SwapConfig.distance", self.distance, "0.5 to 10000 metres")
        if self.every < 1:
            raise InvalidValueError("SwapConfig.every", self.every, "1 or more")
        if not 1 <= self.region <= 1024:
            raise InvalidValueError("SwapConfig.region", self.region, "1 to 1024 blocks")


class SwappedRegions:
    """Keeps the far parts of a volume in files of a temporary folder; a context manager."""

    def __init__(self, volume: Volume, reach: float, config: SwapConfig | None = None) -> None:
        """For a volume whose frames reach so many metres from the camera.

        Raises:
            InvalidValueError: regions would be written away that frames still reach.
        """
        self.config = config or SwapConfig()
        self._volume, self._reach = volume, reach
        self._side = self.config.region * SIDE * volume.config.voxel
        if self.config.distance < reach:
            allowed = f"at least the reach of the readings, {reach:.2f} metres"
            raise InvalidValueError("SwapConfig.distance", self.config.distance, allowed)
        self._folder = tempfile.TemporaryDirectory(prefix="simtrack-map-")
        self._files: dict[tuple[int, int, int], Path] = {}
        self._frames = 0
        self.written = 0
        """Regions that were written away so far."""

    def approach(self, eye: Float64) -> None:
        """Bring back what a frame from there, (3,) metres in the map, can reach; write away what is far."""
        self._frames += 1
        if self._frames % self.config.every == 0:
            self._leave(eye)
        self._bring([region for region in self._files if self._distance(region, eye) <= self._reach])

    def bring_all(self) -> None:
        """Bring back everything."""
        self._bring(list(self._files))

    def close(self) -> None:
        """Remove the files."""
        self._folder.cleanup()

    def __enter__(self) -> "SwappedRegions":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _distance(self, region: tuple[int, int, int], eye: Float64) -> float:
        """Metres from a point to a region."""
        low = np.array(region) * self._side - self._volume.config.voxel
        return float(np.linalg.norm(np.maximum(np.maximum(low - eye, eye - low - self._side), 0.0)))

    def _leave(self, eye: Float64) -> None:
        volume = self._volume
        regions = block_coordinates(volume.keys[: volume.count]) // self.config.region
        found, owner = np.unique(regions, axis=0, return_inverse=True)
        far = np.array([self._distance(tuple(region), eye) > self.config.distance for region in found.tolist()], bool)
        owner = owner.ravel()
        for number in np.flatnonzero(far).tolist():
            region = tuple(found[number].tolist())
            path = Path(self._folder.name) / f"{self.written}.npz"
            write_arrays(path, volume.blocks(owner == number))
            self._files[region] = path
            self.written += 1
        if far.any():
            volume.remove(far[owner])

    def _bring(self, regions: list[tuple[int, int, int]]) -> None:
        for region in sorted(regions):
            path = self._files[region]
            with open_arrays(path) as data:
                self._volume.add({name: data[name] for name in STORED})
            del self._files[region]
            path.unlink()
