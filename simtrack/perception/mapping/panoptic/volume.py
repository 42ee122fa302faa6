"""A sparse truncated signed distance field with colours and segment labels."""

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numba as nb
import numpy as np
import numpy.typing as npt

from simtrack.contracts import Bool, CameraIntrinsics, Float32, Float64, Int32, Uint8
from simtrack.errors import InvalidValueError
from simtrack.geometry.transforms import inverse
from simtrack.perception.mapping.panoptic import volume_kernels as kernels

_FIRST = 4096
"""Blocks that there is room for at first."""
STORED = ("keys", "distances", "weights", "colors", "labels", "support")
"""Arrays of a volume that have a row for every block."""
_MOST_WEIGHT, _MOST_SUPPORT = 100.0, 40


@dataclass(frozen=True, slots=True)
class VolumeConfig:
    """Resolution of a volume."""

    voxel: float = 0.02
    """Metres."""
    truncation: float = 4.0
    """Voxels from the surface at which distances are cut."""
    label_band: float = 2.0
    """Voxels from the surface within which labels and colours are kept."""
    max_blocks: int = 400_000
    """Blocks of 512 voxels, about 9 kB each; more are an error."""

    def __post_init__(self) -> None:
        if not 0.002 <= self.voxel <= 0.5:
            raise InvalidValueError("VolumeConfig.voxel", self.voxel, "0.002 to 0.5 metres")
        if not 1.5 <= self.truncation <= 16.0:
            raise InvalidValueError("VolumeConfig.truncation", self.truncation, "1.5 to 16 voxels")
        if not 1.0 <= self.label_band <= self.truncation:
            raise InvalidValueError("VolumeConfig.label_band", self.label_band, "1 to `truncation` voxels")
        if not 1 <= self.max_blocks <= 10_000_000:
            raise InvalidValueError("VolumeConfig.max_blocks", self.max_blocks, "1 to 10000000")


class Volume:
    """Blocks of voxels around surfaces. Arrays have room for more blocks than the `count` that there are."""

    def __init__(self, config: VolumeConfig | None = None) -> None:
        self.config = config or VolumeConfig()
        room = min(_FIRST, self.config.max_blocks)
        self.count = 0
        """Blocks that there are."""
        self.keys = np.zeros(room, np.int64)
        """(C,), see `volume_kernels`."""
        self.table = np.empty(0, np.int32)
        self.distances = np.zeros((room, kernels.VOXELS), np.float32)
        """(C, 512), metres, positive before the surface."""
        self.weights = np.zeros((room, kernels.VOXELS), np.float32)
        """(C, 512), 1/m^2 summed over images; 0 = never seen."""
        self.colors = np.zeros((room, kernels.VOXELS, 3), np.uint8)
        """(C, 512, 3) RGB."""
        self.labels = np.zeros((room, kernels.VOXELS), np.int32)
        """(C, 512), of segments; 0 = none."""
        self.support = np.zeros((room, kernels.VOXELS), np.int16)
        """(C, 512), observations for the label less those for others."""
        self._seen, self._turn = np.full(room, -1, np.int32), 0
        self._rehash(room)

    @property
    def nbytes(self) -> int:
        """Bytes of the blocks that there are."""
        each = sum(a[0].nbytes for a in (self.distances, self.weights, self.colors, self.labels, self.support))
        return self.count * (each + 12) + self.table.nbytes

    def overlaps(
        self, depth: Float32, segments: Int32, intrinsics: CameraIntrinsics, T_map_camera: Float64, canonical: Int32,
        stride: int = 2,
    ) -> tuple[Int32, Int32]:  # fmt: skip
        """Readings of each segment of an image in voxels of each label.

        Args:
            depth: (H, W), metres, 0 = no reading.
            segments: (H, W), from 1; 0 = none.
            intrinsics: of the image.
            T_map_camera: (4, 4).
            canonical: (L,), what each label was merged into.
            stride: every so many-th column and row is looked at.

        Returns:
            Labels (K,) that were met, and counts (S + 1, K + 1) by number of the segment and label; column 0 counts
            all readings, column k + 1 those in voxels of the k-th label.
        """
        rows, room = int(segments.max(initial=0)) + 1, 64
        while True:
            slots, counts = np.full(len(canonical), -1, np.int32), np.zeros((rows, room), np.int32)
            used = kernels.overlaps(
                depth, segments, _camera(intrinsics), T_map_camera, self.config.voxel, stride, self.keys, self.table,
                self.labels, canonical, slots, counts,
            )  # fmt: skip
            if used >= 0:
                break
            room *= 4
        met = np.flatnonzero(slots >= 0)
        met = met[np.argsort(slots[met])].astype(np.int32)
        return met, counts[:, :used]

    def integrate(
        self, depth: Float32, rgb: Uint8 | None, labels: Int32, intrinsics: CameraIntrinsics, T_map_camera: Float64,
        same: Int32 | None = None, listed: Int32 | None = None, votes: npt.NDArray[np.int16] | None = None,
    ) -> int:  # fmt: skip
        """Fuse one image; the results do not depend on the number of threads.

        Args:
            depth: (H, W), metres, 0 = no reading.
            rgb: (H, W, 3), or None.
            labels: (H, W), of segments; 0 = none; a negative one is taken where there is none yet, and speaks neither
                for nor against those that are there.
            intrinsics: of the image.
            T_map_camera: (4, 4).
            same: (L,), labels with the same number support each other in a voxel; None: each stands for itself.
            listed: (B,), what `touched` has told of this image; None: it is asked.
            votes: (L,), observations that one of a label counts for; None: one each.

        Returns:
            Blocks that it was fused into.

        Raises:
            InvalidValueError: more blocks would be needed than are allowed; the volume is as it was.
        """
        if listed is None:
            listed = self.touched(depth, intrinsics, T_map_camera)
        if same is None:
            most = max(int(self.labels[: self.count].max(initial=0)), int(np.abs(labels).max(initial=0)))
            same = np.arange(most + 1, dtype=np.int32)
        if votes is None:
            votes = np.ones(len(same), np.int16)
        config = self.config
        image = np.empty((0, 0, 3), np.uint8) if rgb is None else np.ascontiguousarray(rgb)
        voxel, camera = config.voxel, _camera(intrinsics)
        arguments = (
            depth, image, labels, camera, inverse(T_map_camera), voxel, config.truncation * voxel,
            config.label_band * voxel, (_MOST_WEIGHT, _MOST_SUPPORT), same, votes,
            self.keys, self.distances, self.weights, self.colors, self.labels, self.support,
        )  # fmt: skip
        threads = nb.get_num_threads()
        if threads == 1 or len(listed) < 64:
            kernels.integrate(listed, *arguments)
        else:  # blocks are independent of each other
            with ThreadPoolExecutor(threads) as pool:
                for done in [
                    pool.submit(kernels.integrate, part, *arguments) for part in np.array_split(listed, threads)
                ]:
                    done.result()
        return len(listed)

    def blocks(self, chosen: Bool | None = None) -> dict[str, np.ndarray]:
        """Arrays (B, ...) of the chosen blocks, of all if None, in the order of their keys."""
        numbers = np.arange(self.count) if chosen is None else np.flatnonzero(chosen)
        numbers = numbers[np.argsort(self.keys[numbers], kind="stable")]
        return {name: getattr(self, name)[numbers] for name in STORED}

    def remove(self, chosen: Bool) -> None:
        """Take blocks out; (count,) bool."""
        kept = np.flatnonzero(~chosen)
        for name in (*STORED, "_seen"):
            values: np.ndarray = getattr(self, name)
            values[: len(kept)] = values[kept]
            values[len(kept) : self.count] = 0
        self.count = len(kept)
        self._rehash(len(self.keys))

    def add(self, blocks: Mapping[str, np.ndarray]) -> None:
        """Put blocks in that are not there.

        Raises:
            InvalidValueError: there would be more than `VolumeConfig.max_blocks`.
        """
        more = len(blocks["keys"])
        if self.count + more > self.config.max_blocks:
            allowed = f"at most max_blocks = {self.config.max_blocks}: larger voxels, or more"
            raise InvalidValueError("blocks of the map", self.count + more, allowed)
        while self.count + more > len(self.keys):
            self._grow()
        for name in STORED:
            getattr(self, name)[self.count : self.count + more] = blocks[name]
        self._seen[self.count : self.count + more] = -1
        self.count += more
        self._rehash(len(self.keys))

    def order(self) -> None:
        """Bring the blocks into the order of their keys: what is extracted does not depend on how they came."""
        whole = self.blocks()
        for name in STORED:
            getattr(self, name)[: self.count] = whole[name]
        self._seen[: self.count] = -1
        self._rehash(len(self.keys))

    def touched(self, depth: Float32, intrinsics: CameraIntrinsics, T_map_camera: Float64) -> Int32:
        """(B,) blocks within reach of the readings, created where missing.

        Raises:
            InvalidValueError: more blocks would be needed than are allowed; the volume is as it was.
        """
        config = self.config
        # Neighbouring rays stay within half a block of each other up to 5 m.
        stride = int(np.clip(0.5 * kernels.SIDE * config.voxel * intrinsics.fx / 5.0, 1, 8))
        before = self.count
        while True:
            listed = np.empty(len(self.keys), np.int32)
            self._turn += 1
            self.count, found = kernels.touch(
                depth, _camera(intrinsics), T_map_camera, config.voxel, config.truncation * config.voxel, stride,
                self.keys, self.table, self._seen, self._turn, self.count, listed,
            )  # fmt: skip
            if found >= 0:
                return np.sort(listed[:found])  # in the order of memory
            if self.count >= config.max_blocks:
                self._forget(before)
                raise InvalidValueError(
                    "blocks of the map", self.count, f"at most max_blocks = {config.max_blocks}: larger voxels, or more"
                )
            self._grow()

    def _grow(self) -> None:
        """Make room for half as many blocks again."""
        size = min(len(self.keys) * 3 // 2 + 1, self.config.max_blocks)
        for name in ("keys", "distances", "weights", "colors", "labels", "support", "_seen"):
            old: np.ndarray = getattr(self, name)
            new = np.zeros((size, *old.shape[1:]), old.dtype)
            new[: len(old)] = old[:size]
            setattr(self, name, new)
        self._rehash(size)

    def _rehash(self, size: int) -> None:
        self.table = np.full(1 << int(np.ceil(np.log2(4 * size))), -1, np.int32)
        kernels.rehash(self.keys, self.table, self.count)

    def _forget(self, count: int) -> None:
        """Take out the blocks beyond the first `count`, which nothing was fused into."""
        self.count = count
        self._rehash(len(self.keys))


def _camera(intrinsics: CameraIntrinsics) -> tuple[float, float, float, float]:
    return intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy
