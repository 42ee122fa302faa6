"""Labels of a view obey laws, and agree with rays cast at each thing alone on a wide canvas."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from simtrack.contracts import CameraIntrinsics, Float64
from simtrack.datasets.annotate import NEAR, Annotator, Owners, View
from simtrack.datasets.content import Placed
from simtrack.datasets.frame import InstanceLabel
from simtrack.errors import InvalidValueError
from simtrack.geometry.meshes import box_mesh
from simtrack.geometry.transforms import exp_so3, inverse, transform
from simtrack.raycast import RayBundle, RayScene, TriangleMesh
from simtrack.sensors.camera import pixel_rays, project
from tests.datasets.tabletop import BOX, BRACKET, CAMERA, CAN, look_at, owners, placed, ray_scene, standing, tabletop

VIEW = look_at((0.5, -0.6, 0.5), (0.0, 0.0, 0.05))
SHAPE = (CAMERA.height, CAMERA.width)


def labelled(things: tuple[Placed, ...], T_map_camera: Float64 = VIEW) -> tuple[View, tuple[InstanceLabel, ...]]:
    """The view and its labels, with a depth image in which a column is lost."""
    annotator = Annotator(CAMERA)
    with ray_scene(things) as rays:
        view = annotator.look(rays, owners(things), T_map_camera)
        depth = view.depth.copy()
        depth[:, 70] = 0.0
        return view, annotator.annotate(things, rays, T_map_camera, view.ids, depth)


def alone(thing: Placed, T_map_camera: Float64) -> np.ndarray:
    """(3H, 3W), what rays of a camera with nine times the image meet of a thing alone."""
    wide = CameraIntrinsics(
        3 * CAMERA.width, 3 * CAMERA.height, CAMERA.fx, CAMERA.fy, CAMERA.cx + CAMERA.width, CAMERA.cy + CAMERA.height
    )
    with RayScene() as scene:
        scene.add(thing.mesh, thing.T_map_mesh)
        return scene.cast(RayBundle.from_camera(wide), T_map_camera, min_distance=NEAR).hit.reshape(3 * SHAPE[0], -1)


def tight_box(mask: np.ndarray) -> tuple[int, ...] | None:
    rows, columns = np.nonzero(mask)
    return (columns.min(), rows.min(), columns.max(), rows.max()) if len(rows) else None


poses = st.builds(
    lambda turn, at: transform(exp_so3(np.array(turn)), np.array(at)),
    st.tuples(*[st.floats(-3.0, 3.0)] * 3),
    st.tuples(st.floats(-0.9, 0.9), st.floats(-0.9, 0.9), st.floats(0.0, 0.9)),
)


@settings(max_examples=20)
@given(st.lists(poses, min_size=3, max_size=3))
def test_labels_obey_their_laws_wherever_things_are(at: list[Float64]) -> None:
    things = (placed(1, BRACKET, at[0]), placed(2, CAN, at[1], 2), placed(3, BOX, at[2], None, 1.5))
    view, labels = labelled(things)
    assert [label.instance for label in labels] == [1, 2, 3]
    seen = sum(label.pixels_visible for label in labels)
    assert seen + np.count_nonzero(view.ids <= 0) == view.ids.size
    for thing, label in zip(things, labels, strict=True):
        visible = view.ids == label.instance
        assert not (visible & ~label.amodal).any()
        assert label.pixels_visible == visible.sum()
        assert label.box_visible == tight_box(visible)
        valid = label.amodal & (view.depth > 0)
        valid[:, 70] = False
        assert label.pixels_valid == valid.sum() <= label.amodal.sum() <= label.pixels_all
        assert 0.0 <= label.visible_fraction <= 1.0
        truth = alone(thing, VIEW)
        inner = truth[SHAPE[0] : 2 * SHAPE[0], SHAPE[1] : 2 * SHAPE[1]]
        assert np.count_nonzero(inner != label.amodal) <= 1  # a pixel centre on an edge, to rounding
        assert abs(label.pixels_all - truth.sum()) <= 1 + 1e-4 * truth.sum()
        box = tight_box(truth)
        if box is not None and label.box_amodal is not None:
            offset = np.array([SHAPE[1], SHAPE[0]] * 2)
            assert np.abs(np.array(label.box_amodal) - (np.array(box) - offset)).max() <= 1
        assert np.allclose(label.T_camera_object, inverse(VIEW) @ thing.T_map_object)


def test_what_lies_half_outside_the_image_counts_as_a_wide_camera_sees_it() -> None:
    thing = placed(1, CAN, standing(CAN, 0.0, 0.0))
    camera = look_at((0.5, -0.6, 0.5), (0.0, 0.0, 0.05)) @ transform(exp_so3(np.array([0.0, 0.49, 0.0])))
    view, (label,) = labelled((thing,), camera)
    truth = alone(thing, camera)
    assert label.pixels_all == truth.sum()
    assert 0.2 * label.pixels_all < label.pixels_visible < 0.8 * label.pixels_all
    assert label.visible_fraction == pytest.approx(label.pixels_visible / truth.sum())
    assert label.box_amodal is not None and label.box_visible is not None
    assert label.box_amodal[0] < 0 == label.box_visible[0]
    assert label.box_amodal == tuple(np.array(tight_box(truth)) - np.array([SHAPE[1], SHAPE[0]] * 2))
    assert np.array_equal(label.amodal, view.ids == 1)


def test_the_canvas_ends_where_it_ends() -> None:
    """A thing that reaches beyond three images by three, and behind the camera, counts to the canvas' border."""
    wall = box_mesh((8.0, 0.1, 8.0))
    thing = placed(1, wall, transform(exp_so3(np.array([0.0, 0.0, 0.3])), (0.0, 0.8, 0.0)))
    camera = look_at((0.0, 0.0, 1.0), (0.3, 1.0, 0.9))
    _, (label,) = labelled((thing,), camera)
    truth = alone(thing, camera)
    assert 0.6 * truth.size < truth.sum() < truth.size
    assert abs(label.pixels_all - truth.sum()) <= 1e-4 * truth.sum()
    assert label.box_amodal is not None
    assert label.box_amodal[:2] == (-SHAPE[1], -SHAPE[0]) and label.box_amodal[3] == 2 * SHAPE[0] - 1


def test_what_the_near_plane_cuts_is_covered_as_rays_see_it() -> None:
    thing = placed(1, BRACKET, transform(exp_so3(np.array([0.3, 0.2, 0.1])), (0.0, 0.0, 0.3)))
    camera = look_at((0.14, -0.04, 0.29), (0.0, 0.0, 0.3))
    _, (label,) = labelled((thing,), camera)
    truth = alone(thing, camera)
    assert truth.sum() > SHAPE[0] * SHAPE[1]
    assert abs(label.pixels_all - truth.sum()) <= 1e-4 * truth.sum()


def test_nothing_is_labelled_of_what_stands_behind_the_camera() -> None:
    view, (label,) = labelled((placed(1, BOX, standing(BOX, 3.0, -3.5)),))
    assert label.pixels_all == label.pixels_valid == label.pixels_visible == 0
    assert label.box_amodal is None and label.box_visible is None and label.visible_fraction == 0.0
    assert not label.amodal.any() and not label.keypoint_visibility.any() and (label.keypoints == -1.0).all()
    assert not (view.ids == 1).any()


def test_the_order_of_things_does_not_matter() -> None:
    things = tabletop()
    _, forth = labelled(things)
    _, back = labelled(things[::-1])
    for a, b in zip(forth, back, strict=True):
        for name in ("instance", "name", "pixels_all", "pixels_valid", "pixels_visible", "box_amodal", "box_visible"):
            assert getattr(a, name) == getattr(b, name)
        for name in ("amodal", "keypoints", "keypoint_visibility", "T_camera_object"):
            assert np.array_equal(getattr(a, name), getattr(b, name))


def test_depth_and_normals_are_those_of_the_surfaces() -> None:
    view, _ = labelled(tabletop())
    T_camera_map = inverse(VIEW)
    up = T_camera_map[:3, 2]
    rays = pixel_rays(CAMERA).astype(float)
    floor = view.ids == 0
    assert np.abs(view.normals[floor] - up).max() < 1e-5
    expected = (T_camera_map[:3, 3] @ up) / (rays @ up)
    assert np.abs(view.depth - expected)[floor].max() < 1e-5
    assert np.allclose(np.linalg.norm(view.normals, axis=2)[view.ids >= 0], 1.0, atol=1e-5)
    assert (np.einsum("ijk,ijk->ij", view.normals, rays)[view.ids >= 0] < 1e-6).all()


def test_depth_ends_at_its_range_and_ids_do_not() -> None:
    things = tabletop()
    with ray_scene(things) as rays:
        near = Annotator(CAMERA, far=0.8).look(rays, owners(things), VIEW)
        whole = Annotator(CAMERA).look(rays, owners(things), VIEW)
    assert np.array_equal(near.ids, whole.ids)
    assert np.array_equal(near.depth, np.where(whole.depth <= 0.8, whole.depth, 0.0))
    assert (near.depth == 0).any() and (near.depth > 0).any()


def test_sky_is_nothing() -> None:
    things = tabletop()
    with ray_scene(things) as rays:
        view = Annotator(CAMERA).look(rays, owners(things), look_at((0.5, -0.6, 0.5), (0.0, 0.0, 2.0)))
    sky = view.ids == -1
    assert sky.all() and not view.depth.any() and not view.normals.any()


# ------------------------------------------------------------------------------------------------------------ keypoints


def test_keypoints_are_where_they_project_and_as_visible_as_the_ids_say() -> None:
    things = tabletop()
    view, labels = labelled(things)
    near = cv2.erode(view.depth, np.ones((3, 3), np.uint8))  # the nearest surface next to each pixel, edges included
    far = cv2.dilate(view.depth, np.ones((3, 3), np.uint8))
    told = np.zeros(3, int)
    for thing, label in zip(things[:2], labels[:2], strict=True):
        in_map = thing.keypoints @ thing.T_map_object[:3, :3].T + thing.T_map_object[:3, 3]
        in_camera = (in_map - VIEW[:3, 3]) @ VIEW[:3, :3]
        assert np.allclose(label.keypoints, project(in_camera, CAMERA))
        for (u, v), z, visibility in zip(label.keypoints, in_camera[:, 2], label.keypoint_visibility, strict=True):
            inside = -0.5 <= u < CAMERA.width - 0.5 and -0.5 <= v < CAMERA.height - 0.5
            assert (visibility > 0) == inside
            if not inside:
                continue
            column, row = round(u), round(v)
            around = view.ids[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2]
            if (near[row, column] > z + 0.01) or (around == label.instance).all():
                assert visibility == 2  # free, or hidden by the object alone
                told[2] += 1
            elif (around != label.instance).all() and (around > 0).all() and far[row, column] < z - 0.03:
                assert visibility == 1
                told[1] += 1
    assert told[2] >= 6


def keypoint_visibility(things: tuple[Placed, ...], T_map_camera: Float64) -> np.ndarray:
    return labelled(things, T_map_camera)[1][0].keypoint_visibility


def test_a_thing_does_not_hide_its_own_keypoints_and_corners_on_a_table_are_seen() -> None:
    box = placed(1, BOX, standing(BOX, 0.0, 0.0))
    assert (keypoint_visibility((box,), VIEW) == 2).all()  # the far corners and the centre too
    sunk = placed(1, BOX, standing(BOX, 0.0, 0.0) @ transform(None, (0.0, 0.0, -0.001)))
    low = look_at((1.5, -0.4, 0.1), (0.0, 0.0, 0.03))
    assert (keypoint_visibility((sunk,), low) == 2).all()  # resting bodies sink in by a millimetre


def test_a_wall_hides_what_is_behind_it_even_within_the_thing() -> None:
    box = placed(1, BOX, transform(None, (0.0, 0.0, 0.5)))
    camera = look_at((0.0, -1.0, 0.5), (0.0, 0.0, 0.5))
    behind_all = placed(2, box_mesh((1.0, 0.01, 1.0)), transform(None, (0.0, -0.3, 0.5)), None)
    assert (keypoint_visibility((box, behind_all), camera) == 1).all()
    through = placed(2, box_mesh((0.198, 0.002, 0.078)), transform(None, (0.0, 0.0, 0.5)), None)
    seen = keypoint_visibility((box, through), camera)
    # A sheet inside of it, seen through the front alone, hides the corners at the back; the centre lies within it.
    depth = box.keypoints[:, 1]
    assert (seen[depth < -0.05] == 2).all() and (seen[:8][depth[:8] > 0.05] == 1).all()


def test_keypoints_outside_the_image_keep_their_pixels() -> None:
    box = placed(1, BOX, standing(BOX, 0.0, 0.0))
    camera = VIEW @ transform(exp_so3(np.array([0.0, 0.6, 0.0])))
    label = labelled((box,), camera)[1][0]
    assert (label.keypoint_visibility == 0).any() and (label.keypoints[label.keypoint_visibility == 0] < 0).any()
    assert label.keypoints.min() < -5.0


# --------------------------------------------------------------------------------------------------------------- owners


def test_one_mesh_may_hold_several_things() -> None:
    floor = box_mesh((1.0, 1.0, 0.1))
    by_face = np.arange(12, dtype=np.int32) + 5
    table = Owners({3: 2}, {1: by_face})
    with RayScene() as rays:
        rays.add(TriangleMesh(floor.vertices, floor.faces), instance=1)
        rays.add(TriangleMesh(BOX.vertices, BOX.faces), transform(None, (0.0, 0.0, 0.2)), instance=3)
        origins = np.array([[0.0, 0.0, 1.0], [0.4, 0.3, 1.0], [3.0, 0.0, 1.0], [0.3, 0.4, -1.0]])
        directions = np.array([[0.0, 0.0, -1.0]] * 3 + [[0.0, 0.0, 1.0]])
        hits = rays.cast_rays(origins, directions)
        view = Annotator(CAMERA).look(rays, table, look_at((0.0, -0.01, 2.0), (0.0, 0.0, 0.0)))
    expected = np.array([2, by_face[hits.faces[1]], -1, by_face[hits.faces[3]]])
    assert np.array_equal(table.of(hits), expected)
    assert set(np.unique(view.ids)) <= {-1, 2, *by_face.tolist()}
    assert np.array_equal(view.ids.ravel(), table.of(view.hits))


def test_images_of_another_size_are_refused() -> None:
    with ray_scene(()) as rays, pytest.raises(InvalidValueError, match=r"depth.*\(120, 160\)"):
        Annotator(CAMERA).annotate((), rays, VIEW, np.zeros(SHAPE, np.int32), np.zeros((3, 3), np.float32))
