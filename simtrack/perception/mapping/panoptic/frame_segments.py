"""Panoptic and geometric segments of one frame made one: section 3.1 of the reconstruction paper.

Every geometric segment takes the panoptic segment that covers most of it. Two steps make up for what that loses: a
panoptic segment inside a larger geometric one is split out of it (a keyboard on a table), and of the geometric segments
of one thing only the largest Euclidean cluster stays with it (the floor behind a chair does not).
"""

from collections.abc import Sequence, Set
from dataclasses import dataclass, replace

import numpy as np

from simtrack.contracts import Bool, CameraIntrinsics, Float32, Float64, Int32
from simtrack.errors import InvalidValueError
from simtrack.perception.segmentation.panoptic import PanopticSegments

SILENT = -1
"""Panoptic segment of a segment of which a frame does not say what it belongs to."""


@dataclass(frozen=True, slots=True)
class FrameFusionConfig:
    """Settings of `fuse_segments`."""

    split: bool = True
    """Whether panoptic segments are split out of geometric ones."""
    inside: float = 0.5
    """Share of a panoptic segment that must lie in a geometric one to be split out of it ..."""
    part: float = 0.5
    """... of which it must be less than this share; one with more outside all geometric segments is one by itself."""
    min_pixels: int = 40
    """Readings, of an image of 640 x 480, that a segment needs which is split out, or which no geometric one covers."""
    covered: float = 0.2
    """Share of a geometric segment that the panoptic one which it takes must cover."""
    fill: bool = True
    """Whether readings of a mask that no geometric segment has, as on edges, thin things and at grazing angles, go to
    the segments of the mask beside them, or make segments of their own."""
    step: float = 0.02
    """Share of the depth by which such readings differ from those beside them."""
    trust: bool = True
    """Whether masks that are known to be good have all their readings, whatever segment those are in: the foot of a
    monitor is in one with the table, and what stands on a table has some of it around its own."""
    trusted: float = 0.97
    """Share of the readings of things' masks, in all frames so far, that must be in segments of theirs for masks to be
    known to be good: borders that were drawn wrong do not follow edges in depth."""
    cluster: bool = True
    """Whether things keep only their largest cluster."""
    silent: bool = True
    """Whether what is cut off from a thing says nothing in this frame, as it may be the leg of a table of which another
    part is hidden; else it is background, as in the paper."""
    distance: float = 0.05
    """Metres between segments of one cluster."""
    hidden: tuple[float, float] = (0.4, 0.2)
    """Metres from the largest cluster, and share of its readings, up to which what is cut off from it is taken for a
    part of it to which the way is hidden, as the foot of a table is below its top; zeros: never, as in the paper."""
    masked: bool = True
    """Whether readings of a segment beside the mask that it took say nothing of its surface: a book that was not found
    in an image is in one segment with the table and not in its mask ..."""
    split_votes: int = 2
    """... and observations that one of a mask which is split out of a geometric segment counts for: networks miss what
    is there far more often than they find what is not."""
    flat: bool = True
    """Whether small segments of stuff that lie off the planes of its large ones say nothing in this frame: what stands
    before a wall and was not found is not wall."""
    off_plane: float = 0.04
    """Metres between such a segment and those planes."""
    plane_area: float = 0.15
    """Square metres, seen from the camera, of a segment that is large."""

    def __post_init__(self) -> None:
        for name in ("inside", "part", "covered", "trusted"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise InvalidValueError(f"FrameFusionConfig.{name}", getattr(self, name), "a share, 0 to 1")
        if not 0.0 < self.step < 1.0:
            raise InvalidValueError("FrameFusionConfig.step", self.step, "a share, above 0 and below 1")
        if not 0.0 < self.distance < 10.0:
            raise InvalidValueError("FrameFusionConfig.distance", self.distance, "metres, above 0 and below 10")
        if not 0.0 <= min(self.hidden) <= max(self.hidden) < 100.0:
            raise InvalidValueError("FrameFusionConfig.hidden", self.hidden, "metres and a share, 0 or more")
        for name in ("off_plane", "plane_area"):
            if not 0.0 < getattr(self, name) < 100.0:
                raise InvalidValueError(f"FrameFusionConfig.{name}", getattr(self, name), "above 0 and below 100")
        for name in ("min_pixels", "split_votes"):
            if not 1 <= getattr(self, name) <= 10_000:
                raise InvalidValueError(f"FrameFusionConfig.{name}", getattr(self, name), "1 to 10000")

    @staticmethod
    def of_paper() -> "FrameFusionConfig":
        """Section 3.1 alone: masks are split out of segments that contain them, what is not in the largest cluster of a
        thing is background, and nothing is filled in or held to planes.
        """
        return FrameFusionConfig(
            inside=0.9,
            fill=False,
            trust=False,
            silent=False,
            hidden=(0.0, 0.0),
            masked=False,
            split_votes=1,
            flat=False,
        )

    @staticmethod
    def of_voxbloxpp() -> "FrameFusionConfig":
        """Geometric segments take the mask that covers most of them, and that is all."""
        return FrameFusionConfig(
            split=False, fill=False, trust=False, cluster=False, flat=False, masked=False, split_votes=1
        )


@dataclass(frozen=True, slots=True, eq=False)
class FrameSegments:
    """The segments (P_k, c_k, o_k) of one frame."""

    image: Int32
    """(H, W): number of the segment that a reading belongs to, from 1; 0 = none."""
    instances: Int32
    """(N + 1,): number of the panoptic segment that each one belongs to, 0 = background, `SILENT` = not to be told;
    entry 0 is not a segment."""
    sizes: Int32
    """(N + 1,): readings."""
    geometric: Bool
    """(N + 1,): whether depth alone drew it; else a mask did, wherever that leaks to."""
    agreement: tuple[int, int] = (0, 0)
    """Readings of things' masks in segments that depth drew and that are theirs, or that are split out for them; and of
    all that are in segments."""

    def __len__(self) -> int:
        return len(self.instances) - 1


def fuse_segments(
    geometric: Int32,
    panoptic: PanopticSegments,
    depth: Float32,
    intrinsics: CameraIntrinsics,
    stuff: Set[str] = frozenset(),
    config: FrameFusionConfig | None = None,
    trust: bool = False,
) -> FrameSegments:
    """Fuse the two segmentations of a frame.

    Args:
        geometric: (H, W), from 1; 0 = none.
        panoptic: segments of the image.
        depth: (H, W), metres, 0 = no reading.
        intrinsics: of the image.
        stuff: classes whose segments need not hang together.
        config: settings, the defaults if None.
        trust: whether masks are known to be good, see `FrameFusionConfig.trusted`.
    """
    config = config or FrameFusionConfig()
    read, masks = depth > 0.0, len(panoptic)
    pairs = np.where(read, geometric * (masks + 1) + panoptic.image, 0)
    size = (int(geometric.max(initial=0)) + 1) * (masks + 1)
    joint = np.bincount(pairs[read], minlength=size).reshape(-1, masks + 1)
    least = max(1, round(config.min_pixels * (intrinsics.width / 640.0) ** 2))
    extracted = _extracted(joint, least, config) if config.split else np.zeros_like(joint, bool)
    table = np.repeat(np.arange(len(joint)), masks + 1).reshape(joint.shape)
    table[extracted] = len(joint) + np.arange(int(extracted.sum()))
    rest = np.where(extracted, 0, joint)
    total, taken = rest.sum(axis=1), np.where(rest[:, 1:].size, rest[:, 1:], 0)
    best = taken.argmax(axis=1) if masks else np.zeros(len(rest), np.int64)
    covering = taken[np.arange(len(rest)), best] if masks else np.zeros(len(rest), np.int64)
    covered = (covering > 0) & (covering >= config.covered * total)
    instances = np.concatenate([np.where(covered, best + 1, 0), np.nonzero(extracted)[1]]).astype(np.int32)
    sizes = np.concatenate([total, joint[extracted]]).astype(np.int32)
    instances[0] = sizes[0] = 0
    numbers = np.where(sizes > 0, np.cumsum(sizes > 0), 0).astype(np.int32)
    image = np.where(read, numbers[table].ravel()[pairs], 0).astype(np.int32)
    kept = np.concatenate([[0], np.flatnonzero(sizes > 0)])
    segments = FrameSegments(image, instances[kept], sizes[kept], kept < len(joint))
    thing = np.array([False, *(name not in stuff for name in panoptic.classes)])
    own = np.where(np.arange(masks + 1) == instances[table], joint, 0)
    # What is on edges, in no geometric segment, says nothing.
    agreement = int(own[:, thing].sum()), int(joint[1:, thing].sum() + np.where(extracted, joint, 0)[0, thing].sum())
    if config.fill and masks:
        segments = _filled(segments, panoptic.image, depth, config.step, least)
    if config.trust and trust and masks:
        segments = _taken_back(segments, panoptic.image, masks, least)
    if config.cluster and masks:
        things = [k + 1 for k, name in enumerate(panoptic.classes) if name not in stuff]
        _keep_largest_clusters(segments, panoptic.image, things, depth, intrinsics, config)
    if config.flat:
        for number in (k + 1 for k, name in enumerate(panoptic.classes) if name in stuff):
            _keep_planes(segments, number, depth, intrinsics, config)
    return replace(segments, agreement=agreement)


def _keep_planes(
    segments: FrameSegments, number: int, depth: Float32, intrinsics: CameraIntrinsics, config: FrameFusionConfig
) -> None:
    """Silence the segments of one mask of stuff that lie off the planes of its large segments, in place."""
    stride = max(1, intrinsics.width // 320)
    sparse = segments.image[::stride, ::stride]
    parts = {
        member: _points(sparse == member, depth, intrinsics, stride, config.distance)
        for member in np.flatnonzero(segments.instances == number).tolist()
    }
    parts = {member: points for member, points in parts.items() if len(points)}
    pixel = 1.0 / (intrinsics.fx * intrinsics.fy)
    area = {k: segments.sizes[k] * pixel * float(np.mean(points[:, 2] ** 2)) for k, points in parts.items()}
    large = [member for member in parts if area[member] >= config.plane_area and len(parts[member]) >= 3]
    if not large:
        return
    planes = [_plane(parts[member]) for member in large]
    for member in parts.keys() - set(large):
        off = [float(np.median(np.abs(parts[member] @ normal - level))) for normal, level in planes]
        if min(off) > config.off_plane:
            segments.instances[member] = SILENT


def _plane(points: Float64) -> tuple[Float64, float]:
    """Normal and distance from the origin of the plane nearest to points."""
    middle = points.mean(axis=0)
    normal = np.linalg.svd(points - middle, full_matrices=False)[2][2]
    return normal, float(normal @ middle)


def _filled(segments: FrameSegments, masks: Int32, depth: Float32, step: float, least: int) -> FrameSegments:
    """The segments, grown over readings of their masks, and new ones of what is left of those."""
    from simtrack.perception.mapping.panoptic import fill_kernels as kernels

    image = segments.image
    kernels.grow_inside(image, segments.instances, masks, depth, np.float32(step))
    more = kernels.pieces_inside(image, masks, depth, np.float32(step), least, len(segments.instances))
    instances = np.concatenate([segments.instances, more]).astype(np.int32)
    sizes = np.bincount(image.ravel(), minlength=len(instances)).astype(np.int32)
    sizes[0] = 0
    geometric = np.concatenate([segments.geometric, np.zeros(len(more), np.bool_)])
    return FrameSegments(image, instances, sizes, geometric)


def _taken_back(segments: FrameSegments, masks: Int32, count: int, least: int) -> FrameSegments:
    """The segments, with readings of a mask that are in others' given to the largest segment of the mask.

    A mask that has none makes a new one of them.
    """
    image, instances = segments.image, segments.instances
    stray = (masks > 0) & (image > 0) & (instances[image] != masks)
    main = np.zeros(count + 1, np.int32)
    for number in np.argsort(segments.sizes, kind="stable").tolist():
        if instances[number] > 0 and segments.sizes[number] > 0:
            main[instances[number]] = number
    strays = np.bincount(masks[stray], minlength=count + 1)
    more = np.flatnonzero((main == 0) & (strays >= least))
    main[more] = len(instances) + np.arange(len(more))
    moved = stray & (main[masks] > 0)
    image[moved] = main[masks[moved]]
    instances = np.concatenate([instances, more]).astype(np.int32)
    sizes = np.bincount(image.ravel(), minlength=len(instances)).astype(np.int32)
    sizes[0] = 0
    return FrameSegments(image, instances, sizes, np.concatenate([segments.geometric, np.zeros(len(more), np.bool_)]))


def _extracted(joint: np.ndarray, least: int, config: FrameFusionConfig) -> np.ndarray:
    """(G + 1, M + 1) bool: where a panoptic segment is split out of a geometric one, or is all that covers readings."""
    of_mask = joint / np.maximum(joint.sum(axis=0, keepdims=True), 1)
    of_segment = joint / np.maximum(joint.sum(axis=1, keepdims=True), 1)
    found = (of_mask > config.inside) & (of_segment < config.part)
    # What no geometric segment covers is on edges, unless that is most of the mask: then it is small or thin.
    found[0] = of_mask[0] > config.part
    found &= joint >= least
    found[:, 0] = False
    return found


def _keep_largest_clusters(
    segments: FrameSegments, masks: Int32, things: Sequence[int], depth: Float32, intrinsics: CameraIntrinsics,
    config: FrameFusionConfig,
) -> None:  # fmt: skip
    """Take the segments of a thing that are not in its largest cluster out of it, in place.

    Readings of its mask that are in no segment, as those on edges, hold segments together too.
    """
    stride = max(1, intrinsics.width // 320)  # rows on a table top seen at a grazing angle are far apart
    sparse, mask = segments.image[::stride, ::stride], masks[::stride, ::stride]
    free = (sparse == 0) & (depth[::stride, ::stride] > 0.0)
    for thing in things:
        members = np.flatnonzero(segments.instances == thing)
        if len(members) < 2:
            continue
        masks_of = [sparse == number for number in members.tolist()]
        cell = 0.5 * config.distance
        points = [_points(chosen, depth, intrinsics, stride, cell) for chosen in masks_of]
        loose = _points(free & (mask == thing), depth, intrinsics, stride, cell)
        cluster = _clusters([*points, *loose[:, None]], config.distance)[: len(members)]
        weight = np.bincount(cluster, segments.sizes[members])
        main = int(weight.argmax())
        hidden = _hidden(points, cluster, weight, main, config)
        segments.instances[members[(cluster != main) & ~hidden[cluster]]] = SILENT if config.silent else 0


def _hidden(
    points: Sequence[Float64], cluster: np.ndarray, weight: np.ndarray, main: int, config: FrameFusionConfig
) -> np.ndarray:
    """(K,) bool: clusters that are small and near to the main one."""
    from scipy.spatial import KDTree

    distance, share = config.hidden
    small = (weight > 0) & (weight <= share * weight[main])
    if distance > 0.0 and small.any():
        tree = KDTree(np.concatenate([p for p, k in zip(points, cluster, strict=True) if k == main]))
        for number in np.flatnonzero(small).tolist():
            own = np.concatenate([p for p, k in zip(points, cluster, strict=True) if k == number])
            near = len(own) and float(tree.query(own, distance_upper_bound=distance)[0].min()) <= distance
            small[number] = bool(near)
    return small & (distance > 0.0)


def _points(mask: np.ndarray, depth: Float32, intrinsics: CameraIntrinsics, stride: int, cell: float) -> Float64:
    """(N, 3) points in the camera frame of the readings in a mask of every stride-th pixel, one a cell of a grid."""
    v, u = np.nonzero(mask)
    v, u = v * stride, u * stride
    z = depth[v, u].astype(float)
    x, y = (u - intrinsics.cx) / intrinsics.fx * z, (v - intrinsics.cy) / intrinsics.fy * z
    points = np.stack([x, y, z], axis=1).astype(np.float64)
    cells = np.floor(points / cell).astype(np.int64) + (1 << 20)
    return points[np.unique((cells[:, 0] << 42) | (cells[:, 1] << 21) | cells[:, 2], return_index=True)[1]]


def _clusters(groups: Sequence[Float64], distance: float) -> np.ndarray:
    """(N,) number of the cluster of each group of points: single linkage, at most `distance` metres apart."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import KDTree

    points = np.concatenate(groups)
    owner = np.repeat(np.arange(len(groups)), [len(g) for g in groups])
    pairs = KDTree(points).query_pairs(distance, output_type="ndarray") if len(points) else np.empty((0, 2), int)
    links = owner[pairs]
    links = links[links[:, 0] != links[:, 1]]
    graph = coo_matrix((np.ones(len(links), np.int8), (links[:, 0], links[:, 1])), (len(groups),) * 2)
    return connected_components(graph, directed=False)[1]
