"""What a network is shown and what it is told to answer agree, whatever was done to the image."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from simtrack.contracts import Float64
from simtrack.geometry.meshes import box_mesh
from simtrack.geometry.transforms import exp_so3, transform
from simtrack.objects import ObjectModel
from simtrack.objects.model import build_model, half_turns
from simtrack.perception.detection.boxes import decoded_boxes, overlap
from simtrack.perception.detection.views import Pyramid, warped, window_about
from simtrack.training import keypoint_samples
from simtrack.training.box_samples import SHOWN_HEIGHT, SHOWN_WIDTH, targets
from simtrack.training.box_samples import sample as box_sample
from simtrack.training.keypoint_samples import CELLS, SIZE, sample
from simtrack.training.pasting import LabelledView, paste
from simtrack.training.shards import BACKGROUND, CROPS, IMAGES, PATCH, PATCH_WINDOW

FOCAL, WIDTH, HEIGHT = 500.0, 640, 480
K = np.array([FOCAL, FOCAL, (WIDTH - 1) / 2, (HEIGHT - 1) / 2])


def model(*, symmetric: bool = False) -> ObjectModel:
    mesh = box_mesh((0.2, 0.12, 0.08), (200, 80, 40))
    return build_model(
        name="brick", semantic_class="component", mesh=mesh, visual=mesh, collision=[mesh], mass=1.0, friction=0.5,
        symmetries=half_turns("z") if symmetric else half_turns(), trackable=True,
    )  # fmt: skip


def project(points: Float64, T: Float64) -> Float64:
    p = points @ T[:3, :3].T + T[:3, 3]
    return p[:, :2] / p[:, 2:] * K[:2] + K[2:]


def record_of(rgb: np.ndarray, depth: np.ndarray, T: Float64, box: Float64) -> np.ndarray:
    record, window = np.zeros((), CROPS), window_about(box, PATCH_WINDOW)
    pixels = window.pixels_of(PATCH)
    record["rgb"], record["depth"] = Pyramid(rgb).cut(pixels, PATCH), warped(depth, pixels, PATCH, smooth=False)
    record["mask"] = 1
    record["window"], record["box"] = (window.u, window.v, window.side), box
    record["intrinsics"], record["T_camera_object"], record["visible"] = K, T, 1.0
    return record


def pose(seed: int) -> Float64:
    rng = np.random.default_rng(seed)
    return transform(exp_so3(rng.uniform(-3, 3, 3)), tuple(rng.uniform((-0.15, -0.15, 0.7), (0.15, 0.15, 1.3))))


@settings(max_examples=12)
@given(seed=st.integers(0, 10_000), keypoint=st.integers(0, 8))
def test_a_keypoint_is_told_where_its_pixel_is_shown(seed: int, keypoint: int) -> None:
    import cv2

    T, brick = pose(seed), model()
    keypoints = project(brick.keypoints, T)
    rgb = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    u, v = keypoints[keypoint]
    vs, us = np.mgrid[:HEIGHT, :WIDTH]
    rgb[:] = (255 * np.exp(-0.5 * ((us - u) ** 2 + (vs - v) ** 2) / 16.0)).astype(np.uint8)[..., None]
    box = np.concatenate([keypoints.min(axis=0), keypoints.max(axis=0)])
    record = record_of(rgb, np.zeros((HEIGHT, WIDTH), np.float32), T, box)
    rng = np.random.default_rng(seed)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(keypoint_samples, "_recoloured", lambda image, rng: image)
        patch.setattr(keypoint_samples, "OTHER_CLASS", 0.0)
        shown = sample(record, [brick], rng)
    told = shown.keypoints[keypoint] * SIZE - 0.5
    if not (told > 4.0).all() or not (told < SIZE - 5.0).all():
        return
    # Brighter than the grey outside of the image.
    centre = cv2.moments(np.maximum(shown.shown[0] - 0.1, 0.0).astype(np.float32))
    seen = np.array([centre["m10"], centre["m01"]]) / centre["m00"]
    assert np.linalg.norm(seen - told) < 0.35  # a patch's pixel, as the window is drawn from stored ones


def test_object_points_are_those_of_the_surface_that_is_seen() -> None:
    """A face of the box square to the camera: what each cell shows lies on that face, and moves with the cell."""
    brick = model()
    T = transform(translation=(0.03, -0.02, 1.0))
    front = 1.0 - 0.04
    rgb, depth = np.zeros((HEIGHT, WIDTH, 3), np.uint8), np.full((HEIGHT, WIDTH), front, np.float32)
    corners = project(brick.keypoints[:4], T)
    record = record_of(rgb, depth, T, np.concatenate([corners.min(axis=0), corners.max(axis=0)]))
    points = sample(record, [brick], np.random.default_rng(0), plain=True).points
    known = points[3] > 0
    assert points.shape == (4, CELLS, CELLS)
    assert known.any()
    assert np.allclose(points[2][known], -1.0, atol=2e-3)  # float16 keeps a millimetre at 1 m
    inside = known & (np.abs(points[:2]) <= 1.0).all(axis=0)
    assert (np.diff(points[0], axis=1)[:, :-1][inside[:, 1:-1]] > 0).all()


def test_poses_that_look_alike_are_told_the_same() -> None:
    brick = model(symmetric=True)
    rgb, depth = np.zeros((HEIGHT, WIDTH, 3), np.uint8), np.zeros((HEIGHT, WIDTH), np.float32)
    for seed in range(5):
        T = pose(seed)
        keypoints = project(brick.keypoints, T)
        box = np.concatenate([keypoints.min(axis=0), keypoints.max(axis=0)])
        told = [
            sample(record_of(rgb, depth, T @ S, box), [brick], np.random.default_rng(seed)).keypoints
            for S in brick.symmetries.discrete
        ]
        assert np.allclose(told[0], told[1], atol=1e-4)


def test_what_is_not_there_is_told_so() -> None:
    record = record_of(np.zeros((HEIGHT, WIDTH, 3), np.uint8), np.ones((HEIGHT, WIDTH), np.float32), np.eye(4),
                       np.array([100.0, 100.0, 200.0, 200.0]))  # fmt: skip
    record["class_index"] = BACKGROUND
    shown = sample(record, [model()], np.random.default_rng(0))
    assert not shown.present
    assert not shown.points.any()


@settings(max_examples=25)
@given(
    st.lists(
        st.tuples(st.integers(0, 2), st.floats(0.0, 220.0), st.floats(0.0, 160.0), st.floats(14.0, 120.0),
                  st.floats(14.0, 120.0)), min_size=1, max_size=3, unique_by=lambda row: row[0],
    )
)  # fmt: skip
def test_boxes_are_read_back_from_what_is_told_of_them(rows: list[tuple[int, float, float, float, float]]) -> None:
    boxes = np.array([[u, v, min(u + w, SHOWN_WIDTH - 1), min(v + h, SHOWN_HEIGHT - 1)] for _, u, v, w, h in rows])
    classes = np.array([row[0] for row in rows])
    heat, _, sides, _ = targets(boxes, classes, np.ones(len(rows)), 3)
    logits = np.log(np.clip(heat, 1e-6, 1 - 1e-6) / (1 - np.clip(heat, 1e-6, 1 - 1e-6)))
    found = decoded_boxes(logits, np.log(sides).reshape(-1, *heat.shape[1:]), threshold=0.9)
    assert sorted(box.class_index for box in found) == sorted(classes)
    for box in found:  # also where a thing lies in the middle of another: every class has sides of its own
        there = boxes[int(np.flatnonzero(classes == box.class_index)[0])]
        assert overlap(box.corners, there) > 0.85  # sides are told from whole cells, at least 0.1


def test_a_part_moves_boxes_with_the_image(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("simtrack.training.box_samples.ABOUT_OBJECT", 1.0)
    record = brick_image((120, 100, 180, 140), 1, 1.0)
    for seed in range(4):
        shown, heat, *_ = box_sample(record, [], 3, np.random.default_rng(seed))
        v, u = np.unravel_index(int(np.argmax(heat[1])), heat[1].shape)
        brightest = shown[:3].sum(axis=0)
        assert heat[1, v, u] > 0.999
        assert brightest[v * 4 : v * 4 + 4, u * 4 : u * 4 + 4].mean() > np.median(brightest)


def brick_image(box: tuple[int, int, int, int], class_index: int, distance: float) -> np.ndarray:
    """A bright rectangle at a distance in metres, nothing else."""
    u0, v0, u1, v1 = box
    record = np.zeros((), IMAGES)
    record["classes"], record["depth"] = BACKGROUND, distance
    record["rgb"][v0:v1, u0:u1], record["index"][v0:v1, u0:u1] = 255, 1
    record["boxes"][0], record["classes"][0], record["visible"][0] = (u0, v0, u1 - 1, v1 - 1), class_index, 1.0
    return record


@pytest.mark.parametrize("seed", range(8))
def test_what_is_pasted_is_as_large_as_it_is_there_and_hides_what_is_behind(seed: int) -> None:
    view = LabelledView.of(brick_image((100, 100, 220, 220), 1, 2.0))
    assert paste(view, brick_image((200, 100, 260, 140), 2, 1.0), np.random.default_rng(seed))
    box, mask = view.boxes[1], view.index == 2
    assert view.classes[1] == 2
    sides = box[2:] - box[:2] + 1
    assert (sides >= np.round([30, 20])).all()  # half as large at twice the distance, or somewhat nearer
    assert (sides <= np.round(np.array([30, 20]) * np.exp(0.12)) + 1).all()
    assert (view.rgb[mask] == 255).all()
    assert (view.depth[mask] <= 2.0).all()
    assert (view.depth[mask] >= 2.0 * np.exp(-0.12) - 1e-3).all()
    assert view.visible[0] == pytest.approx(np.count_nonzero(view.index == 1) / 120**2, abs=1e-3)
    inside = np.argwhere(mask)[:, ::-1]
    assert (inside >= box[:2]).all()
    assert (inside <= box[2:]).all()


def test_objects_that_are_cut_off_or_hidden_are_not_pasted() -> None:
    view = LabelledView.of(brick_image((100, 100, 220, 220), 1, 2.0))
    cut, hidden = brick_image((0, 100, 60, 140), 2, 1.0), brick_image((200, 100, 260, 140), 2, 1.0)
    hidden["visible"][0] = 0.5
    before = view.index.copy()
    for donor in (cut, hidden):
        assert not paste(view, donor, np.random.default_rng(0))
    assert np.array_equal(view.index, before)
