"""The panoptic map: surfaces come back, segments keep their labels, counts decide, nonsense changes nothing."""

import json
from dataclasses import replace
from pathlib import Path

import numba
import numpy as np
import pytest

from simtrack.contracts import NANOSECONDS, CameraIntrinsics, Float64, RgbdFrame, Status
from simtrack.errors import FileFormatError, InvalidValueError
from simtrack.geometry.meshes import Mesh, box_mesh, face_areas, face_normals
from simtrack.geometry.transforms import look_at
from simtrack.perception.mapping.panoptic.association import SegmentLabels
from simtrack.perception.mapping.panoptic.counts import (
    CountsConfig,
    JointCounts,
    Observation,
    SegmentEntity,
    SeparateCounts,
)
from simtrack.perception.mapping.panoptic.entities import (
    EntityConfig,
    MapEntityMesh,
    _least_observed,
    _lower_bound,
    extract_surface,
)
from simtrack.perception.mapping.panoptic.files import read_entities, write_entities
from simtrack.perception.mapping.panoptic.frame_segments import SILENT, FrameFusionConfig, fuse_segments
from simtrack.perception.mapping.panoptic.layout import split_layout
from simtrack.perception.mapping.panoptic.map_file import read_map, write_map
from simtrack.perception.mapping.panoptic.panoptic_map import Method, PanopticMap, PanopticMapConfig
from simtrack.perception.mapping.panoptic.regions import SwapConfig
from simtrack.perception.mapping.panoptic.shell import is_upright, shell_labels
from simtrack.perception.mapping.panoptic.volume import STORED, Volume, VolumeConfig
from simtrack.perception.segmentation.panoptic import PanopticSegments
from simtrack.raycast import RayBundle, RayScene, TriangleMesh

CAMERA = CameraIntrinsics(160, 120, 145.0, 145.0, 79.5, 59.5)
VOXEL = 0.02
BOX = Mesh(box_mesh((0.5, 0.4, 0.3)).vertices + [0.0, 0.0, 0.15], box_mesh((0.5, 0.4, 0.3)).faces)
GROUND = Mesh(box_mesh((3.0, 3.0, 0.2)).vertices - [0.0, 0.0, 0.1], box_mesh((3.0, 3.0, 0.2)).faces)


def views(count: int) -> list[tuple[RgbdFrame, Float64, PanopticSegments]]:
    """A box on the ground, seen from around: frames, poses and true segments."""
    seen, bundle = [], RayBundle.from_camera(CAMERA)
    with RayScene() as scene:
        for number, mesh in enumerate((GROUND, BOX)):
            scene.add(TriangleMesh(mesh.vertices, mesh.faces), instance=number)
        for k in range(count):
            angle = 2.0 * np.pi * k / count
            T = look_at(np.array([1.2 * np.cos(angle), 1.2 * np.sin(angle), 0.9]), np.array([0.0, 0.0, 0.1]))
            hits = scene.cast(bundle, T)
            depth = np.where(hits.hit, hits.distances, 0.0).astype(np.float32).reshape(120, 160)
            rgb = np.where(hits.instances.reshape(120, 160, 1) == 1, (200, 40, 40), (90, 90, 90)).astype(np.uint8)
            image = np.where(hits.hit, hits.instances + 1, 0).astype(np.int32).reshape(120, 160)
            segments = PanopticSegments(k, image, ("floor", "box"), np.ones(2, np.float32))
            seen.append((RgbdFrame(k * NANOSECONDS, depth, rgb, CAMERA, np.eye(4), k), T, segments))
    return seen


@pytest.fixture(scope="module")
def mapped() -> PanopticMap:
    panoptic_map = PanopticMap(PanopticMapConfig.of_method("full", VOXEL))
    for frame, T, segments in views(6):
        assert panoptic_map.integrate(frame, T, segments).status is Status.OK
    return panoptic_map


def test_surfaces_come_back_where_they_were_and_face_the_camera(mapped: PanopticMap) -> None:
    surface = extract_surface(mapped.volume, 1.0).mesh
    with RayScene() as scene:
        for number, mesh in enumerate((GROUND, BOX)):
            scene.add(TriangleMesh(mesh.vertices, mesh.faces), instance=number)
        off = scene.closest_points(surface.vertices).distances
    assert np.median(off) < 0.002 and np.quantile(off, 0.95) < VOXEL
    flat = (np.abs(surface.triangles[:, :, 2]).max(axis=1) < 0.005) & (face_areas(surface) > 0.1 * VOXEL**2)
    assert flat.sum() > 1000 and np.quantile(face_normals(surface)[flat, 2], 0.02) > 0.5


def test_every_entity_is_one_mesh_of_its_class(mapped: PanopticMap) -> None:
    entities = {entity.name: entity for entity in mapped.entities()}
    assert set(entities) == {"floor1", "box1"}
    np.testing.assert_allclose(entities["box1"].mesh.extents, (0.5, 0.4, 0.3), atol=2.5 * VOXEL)
    colors = entities["box1"].mesh.face_colors
    assert colors is not None and np.median(colors[:, 0]) > 150


def test_the_map_does_not_depend_on_the_number_of_threads() -> None:
    frame, T, segments = views(1)[0]
    before, volumes = numba.get_num_threads(), []
    for threads in (1, min(2, before)):
        numba.set_num_threads(threads)
        volumes.append(Volume(VolumeConfig(voxel=0.01)))
        volumes[-1].integrate(frame.depth, frame.rgb, segments.image, CAMERA, T)
    numba.set_num_threads(before)
    for name in ("keys", "distances", "weights", "colors", "labels"):
        np.testing.assert_array_equal(getattr(volumes[0], name), getattr(volumes[1], name))


def test_frames_that_cannot_be_used_are_counted_and_change_nothing(mapped: PanopticMap) -> None:
    frame, T, segments = views(1)[0]
    small = PanopticSegments(0, np.zeros((3, 3), np.int32), (), np.zeros(0, np.float32))
    blind = RgbdFrame(0, np.zeros((120, 160), np.float32), None, CAMERA, np.eye(4))
    before = [mapped.volume.count, mapped.frames, mapped.volume.weights.sum(), len(mapped.labels.canonical)]
    for bad, status in (
        ((frame, None, segments), Status.FAILED),
        ((frame, 2.0 * T, segments), Status.FAILED),
        ((frame, T, None), Status.FAILED),
        ((frame, T, small), Status.FAILED),
        ((blind, T, segments), Status.NO_DATA),
    ):
        update = mapped.integrate(*bad)
        assert update.status is status and update.reason in mapped.skipped
    assert [mapped.volume.count, mapped.frames, mapped.volume.weights.sum(), len(mapped.labels.canonical)] == before


def test_a_pose_that_jumps_is_skipped_unless_the_next_one_confirms_it() -> None:
    frame, T, segments = views(1)[0]
    panoptic_map = PanopticMap(PanopticMapConfig.of_method("full", 0.05))
    there = T.copy()
    there[0, 3] += 1.0

    def statuses(*poses: Float64) -> list[bool]:
        stamps = range(panoptic_map.frames, panoptic_map.frames + len(poses))
        frames = [replace(frame, stamp=round(k * NANOSECONDS / 30)) for k in stamps]
        return [panoptic_map.integrate(f, p, segments).status is Status.OK for f, p in zip(frames, poses, strict=True)]

    assert statuses(T, T, there, T) == [True, True, False, True]
    assert statuses(there, there, there) == [False, True, True]
    assert panoptic_map.skipped == {"the pose jumps": 2} and panoptic_map.frames == 5


def test_a_map_that_would_grow_too_large_stays_as_it_was() -> None:
    frame, T, segments = views(1)[0]
    volume = Volume(VolumeConfig(voxel=0.01, max_blocks=50))
    with pytest.raises(InvalidValueError, match="max_blocks"):
        volume.integrate(frame.depth, None, segments.image, CAMERA, T)
    assert volume.count == 0 and not volume.weights.any()


# ------------------------------------------------------------------------------------------------- one frame's fusion


def test_a_mask_inside_a_geometric_segment_is_split_out_of_it() -> None:
    geometric = np.ones((120, 160), np.int32)
    image = np.ones((120, 160), np.int32)
    image[40:60, 40:80] = 2
    depth = np.full((120, 160), 2.0, np.float32)
    panoptic = PanopticSegments(0, image, ("table", "keyboard"), np.ones(2, np.float32))
    split = fuse_segments(geometric, panoptic, depth, CAMERA)
    assert len(split) == 2 and sorted(split.instances[1:].tolist()) == [1, 2]
    assert split.sizes[split.image[50, 50]] == 800 and split.instances[split.image[50, 50]] == 2
    assert split.geometric[split.image[0, 0]] and not split.geometric[split.image[50, 50]]
    whole = fuse_segments(geometric, panoptic, depth, CAMERA, config=FrameFusionConfig(split=False))
    assert len(whole) == 1 and whole.instances[1] == 1


@pytest.mark.parametrize(("gap", "kept"), [(0.02, True), (1.0, False)])
def test_only_the_largest_cluster_stays_with_a_thing(gap: float, kept: bool) -> None:
    geometric = np.ones((120, 160), np.int32)
    geometric[:, 110:] = 2
    depth = np.where(geometric == 2, 1.0 + gap, 1.0).astype(np.float32)
    panoptic = PanopticSegments(0, np.ones((120, 160), np.int32), ("chair",), np.ones(1, np.float32))
    fused = fuse_segments(geometric, panoptic, depth, CAMERA)
    assert fused.instances[fused.image[0, 0]] == 1 and bool(fused.instances[fused.image[0, 150]] == 1) is kept
    stuff = fuse_segments(geometric, panoptic, depth, CAMERA, {"chair"})
    assert stuff.instances[stuff.image[0, 150]] == 1


def test_masks_that_are_known_to_be_good_have_all_their_readings() -> None:
    # The foot of a monitor is in one geometric segment with the table.
    geometric = np.ones((120, 160), np.int32)
    geometric[10:60, 50:110] = 2
    image = np.ones((120, 160), np.int32)
    image[10:60, 50:110] = image[60:70, 70:90] = 2
    panoptic = PanopticSegments(0, image, ("table", "monitor"), np.ones(2, np.float32))
    depth = np.ones((120, 160), np.float32)
    doubted = fuse_segments(geometric, panoptic, depth, CAMERA)
    assert doubted.instances[doubted.image[65, 80]] == 1
    trusted = fuse_segments(geometric, panoptic, depth, CAMERA, trust=True)
    assert (trusted.instances[trusted.image] == image).all() and trusted.sizes.sum() == image.size
    assert trusted.agreement == doubted.agreement == (image.size - 200, image.size)


@pytest.mark.parametrize(
    ("method", "shift", "follows"), [("full", 0, True), ("full", 25, False), ("no-joint-fusion", 0, False)]
)
def test_masks_are_known_to_be_good_where_depth_agrees_with_them(method: Method, shift: int, follows: bool) -> None:
    panoptic_map = PanopticMap(PanopticMapConfig.of_method(method, 0.05))
    for frame, T, segments in views(3):
        off = replace(segments, image=np.roll(segments.image, shift, axis=1))
        panoptic_map.integrate(frame, T, off)
    own, whole = panoptic_map.agreement
    fusion = panoptic_map.config.fusion
    assert (fusion.trust and own >= fusion.trusted * whole > 0) is follows


# ------------------------------------------------------------------------------------------------- labels and counts


def test_a_label_has_one_segment_a_frame_and_the_larger_overlap_has_it() -> None:
    labels = SegmentLabels()
    none = np.zeros((3, 1), np.int32)
    assert labels.associate(np.empty(0, np.int32), none, 10).tolist() == [0, 1, 2]
    counts = np.array([[0, 0], [500, 300], [500, 400]], np.int32)
    assert labels.associate(np.array([1], np.int32), counts, 10).tolist() == [0, 3, 1]


def test_labels_that_keep_sharing_segments_are_merged_after_enough_frames() -> None:
    labels = SegmentLabels()
    labels.associate(np.empty(0, np.int32), np.zeros((3, 1), np.int32), 10)
    counts = np.array([[0, 0, 0], [500, 250, 250]], np.int32)
    ready = [labels.count_overlaps(np.array([1, 2], np.int32), counts, 10) for _ in range(4)]
    assert ready == [[], [], [], [(1, 2)]]
    labels.merge(2, into=1)
    assert labels.canonical.tolist() == [0, 1, 1]


def test_classes_and_instances_are_counted_together() -> None:
    counts = JointCounts()
    for _ in range(5):
        counts.observe([Observation("chair", (1, 2)), Observation("chair", (3,))])
    counts.observe([Observation("table", (1,)), Observation("", (4,))])
    entities = counts.entities()
    assert entities[1].semantic_class == "chair" and entities[1].instance == entities[2].instance
    assert entities[1].instance != entities[3].instance and 4 not in entities
    assert (entities[1].agreeing, entities[1].observed) == (5, 6)
    assert sum(sum(c.values()) for c in counts.phi.values()) == 5 * 3 + 2  # Eq. 4: one count a segment and frame


def test_no_two_things_of_a_frame_are_the_same_instance() -> None:
    counts = JointCounts()
    counts.observe([Observation("chair", (1, 2))])  # two chairs taken for one
    for _ in range(3):
        counts.observe([Observation("chair", (1,)), Observation("chair", (2,))])
    assert counts.entities()[1].instance != counts.entities()[2].instance


def test_stuff_is_one_instance_where_counts_are_joint_and_not_where_they_are_separate() -> None:
    joint, separate = JointCounts(), SeparateCounts()
    for counts in (joint, separate):
        counts.observe([Observation("wall", (1,))])
        counts.observe([Observation("wall", (2,))])
    assert joint.entities()[1].instance == joint.entities()[2].instance
    assert separate.entities()[1].instance != separate.entities()[2].instance


def test_instances_that_share_their_segments_are_merged() -> None:
    counts = JointCounts(CountsConfig(merge_count=4))
    counts.phi = {1: {("chair", 1): 5, ("chair", 2): 4}, 2: {("chair", 1): 1}, 3: {("chair", 7): 9}}
    counts.regularize()
    assert counts.phi[1] == {("chair", 1): 9} and counts.phi[3] == {("chair", 7): 9}


def test_instances_that_things_were_both_of_are_merged_unless_they_were_things_of_their_own() -> None:
    plants, chairs = JointCounts(), JointCounts()
    for counts, name in ((plants, "plant"), (chairs, "chair")):
        counts.observe([Observation(name, (1,))])
        counts.observe([Observation(name, (2,))])
    for _ in range(3):
        plants.observe([Observation("plant", (1, 2))])
        chairs.observe([Observation("chair", (1, 2))])
        for _ in range(2):
            chairs.observe([Observation("chair", (1,)), Observation("chair", (2,))])
    restored = JointCounts()
    restored.restore(json.loads(json.dumps(plants.state())))
    for counts in (plants, restored, chairs):
        counts.regularize()
    for counts in (plants, restored):
        assert counts.entities()[1].instance == counts.entities()[2].instance
    assert chairs.entities()[1].instance != chairs.entities()[2].instance


def test_segments_of_one_entity_and_what_was_merged_support_each_other_in_a_voxel() -> None:
    counts = JointCounts()
    counts.observe([Observation("chair", (1, 2)), Observation("table", (3,))])
    same = counts.same(np.array([0, 1, 2, 3, 4, 3], np.int32))
    assert same[1] == same[2] and same[3] == same[5] and len(set(same.tolist())) == 4
    frame, T, _ = views(1)[0]
    label = np.ones((120, 160), np.int32)
    for alike, support in ((same, 2), (None, 0)):
        volume = Volume(VolumeConfig(voxel=VOXEL))
        volume.integrate(frame.depth, None, label, CAMERA, T, same)
        volume.integrate(frame.depth, None, 2 * label, CAMERA, T, alike)
        held = volume.support[: volume.count][volume.labels[: volume.count] == 1]
        assert len(held) > 1000 and (held == support).all()


def test_what_no_mask_covers_speaks_against_no_label_and_what_is_split_out_counts_more() -> None:
    frame, T, _ = views(1)[0]
    ones = np.ones((120, 160), np.int32)

    def fused(*images: np.ndarray, votes: np.ndarray | None = None) -> tuple[set[int], set[int]]:
        volume = Volume(VolumeConfig(voxel=VOXEL))
        for image in images:
            same = np.arange(4, dtype=np.int32)
            volume.integrate(frame.depth, None, image, CAMERA, T, same, votes=votes)
        labels, support = volume.labels[: volume.count], volume.support[: volume.count]
        return set(labels[labels > 0].tolist()), set(support[labels > 0].tolist())

    assert fused(ones, -2 * ones, -2 * ones) == ({1}, {1})
    assert fused(-2 * ones, ones) == ({1}, {1})
    assert fused(-2 * ones) == ({2}, {0})
    votes = np.array([1, 1, 3, 1], np.int16)
    assert fused(ones, ones, 2 * ones, 2 * ones, votes=votes) == ({2}, {3})
    assert fused(ones, ones, 2 * ones, 2 * ones) == ({1}, {0})


def test_readings_beside_the_mask_of_their_segment_are_not_its_own() -> None:
    frame, T, segments = views(1)[0]
    image = segments.image.copy()
    image[60:] = 0  # the lower half of the image was not found
    half = replace(segments, image=image)
    for masked in (True, False):
        config = PanopticMapConfig.of_method("full", VOXEL)
        panoptic_map = PanopticMap(replace(config, fusion=replace(config.fusion, masked=masked, fill=False)))
        assert panoptic_map.integrate(frame, T, half, segments.image).status is Status.OK
        support = panoptic_map.volume.support[panoptic_map.volume.labels > 0]
        assert (support == 1).any() and (support == 0).any() == masked


def test_floor_and_walls_are_told_from_geometry_where_masks_disagree() -> None:
    room = [box_mesh((4.0, 3.0, 0.1)), box_mesh((0.1, 3.0, 2.5)), box_mesh((1.2, 0.5, 0.9)), box_mesh((1.2, 0.02, 0.8))]
    places = np.array([[0.0, 0.0, -0.05], [-2.05, 0.0, 1.25], [0.9, 1.0, 0.45], [0.0, -0.9, 1.6]])
    meshes = [Mesh(m.vertices + at, m.faces) for m, at in zip(room, places, strict=True)]
    faces, vertices, labels, at = [], [], [], 0
    for label, mesh in enumerate(meshes, start=1):
        vertices.append(mesh.vertices)
        faces.append(mesh.faces + at)
        labels.append(np.full(len(mesh.faces), label, np.int32))
        at += len(mesh.vertices)
    surface = Mesh(np.concatenate(vertices), np.concatenate(faces).astype(np.int32))
    normals, of_face = face_normals(surface), np.concatenate(labels)
    # Of floor and wall only what faces the room is seen.
    seen = (of_face > 2) | (of_face == 1) & (normals[:, 2] > 0.5) | (of_face == 2) & (normals[:, 0] > 0.5)
    shown = Mesh(surface.vertices, surface.faces[seen])
    found = shell_labels(shown, of_face[seen])
    assert {label: part.kind for label, part in found.items()} == {1: "floor", 2: "wall", 3: "", 4: ""}

    names = np.array(["", "floor", "wall", "cabinet", "board"], dtype=object)[of_face[seen]]
    lying = Mesh(surface.vertices[:, [2, 0, 1]], surface.faces[seen])  # as a camera sees it whose poses nobody stated
    assert is_upright(shown, names) and not is_upright(lying, names)
    names[names == "floor"] = ""
    assert is_upright(shown, names) and not is_upright(shown, np.full(len(names), "", dtype=object))

    counts = JointCounts()
    for name, times in (("table", 5), ("floor", 3), ("wall", 2)):
        for _ in range(times):
            counts.observe([Observation(name, (1,))])
    for name, times in (("board", 7), ("wall", 1)):  # larger than any board: once is enough
        for _ in range(times):
            counts.observe([Observation(name, (2,))])
    for name, times in (("wall", 5), ("cabinet", 3)):
        for _ in range(times):
            counts.observe([Observation(name, (3,))])
    alone, told = counts.entities(), counts.entities(found)
    assert (alone[1].semantic_class, alone[3].semantic_class) == ("table", "wall")
    assert (told[1].semantic_class, told[3].semantic_class) == ("floor", "cabinet")
    assert (told[1].agreeing, told[1].observed) == (3, 10)
    assert (alone[2].semantic_class, told[2].semantic_class) == ("board", "wall")
    assert counts.entities({9: found[2]}) == alone
    assert shell_labels(Mesh(np.empty((0, 3)), np.empty((0, 3), np.int32)), np.empty(0, np.int32)) == {}


def test_scores_rise_with_what_agrees_and_with_how_much_there_is() -> None:
    scores = [_lower_bound(3, 3), _lower_bound(12, 12), _lower_bound(48, 48)]
    assert scores == sorted(scores) and scores[2] > 0.9 and _lower_bound(0, 7) == pytest.approx(0.0, abs=1e-12)
    # The bound solves (share - bound)^2 = z^2 bound (1 - bound) / n.
    bound = _lower_bound(9, 12)
    assert (0.75 - bound) ** 2 == pytest.approx(1.96**2 * bound * (1.0 - bound) / 12) and bound < 0.75


def test_the_doubt_that_things_are_held_in_follows_from_how_often_observations_disagree() -> None:
    def least(agreeing: int) -> int:
        return _least_observed({1: SegmentEntity("cup", 1, agreeing, 100)}, EntityConfig())

    assert [least(100), least(97), least(85), least(50)] == [1, 1, 2, 3]


# ---------------------------------------------------------------------------------------------------------------- files


def test_entities_survive_their_files(tmp_path: Path) -> None:
    write_entities(
        [MapEntityMesh("box1", "box", 4, 0.75, BOX), MapEntityMesh("floor1", "floor", 1, 1.0, GROUND)], tmp_path
    )
    box, floor = read_entities(tmp_path)
    assert (box.name, box.semantic_class, box.instance, box.score) == ("box1", "box", 4, 0.75)
    np.testing.assert_allclose(box.mesh.bounds, BOX.bounds, atol=1e-6)
    assert floor.semantic_class == "floor" and b"comment class floor" in (tmp_path / "entities/floor1.ply").read_bytes()


@pytest.mark.parametrize(
    "text", ["{", "{}", '[{"name": "x"}]', '[{"name":"a","class":"b","instance":1,"score":1,"file":"../x.ply"}]']
)
def test_broken_listings_are_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "entities.json").write_text(text)
    with pytest.raises(FileFormatError):
        read_entities(tmp_path)


def test_walls_are_told_apart() -> None:
    walls = [box_mesh((2.0, 0.01, 2.0)), box_mesh((0.01, 2.0, 2.0))]
    parts = [Mesh(w.vertices + s, w.faces) for w, s in zip(walls, ([1.0, 0.0, 1.0], [0.0, 1.0, 1.0]), strict=True)]
    both = Mesh(
        np.concatenate([p.vertices for p in parts]),
        np.concatenate([parts[0].faces, parts[1].faces + 8]).astype(np.int32),
    )
    split = split_layout([MapEntityMesh("wall1", "wall", 1, 1.0, both)], np.random.default_rng(0))
    sides = {int(np.argmin(entity.mesh.extents[:2])) for entity in split}
    assert sides == {0, 1} and all(min(entity.mesh.extents[:2]) < 0.05 for entity in split)


def joined(*boxes: tuple[tuple[float, float, float], tuple[float, float, float]]) -> Mesh:
    """Boxes of these sizes about these middles as one mesh."""
    meshes = [box_mesh(size) for size, _ in boxes]
    vertices = np.concatenate([m.vertices + np.array(at) for m, (_, at) in zip(meshes, boxes, strict=True)])
    faces = np.concatenate([m.faces + 8 * k for k, m in enumerate(meshes)])
    return Mesh(vertices, faces.astype(np.int32))


@pytest.mark.parametrize(("depth", "walls"), [(0.1, 1), (0.6, 2)])
def test_a_pane_is_part_of_the_wall_that_it_is_sunk_in(depth: float, walls: int) -> None:
    mesh = joined(((3.0, 0.01, 2.0), (0.0, 0.0, 1.0)), ((1.2, 0.01, 1.0), (0.0, depth, 1.5)))
    split = split_layout([MapEntityMesh("wall1", "wall", 1, 1.0, mesh)], np.random.default_rng(0))
    # Of a box both sides are walls, which face away from each other.
    assert len(split) == 2 * walls
    assert np.sum([entity.mesh.extents[1] > 0.5 * depth for entity in split]) == (2 if walls == 1 else 0)


def test_what_leaked_into_the_floor_is_left_out() -> None:
    mesh = joined(((3.0, 3.0, 0.01), (0.0, 0.0, 0.0)), ((0.05, 0.05, 0.4), (1.0, 1.0, 0.8)))
    (floor,) = split_layout([MapEntityMesh("floor1", "floor", 1, 1.0, mesh)], np.random.default_rng(0))
    assert floor.name == "floor1" and floor.mesh.extents[2] < 0.05
    np.testing.assert_allclose(floor.mesh.extents[:2], [3.0, 3.0], atol=1e-6)
    leaked = joined(((0.05, 0.05, 0.4), (1.0, 1.0, 0.8)))  # no floor in it: as it was
    assert split_layout([MapEntityMesh("floor1", "floor", 1, 1.0, leaked)], np.random.default_rng(0))[0].mesh is leaked


# ----------------------------------------------------------------------------------------------- saved and swapped out


def along(count: int) -> list[tuple[RgbdFrame, Float64, PanopticSegments]]:
    """Three boxes in a row on the ground, seen on the way past them and back."""
    seen, bundle = [], RayBundle.from_camera(CAMERA)
    ground = box_mesh((9.0, 2.0, 0.2))
    with RayScene() as scene:
        scene.add(TriangleMesh(ground.vertices - [0.0, 0.0, 0.1], ground.faces), instance=0)
        for number in range(3):
            scene.add(TriangleMesh(BOX.vertices + [3.0 * number - 3.0, 0.0, 0.0], BOX.faces), instance=number + 1)
        for k in range(count):
            x = 3.5 * np.cos(2.0 * np.pi * k / count)
            T = look_at(np.array([x, -1.0, 0.8]), np.array([x, 0.0, 0.1]))
            hits = scene.cast(bundle, T, 2.0)
            depth = np.where(hits.hit, hits.distances, 0.0).astype(np.float32).reshape(120, 160)
            image = np.where(hits.hit, hits.instances + 1, 0).astype(np.int32).reshape(120, 160)
            present = np.unique(image[image > 0])
            numbers = np.zeros(5, np.int32)
            numbers[present] = np.arange(1, len(present) + 1)
            classes = tuple("floor" if p == 1 else "box" for p in present.tolist())
            segments = PanopticSegments(k, numbers[image], classes, np.ones(len(classes), np.float32))
            seen.append((RgbdFrame(k * NANOSECONDS, depth, None, CAMERA, np.eye(4), k), T, segments))
    return seen


def same_entities(first: PanopticMap, second: PanopticMap) -> bool:
    a, b = first.entities(), second.entities()
    assert [e.name for e in a] == [e.name for e in b] and len(a) > 1
    return all(
        np.array_equal(x.mesh.vertices, y.mesh.vertices) and np.array_equal(x.mesh.faces, y.mesh.faces)
        for x, y in zip(a, b, strict=True)
    )


def test_what_is_far_is_written_away_and_the_map_is_the_same() -> None:
    config = replace(PanopticMapConfig.of_method("full", 0.03), max_depth=1.2)
    swapping = PanopticMap(replace(config, swap=SwapConfig(2.4, region=4, every=2)))
    kept, most, frames = PanopticMap(config), 0, along(40)
    with swapping:
        for frame, T, segments in frames:
            assert swapping.integrate(frame, T, segments).status is Status.OK
            kept.integrate(frame, T, segments)
            most = max(most, swapping.volume.count)
        assert swapping.regions is not None and swapping.regions.written > 10
        assert most < 0.85 * kept.volume.count
        assert same_entities(kept, swapping)
        for name in STORED:
            np.testing.assert_array_equal(kept.volume.blocks()[name], swapping.volume.blocks()[name])


def test_regions_within_reach_are_not_to_be_written_away() -> None:
    with pytest.raises(InvalidValueError, match="reach"):
        PanopticMap(PanopticMapConfig(swap=SwapConfig(1.0)))


@pytest.mark.parametrize("method", ["full", "no-joint-fusion"])
def test_a_map_that_was_saved_is_carried_on_as_if_it_had_not_been(method: Method, tmp_path: Path) -> None:
    frames = along(12)
    whole, half = (PanopticMap(PanopticMapConfig.of_method(method, 0.05)) for _ in range(2))
    for k, (frame, T, segments) in enumerate(frames):
        whole.integrate(frame, T, segments)
        if k == 6:
            write_map(half, tmp_path / "map.npz")
            half = read_map(tmp_path / "map.npz")
        half.integrate(frame, T, segments)
    assert half.config == whole.config and half.frames == whole.frames == 12
    assert same_entities(whole, half)


def test_damaged_maps_are_refused(mapped: PanopticMap, tmp_path: Path) -> None:
    path = tmp_path / "map.npz"
    write_map(mapped, path)
    data = path.read_bytes()
    with np.load(path) as stored:
        arrays = dict(stored)
    for broken in (b"", b"nonsense", data[: len(data) // 2]):
        path.write_bytes(broken)
        with pytest.raises(FileFormatError):
            read_map(path)
    for name, values in (("labels", arrays["labels"] + 10**6), ("weights", arrays["weights"][:1]),
                         ("document", np.array("{}")), ("keys", arrays["keys"] * 0)):  # fmt: skip
        np.savez(path, **{**arrays, name: values})
        with pytest.raises(FileFormatError):
            read_map(path)


# ------------------------------------------------------------------------ what full evidence asks for in a single frame


def flat_scene() -> tuple[np.ndarray, np.ndarray]:
    """Depth of a wall at 2 m with a bottle 0.3 m before it, and their geometric segments."""
    depth = np.full((120, 160), 2.0, np.float32)
    geometric = np.ones((120, 160), np.int32)
    depth[40:80, 70:85], geometric[40:80, 70:85] = 1.7, 2
    return depth, geometric


@pytest.mark.parametrize("flat", [True, False])
def test_what_stands_before_a_wall_and_was_not_found_is_not_wall(flat: bool) -> None:
    depth, geometric = flat_scene()
    wall = PanopticSegments(0, np.ones((120, 160), np.int32), ("wall",), np.ones(1, np.float32))
    fused = fuse_segments(geometric, wall, depth, CAMERA, {"wall"}, FrameFusionConfig(flat=flat))
    assert fused.instances[fused.image[0, 0]] == 1
    assert fused.instances[fused.image[60, 77]] == (SILENT if flat else 1)


def test_readings_of_a_mask_beside_its_segment_are_filled_and_others_are_not() -> None:
    depth, geometric = flat_scene()
    geometric[38:82, 68:87] = 0  # edges that no segment has, the bottle's and the wall's
    geometric[42:78, 72:83] = 2
    image = np.ones((120, 160), np.int32)
    image[40:80, 70:85] = 2
    panoptic = PanopticSegments(0, image, ("wall", "bottle"), np.ones(2, np.float32))
    filled = fuse_segments(geometric, panoptic, depth, CAMERA, {"wall"})
    np.testing.assert_array_equal(filled.instances[filled.image] == 2, image == 2)
    kept = fuse_segments(geometric, panoptic, depth, CAMERA, {"wall"}, FrameFusionConfig(fill=False))
    np.testing.assert_array_equal(kept.image > 0, geometric > 0)


def test_thin_things_that_no_geometric_segment_has_are_segments() -> None:
    depth, geometric = flat_scene()
    geometric[geometric == 2] = 0
    image = np.where(depth < 1.9, 2, 1).astype(np.int32)
    panoptic = PanopticSegments(0, image, ("wall", "lamp"), np.ones(2, np.float32))
    fused = fuse_segments(geometric, panoptic, depth, CAMERA, {"wall"})
    number = int(fused.image[60, 77])
    assert fused.instances[number] == 2 and fused.sizes[number] == (image == 2).sum()


def test_entities_that_few_frames_speak_for_are_dropped() -> None:
    frame, T, segments = views(1)[0]
    panoptic_map = PanopticMap(PanopticMapConfig.of_method("full", 0.03))
    for number in range(1, 5):
        shown = replace(frame, stamp=number * NANOSECONDS)
        assert panoptic_map.integrate(shown, T, segments).status is Status.OK
        assert len(panoptic_map.entities()) == (2 if number >= 3 else 1), number  # the floor is stuff


@pytest.mark.parametrize("method", ["no-joint-fusion", "voxbloxpp"])
def test_baselines_take_what_their_counts_say_for_entities(method: Method) -> None:
    frame, T, segments = views(1)[0]
    panoptic_map = PanopticMap(PanopticMapConfig.of_method(method, 0.03))
    assert panoptic_map.integrate(frame, T, segments).status is Status.OK
    assert [e.semantic_class for e in panoptic_map.entities()] == ["floor", "box"]


def test_segments_that_masks_made_do_not_say_that_labels_are_one() -> None:
    frame, T, _ = views(1)[0]
    halves = np.where(np.arange(160) < 80, 1, 2).astype(np.int32) * np.ones((120, 1), np.int32)
    whole = PanopticSegments(0, np.ones((120, 160), np.int32), ("floor",), np.ones(1, np.float32))
    for across, labels in ((np.zeros_like(halves), 2), (np.ones_like(halves), 1)):
        panoptic_map = PanopticMap(PanopticMapConfig.of_method("no-joint-fusion", 0.03))
        for geometric in (*[halves] * 8, *[across] * 6):
            assert panoptic_map.integrate(frame, T, whole, geometric).status is Status.OK
        assert len(np.unique(panoptic_map.labels.canonical[1:3])) == labels


def test_what_is_cut_off_from_a_thing_says_nothing_or_background() -> None:
    geometric = np.ones((120, 160), np.int32)
    geometric[:, 110:] = 2
    depth = np.where(geometric == 2, 2.0, 1.0).astype(np.float32)
    panoptic = PanopticSegments(0, np.ones((120, 160), np.int32), ("chair",), np.ones(1, np.float32))
    for silent, expected in ((True, SILENT), (False, 0)):
        fused = fuse_segments(geometric, panoptic, depth, CAMERA, config=FrameFusionConfig(silent=silent))
        assert fused.instances[fused.image[0, 150]] == expected


def test_the_ablation_splits_masks_out_of_what_contains_them_and_leaves_the_rest_to_the_background() -> None:
    depth, geometric = flat_scene()
    config = PanopticMapConfig.of_method("no-joint-fusion").fusion
    for left, splits in ((10, True), (60, False)):  # the mask lies in the wall, and with 25 of 40 columns on it
        image = np.zeros((120, 160), np.int32)
        image[45:75, left : left + 40] = 1
        picture = PanopticSegments(0, image, ("picture",), np.ones(1, np.float32))
        fused = fuse_segments(geometric, picture, depth, CAMERA, {"wall"}, config)
        assert (fused.instances[fused.image[60, left + 5]] == 1) == splits
        assert fused.instances[fused.image[5, 5]] == 0
        assert SILENT not in fused.instances
