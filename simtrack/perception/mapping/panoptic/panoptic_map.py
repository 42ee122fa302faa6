"""The panoptic map: frames in, entities out."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import TracebackType
from typing import Literal, TypeAlias

import numpy as np

from simtrack.contracts import NANOSECONDS, Float64, Int32, RgbdFrame, Status
from simtrack.errors import InvalidValueError
from simtrack.geometry.transforms import difference, is_rigid
from simtrack.perception.mapping.panoptic.association import AssociationConfig, SegmentLabels
from simtrack.perception.mapping.panoptic.counts import (
    BACKGROUND,
    NOBODY,
    CountsConfig,
    JointCounts,
    Observation,
    PanopticCounts,
    SegmentEntity,
    SeparateCounts,
)
from simtrack.perception.mapping.panoptic.entities import (
    EntityConfig,
    MapEntityMesh,
    Surface,
    extract_entities,
    extract_surface,
)
from simtrack.perception.mapping.panoptic.frame_segments import FrameFusionConfig, FrameSegments, fuse_segments
from simtrack.perception.mapping.panoptic.regions import SwapConfig, SwappedRegions
from simtrack.perception.mapping.panoptic.shell import ShellConfig, is_upright, shell_labels
from simtrack.perception.mapping.panoptic.volume import Volume, VolumeConfig
from simtrack.perception.segmentation.geometric import GeometricConfig, depth_segments
from simtrack.perception.segmentation.panoptic import PanopticSegments

Method: TypeAlias = Literal["full", "no-joint-fusion", "voxbloxpp"]
METHODS: tuple[Method, ...] = ("full", "no-joint-fusion", "voxbloxpp")


@dataclass(frozen=True, slots=True)
class PanopticMapConfig:
    """Settings of a `PanopticMap`."""

    volume: VolumeConfig = field(default_factory=VolumeConfig)
    geometric: GeometricConfig = field(default_factory=GeometricConfig)
    fusion: FrameFusionConfig = field(default_factory=FrameFusionConfig)
    association: AssociationConfig = field(default_factory=AssociationConfig)
    counts: CountsConfig = field(default_factory=CountsConfig)
    entities: EntityConfig = field(default_factory=EntityConfig)
    joint: bool = True
    """Whether classes and instances are counted together."""
    shell: ShellConfig | None = field(default_factory=ShellConfig)
    """How the shell of a room is found, which weighs in on what is floor, wall and ceiling; None leaves it out. Only
    joint counts are weighed."""
    max_depth: float = 4.0
    """Metres; farther readings are not used."""
    regularize_every: int = 10
    """Frames."""
    swap: SwapConfig | None = None
    """Which parts of the map are written to disk while the camera is far from them; None keeps all in memory."""
    max_speed: tuple[float, float] = (3.0, 6.0)
    """m/s and rad/s that a camera in hands or on a robot does not exceed: a faster step is taken for a wrong pose,
    unless the next frame confirms it."""
    max_step: tuple[float, float] = (0.1, 0.2)
    """Metres and radians that are believed however short the time."""

    def __post_init__(self) -> None:
        if not 0.1 <= self.max_depth <= 50.0:
            raise InvalidValueError("PanopticMapConfig.max_depth", self.max_depth, "0.1 to 50 metres")
        for name in ("max_speed", "max_step"):
            if not min(getattr(self, name)) > 0.0:
                raise InvalidValueError(f"PanopticMapConfig.{name}", getattr(self, name), "above 0")
        if self.regularize_every < 1:
            raise InvalidValueError("PanopticMapConfig.regularize_every", self.regularize_every, "1 or more")

    @staticmethod
    def of_method(method: Method, voxel: float = 0.02) -> "PanopticMapConfig":
        """The settings of a method of the reconstruction paper's Table 2.

        ``full``; ``no-joint-fusion``, the ablation: segments of a frame as in the paper's section 3.1, classes and
        instances counted separately, and what the counts say for the entities, as both papers do; ``voxbloxpp``, which
        besides neither splits nor clusters the segments of a frame.

        Raises:
            InvalidValueError: no such method.
        """
        if method not in METHODS:
            raise InvalidValueError("method", method, ", ".join(METHODS))
        config = PanopticMapConfig(volume=VolumeConfig(voxel=voxel))
        if method == "full":
            return config
        fusion = FrameFusionConfig.of_voxbloxpp() if method == "voxbloxpp" else FrameFusionConfig.of_paper()
        return replace(config, joint=False, shell=None, entities=EntityConfig.of_counts_alone(), fusion=fusion)


@dataclass(frozen=True, slots=True)
class MapUpdate:
    """What a frame did to the map."""

    stamp: int
    """Nanoseconds, of the frame."""
    status: Status
    """OK, or NO_DATA or FAILED: the map is as it was."""
    reason: str = ""
    """Why the frame was skipped."""
    segments: int = 0
    """Segments of the frame."""
    blocks: int = 0
    """Blocks of voxels that it was fused into."""


class PanopticMap:
    """A TSDF whose voxels carry labels of segments, and what was observed of those; a context manager if it swaps."""

    def __init__(self, config: PanopticMapConfig | None = None) -> None:
        self.config = config or PanopticMapConfig()
        self.volume = Volume(self.config.volume)
        volume = self.config.volume
        # The farthest reading in the corner of a wide image, and the truncation behind it.
        reach = 1.6 * self.config.max_depth + 2.0 * volume.truncation * volume.voxel
        self.regions = None if self.config.swap is None else SwappedRegions(self.volume, reach, self.config.swap)
        """Where far parts are, if they are written away."""
        self.labels = SegmentLabels(self.config.association)
        counts = JointCounts if self.config.joint else SeparateCounts
        self.counts: PanopticCounts = counts(self.config.counts)
        self.frames = 0
        """Frames that were fused."""
        self.agreement = (0, 0)
        """Readings of things' masks that depth agreed with, and all; see `FrameSegments`."""
        self.skipped: dict[str, int] = {}
        """Reason -> frames that were not."""
        self._fused: tuple[int, Float64] | None = None
        self._seen: tuple[int, Float64] | None = None
        """Stamp and pose of the last frame that was fused, and of the last with a pose."""

    def integrate(
        self,
        frame: RgbdFrame,
        T_map_camera: Float64 | None,
        panoptic: PanopticSegments | None,
        geometric: Int32 | None = None,
    ) -> MapUpdate:
        """Fuse one frame.

        A frame that cannot be used is skipped and counted, and leaves the map as it was.

        Args:
            frame: depth is needed, colour is not.
            T_map_camera: (4, 4); None where it is not known.
            panoptic: segments of the image; None where the segmenter failed.
            geometric: (H, W) numbers of geometric segments, from 1; None has them made of the depth.
        """
        reason = _unusable(frame, T_map_camera, panoptic)
        if reason or T_map_camera is None or panoptic is None:
            return self._skip(frame, reason)
        now, last = (frame.stamp, np.array(T_map_camera, float)), (self._fused, self._seen)
        self._seen = now
        if last[0] is not None and not any(self._follows(now, each) for each in last):
            return self._skip(frame, "the pose jumps")
        depth = np.where(frame.depth <= self.config.max_depth, frame.depth, np.float32(0.0))
        depth = np.where(np.isfinite(depth), depth, 0.0).astype(np.float32)
        if not depth.any():
            return self._skip(frame, "no readings", Status.NO_DATA)
        if geometric is None:
            geometric = depth_segments(depth, frame.intrinsics, self.config.geometric)
        stuff = self.config.counts.stuff
        own, whole = self.agreement
        trust = whole > 0 and own >= self.config.fusion.trusted * whole
        segments = fuse_segments(geometric, panoptic, depth, frame.intrinsics, stuff, self.config.fusion, trust)
        stride = max(1, round(frame.intrinsics.width / 320))
        if self.regions is not None:
            self.regions.approach(now[1][:3, 3])
        try:
            listed = self.volume.touched(depth, frame.intrinsics, T_map_camera)
        except InvalidValueError as error:
            return self._skip(frame, str(error))
        met, counts = self.volume.overlaps(
            depth, segments.image, frame.intrinsics, T_map_camera, self.labels.canonical, stride
        )
        least = max(
            1, round(self.config.association.least_readings * (frame.intrinsics.width / 640.0 * 2 / stride) ** 2)
        )
        labels = self.labels.associate(met, counts, least)
        self._fused = now
        self.agreement = own + segments.agreement[0], whole + segments.agreement[1]
        self.counts.observe(_observations(segments, labels, panoptic))
        same = self.counts.same(self.labels.canonical)
        image = labels[segments.image]
        if self.config.fusion.masked:
            owner = segments.instances[segments.image]
            image[(owner > 0) & (panoptic.image != owner)] *= -1
        votes = np.ones(len(same), np.int16)
        votes[labels[~segments.geometric]] = self.config.fusion.split_votes
        blocks = self.volume.integrate(depth, frame.rgb, image, frame.intrinsics, T_map_camera, same, listed, votes)
        for label, other in self.labels.count_overlaps(met, counts[segments.geometric], least):
            self._merge(label, other)
        self.frames += 1
        if self.frames % self.config.regularize_every == 0:
            self.counts.regularize()
        return MapUpdate(frame.stamp, Status.OK, segments=len(segments), blocks=blocks)

    def entities(self) -> tuple[MapEntityMesh, ...]:
        """The entities of the map, stuff first, then things, by class and number."""
        self.complete()
        self.counts.regularize()
        surface = extract_surface(self.volume, self.config.entities.least_weight)
        return extract_entities(surface, self.labels.canonical, self.told_segments(surface), self.config.entities)

    def told_segments(self, surface: Surface) -> Mapping[int, SegmentEntity]:
        """Global segment -> what it is part of, by what was observed of it and where it lies on the map's `surface`."""
        alone = self.counts.entities()
        if self.config.shell is None:
            return alone
        mesh, labels = surface.mesh, self.labels.canonical[surface.labels]
        classes = [alone[label].semantic_class if label in alone else "" for label in range(len(self.labels.canonical))]
        if not is_upright(mesh, np.array(classes, dtype=object)[labels]):
            return alone
        return self.counts.entities(shell_labels(mesh, labels, self.config.shell))

    def close(self) -> None:
        """Remove the files of what was written away."""
        if self.regions is not None:
            self.regions.close()

    def __enter__(self) -> "PanopticMap":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def complete(self) -> None:
        """Bring back what was written away, and order the volume: the same map is the same bytes."""
        if self.regions is not None:
            self.regions.bring_all()
        self.volume.order()

    def _merge(self, label: int, other: int) -> None:
        canonical = self.labels.canonical
        first, second = sorted((int(canonical[label]), int(canonical[other])))
        if first != second and self.counts.alike(first, second):
            self.labels.merge(second, into=first)
            self.counts.merge(second, into=first)

    def _follows(self, now: tuple[int, Float64], before: tuple[int, Float64] | None) -> bool:
        """Whether a camera can have come from one pose to the other in that time; either way, streams may go back."""
        if before is None:
            return False
        seconds = abs(now[0] - before[0]) / NANOSECONDS
        xi = difference(now[1], before[1])
        moved = np.linalg.norm(xi[:3]), np.linalg.norm(xi[3:])
        limits = zip(moved, self.config.max_speed, self.config.max_step, strict=True)
        return all(step <= speed * seconds + slack for step, speed, slack in limits)

    def _skip(self, frame: RgbdFrame, reason: str, status: Status = Status.FAILED) -> MapUpdate:
        self.skipped[reason] = self.skipped.get(reason, 0) + 1
        return MapUpdate(frame.stamp, status, reason)


def _unusable(frame: RgbdFrame, T_map_camera: Float64 | None, panoptic: PanopticSegments | None) -> str:
    """Why a frame cannot be used, or nothing."""
    if T_map_camera is None:
        return "no pose"
    if not is_rigid(np.asarray(T_map_camera, float)):
        return "the pose is not a rigid transform"
    if panoptic is None:
        return "no segmentation"
    if panoptic.image.shape != frame.depth.shape:
        return "masks and depth differ in size"
    if frame.depth.shape != (frame.intrinsics.height, frame.intrinsics.width):
        return "depth and intrinsics differ in size"
    if frame.rgb is not None and frame.rgb.shape[:2] != frame.depth.shape:
        return "colour and depth differ in size"
    return ""


def _observations(segments: FrameSegments, labels: Int32, panoptic: PanopticSegments) -> list[Observation]:
    """Panoptic segments with the labels that they lie on, the largest first; every piece of background by itself."""
    found: list[Observation] = []
    order = np.argsort(-segments.sizes, kind="stable")
    order = order[(order > 0) & (segments.sizes[order] > 0)]
    for number, name in enumerate(panoptic.classes, start=1):
        own = order[segments.instances[order] == number]
        if len(own):
            found.append(Observation(name, tuple(labels[own].tolist())))
    background = order[segments.instances[order] == NOBODY]
    return [*found, *(Observation(BACKGROUND, (label,)) for label in labels[background].tolist())]
