"""pyrender's images show what rays meet, light adds up as physics has it, and bytes repeat."""

import hashlib
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace

import cv2
import numpy as np
import pytest

from simtrack.contracts import CameraIntrinsics, Float64
from simtrack.datasets.annotate import Annotator
from simtrack.datasets.content import ColorRenderer, Content, Light, Material, Shape
from simtrack.datasets.pbr_renderer import PbrRenderer
from simtrack.errors import RenderingError
from simtrack.geometry.meshes import Mesh
from tests.datasets.tabletop import CAMERA, REPOSITORY, content, lamp, look_at, owners, tabletop

pytestmark = pytest.mark.gl
VIEW = look_at((0.5, -0.6, 0.5), (0.0, 0.0, 0.05))
ABOVE = look_at((0.0, -0.001, 1.0), (0.0, 0.0, 0.0))
"""Upper edge of the image towards +y."""
SUN = Light(np.zeros(3), np.array([0.0, 0.0, -1.0]), np.full(3, 0.5), True)


@pytest.fixture(scope="module")
def renderer() -> Iterator[PbrRenderer]:
    made = PbrRenderer(CAMERA, samples=1)
    try:
        made.begin(content())
    except RenderingError as error:
        pytest.skip(str(error))
    assert isinstance(made, ColorRenderer)
    yield made
    made.close()
    made.close()


@pytest.fixture(scope="module")
def linear(renderer: PbrRenderer) -> Callable[..., np.ndarray]:
    """Light that reaches the camera, (H, W, 3), 0 to 1."""

    def render(scene: Content, T_map_camera: Float64 = VIEW) -> np.ndarray:
        renderer.begin(scene)
        return (renderer.render(T_map_camera) / 255.0) ** 2.2

    return render


def away_from_edges(ids: np.ndarray, depth: np.ndarray, normals: np.ndarray | None = None) -> np.ndarray:
    """Pixels whose neighbours show the same thing about as far away, with about the same normal if they are given."""
    kernel = np.ones((3, 3), np.uint8)
    if normals is not None:
        turn = (cv2.dilate(normals, kernel) - cv2.erode(normals, kernel)).max(axis=2)
        return away_from_edges(ids, depth) & (turn < 0.1)
    names = ids.astype(np.float32)
    same = cv2.dilate(names, kernel) == cv2.erode(names, kernel)
    return same & (cv2.dilate(depth, kernel) - cv2.erode(depth, kernel) < 0.05)


@pytest.mark.parametrize(
    "camera", [CAMERA, CameraIntrinsics(161, 119, 150.0, 140.0, 70.3, 64.8)], ids=["centred", "odd and off centre"]
)
def test_the_rasteriser_and_rays_show_the_same_thing(camera: CameraIntrinsics) -> None:
    scene, renderer = content(), PbrRenderer(camera, samples=1)
    renderer.begin(scene)
    for T in (VIEW, look_at((-0.4, 0.3, 0.35), (0.0, 0.0, 0.05)), look_at((0.9, 0.9, 0.2), (0.0, 0.0, 0.3))):
        view = Annotator(camera).look(scene.rays, owners(scene.things), T)
        depth, color = renderer.depth(T), renderer.render(T)
        assert color.shape == (camera.height, camera.width, 3) and depth.shape == view.depth.shape
        inner = away_from_edges(view.ids, view.depth)
        assert inner.mean() > 0.7
        assert np.abs(depth - view.depth)[inner].max() < 0.001
        # On edges two pixels may differ by which side their centre is on, to float32.
        assert np.count_nonzero((depth > 0) != (view.ids >= 0)) <= 2
        sky = np.round(255 * scene.background)
        assert np.abs(color[(view.ids < 0) & inner] - sky).max(initial=0) <= 1
    renderer.close()


def test_ids_can_be_told_from_colours_at_pixel_centres(renderer: PbrRenderer) -> None:
    """Silhouettes of things in colours of their own agree with the ids, but for a few pixels on their edges."""
    scene = replace(content((SUN,)), ambient=np.full(3, 0.5))
    renderer.begin(scene)
    image = renderer.render(VIEW).astype(int)
    view = Annotator(CAMERA).look(scene.rays, owners(scene.things), VIEW)
    yellow = (image[..., 0] > image[..., 2] + 60) & (image[..., 1] > image[..., 2] + 60)
    blue = image[..., 2] > image[..., 0] + 60
    assert np.count_nonzero(yellow != (view.ids == 2)) <= 2
    assert np.count_nonzero(blue != (view.ids == 3)) <= 2


def test_a_light_makes_white_as_bright_as_it_says(linear: Callable[..., np.ndarray]) -> None:
    matt = Material(roughness=1.0)
    dark = np.zeros(3)
    white = (200 / 255.0) ** 2.2
    for light in (SUN, lamp(0.0, 0.0, 1.2, 0.5)):
        scene = replace(content((light,), floor=matt), ambient=dark)
        floor = linear(scene, look_at((0.3, 0.5, 0.8), (0.0, 0.5, 0.0)))
        if light.directional:
            assert np.median(floor) == pytest.approx(0.5 * white, rel=0.08)
    at = linear(
        replace(content((lamp(0.0, 0.5, 1.0, 0.5),), floor=matt), ambient=dark),
        look_at((0.0, 0.499, 0.8), (0.0, 0.5, 0.0)),
    )
    distance = lamp(0.0, 0.5, 1.0).reach
    assert at[60, 80].mean() == pytest.approx(0.5 * distance**2 * white, rel=0.08)
    ambient = linear(replace(content((), floor=matt), ambient=np.full(3, 0.3)), ABOVE)
    assert np.median(ambient) == pytest.approx(0.3 * white, rel=0.05)


def test_light_adds_up(linear: Callable[..., np.ndarray]) -> None:
    a, b = lamp(0.5, -0.4, 1.0, 0.3), Light(np.zeros(3), np.array([0.6, 0.0, -0.8]), np.array([0.3, 0.1, 0.2]), True)
    dark = np.zeros(3)
    one, other, both = (linear(replace(content(lights), ambient=dark)) for lights in ((a,), (b,), (a, b)))
    sky = one[2, 2] * (one[2, 2] == other[2, 2])
    where = np.abs(one - sky).max(axis=2) > 1e-9
    assert where.mean() > 0.5
    assert np.abs(one + other - both)[where].max() < 0.02


def test_seven_lights_are_all_seen(linear: Callable[..., np.ndarray]) -> None:
    lights = tuple(lamp(0.6 * np.cos(a), 0.6 * np.sin(a), 1.0, 0.08) for a in np.arange(7.0))
    few, many = linear(content(lights[:4])), linear(content(lights))
    sky = content().background ** 2.2
    floor = np.abs(few - sky).max(axis=2) > 0.05
    assert np.median((many - few)[floor]) > 0.05


def test_smooth_things_glint_and_metal_keeps_its_colour(linear: Callable[..., np.ndarray]) -> None:
    top = tabletop()[1].T_map_object[:3, 3] + [0.0, 0.0, 0.08]
    towards = (VIEW[:3, 3] - top) / np.linalg.norm(VIEW[:3, 3] - top)
    light = Light(np.zeros(3), towards * [1.0, 1.0, -1.0], np.full(3, 0.3), True)  # as the can's lid mirrors it
    scenes = [
        content((light,), surface=Material(roughness=r, metallic=m)) for r, m in ((1.0, 0.0), (0.25, 0.0), (0.25, 1.0))
    ]
    matt, glossy, metal = (linear(replace(scene, ambient=np.zeros(3))) for scene in scenes)
    view = Annotator(CAMERA).look(scenes[0].rays, owners(scenes[0].things), VIEW)
    can = view.ids == 2
    assert glossy[can].max() > 1.5 * matt[can].max()
    assert np.median(metal[can]) < 0.3 * np.median(matt[can])  # metal reflects nothing diffusely
    shine = metal[can & (metal.max(axis=2) < 0.99)]
    brightest = shine[np.argmax(shine.sum(axis=1))]
    assert brightest[0] > 2 * brightest[2]  # and what it mirrors is in its own colour, yellow


QUARTERS = np.zeros((64, 64, 3), np.uint8)
QUARTERS[:32, :32], QUARTERS[:32, 32:], QUARTERS[32:, :32] = (255, 0, 0), (0, 255, 0), (0, 0, 255)
SHEET = Mesh(np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]) - 0.5, np.array([[0, 1, 2], [0, 2, 3]]))


def sheet(scene: Content, uv: np.ndarray, T: Float64) -> Content:
    """A lone sheet whose texture is red, green / blue, black; its texture coordinates are its x and y."""
    shape = Shape(SHEET, T, Material(QUARTERS, roughness=1.0), uv.astype(np.float32))
    return replace(scene, shapes=(shape,), ambient=np.ones(3), lights=(), background=np.ones(3))


def test_textures_lie_as_their_coordinates_say_and_repeat(renderer: PbrRenderer) -> None:
    """Row 0 of the image is at v = 0, as in MuJoCo."""
    corners = (SHEET.vertices[:, :2] + 0.5)[SHEET.faces]
    raised = np.eye(4)
    raised[2, 3] = 0.5
    renderer.begin(sheet(content(), corners, raised))
    image = renderer.render(ABOVE)

    def at(x: float, y: float) -> list[int]:
        pixel = np.round([CAMERA.cx + CAMERA.fx * x / 0.5, CAMERA.cy - CAMERA.fy * y / 0.5]).astype(int)
        return image[pixel[1], pixel[0]].tolist()

    # From above, x is to the right and y is up.
    assert at(-0.1, -0.1) == [255, 0, 0] and at(0.1, -0.1) == [0, 255, 0]
    assert at(-0.1, 0.1) == [0, 0, 255] and at(0.1, 0.1) == [0, 0, 0]
    renderer.begin(sheet(content(), corners + [3.5, -2.0], raised))
    image = renderer.render(ABOVE)
    assert at(-0.1, -0.1) == [0, 255, 0] and at(0.1, -0.1) == [255, 0, 0]


def test_sheets_are_seen_and_lit_from_both_sides(linear: Callable[..., np.ndarray]) -> None:
    corners = (SHEET.vertices[:, :2] + 0.5)[SHEET.faces]
    scene = replace(sheet(content(), corners, np.eye(4)), background=np.zeros(3))
    below = look_at((0.0, -0.001, -1.0), (0.0, 0.0, 0.0))
    lit = Light(np.zeros(3), np.array([0.0, 0.0, 1.0]), np.full(3, 0.7), True)
    dark = replace(scene, ambient=np.zeros(3))
    assert linear(scene, below).max() > 0.8
    assert linear(replace(dark, lights=(lit,)), below).max() > 0.5
    assert linear(replace(dark, lights=(lit,)), ABOVE).max() < 0.01  # its other side is in the dark


def test_more_colours_than_a_row_of_the_palette_has(renderer: PbrRenderer) -> None:
    count = 600
    step = 0.5 / count
    corners = [[[x, -0.2, 0], [x + step, -0.2, 0], [x + step, 0.2, 0]] for x in np.arange(count) * step - 0.25]
    colors = np.stack([np.arange(count) % 256, np.arange(count) // 256 * 100, np.full(count, 7)], axis=1)
    mesh = Mesh(
        np.reshape(corners, (-1, 3)), np.arange(3 * count, dtype=np.int32).reshape(-1, 3), colors.astype(np.uint8)
    )
    scene = content(())
    renderer.begin(replace(scene, shapes=(Shape(mesh, np.eye(4), Material()),), ambient=np.ones(3), lights=()))
    image = renderer.render(look_at((0.0, -0.151, 0.3), (0.0, -0.15, 0.0)))
    row = image[60].astype(float)
    face = np.round(((np.arange(CAMERA.width) - CAMERA.cx) / CAMERA.fx * 0.3 + 0.25) / step - 0.5).astype(int)
    shown = (face >= 0) & (face < count)
    assert shown.sum() > 100
    share = colors[face[shown]] / 255.0
    light = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    off = np.abs(row[shown] - 255.0 * light ** (1 / 2.2)).max(axis=1)
    assert np.mean(off <= 5) > 0.85  # the neighbour's colour is one off; an eighth of the width is free


def test_an_image_depends_on_its_scene_alone(renderer: PbrRenderer) -> None:
    def render(scene: Content) -> bytes:
        renderer.begin(scene)
        return renderer.render(VIEW).tobytes()

    scenes = [content((lamp(0.4, 0.1 * k, 1.0), SUN, lamp(-0.5, 0.2, 0.8, 0.2))) for k in range(3)]
    first = [render(scene) for scene in scenes]
    assert len(set(first)) == 3
    assert [render(scene) for scene in reversed(scenes)] == first[::-1]
    other = PbrRenderer(CAMERA, samples=1)
    other.begin(scenes[1])
    assert other.render(VIEW).tobytes() == first[1]
    other.close()
    assert renderer.render(VIEW).tobytes() == first[0]  # and the other's end leaves this one alone


REPEAT = """
import hashlib
from simtrack.datasets.pbr_renderer import PbrRenderer
from tests.datasets.test_pbr_renderer import CAMERA, VIEW, five_lights
renderer = PbrRenderer(CAMERA)
renderer.begin(five_lights())
print(hashlib.sha256(renderer.render(VIEW).tobytes()).hexdigest())
"""


def five_lights() -> Content:
    return content(tuple(lamp(0.6 * np.cos(a), 0.6 * np.sin(a), 1.0 + 0.1 * a, 0.1) for a in np.arange(5.0)))


def test_bytes_repeat_in_another_process() -> None:
    renderer = PbrRenderer(CAMERA)
    renderer.begin(five_lights())
    expected = hashlib.sha256(renderer.render(VIEW).tobytes()).hexdigest()
    renderer.close()
    # It does not close its renderer, and still ends without a word.
    ran = subprocess.run([sys.executable, "-W", "error", "-c", REPEAT], cwd=REPOSITORY, capture_output=True, text=True)
    assert (ran.returncode, ran.stderr) == (0, "")
    assert ran.stdout.strip() == expected


def test_mujocos_renderer_lives_beside_it(renderer: PbrRenderer, monkeypatch: pytest.MonkeyPatch) -> None:
    import mujoco
    from mujoco.egl import GLContext
    from mujoco.rendering.classic import gl_context

    # Which one MuJoCo takes was settled when it was imported, maybe before anything asked for EGL.
    monkeypatch.setattr(gl_context, "GLContext", GLContext)
    model = mujoco.MjModel.from_xml_string("<mujoco><worldbody><geom size='.1' rgba='1 0 0 1'/></worldbody></mujoco>")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)

    def red() -> int:
        beside.update_scene(data)
        return int(np.count_nonzero(beside.render()[..., 0] > 60))

    with mujoco.Renderer(model, 48, 64) as beside:
        seen = red()
        assert seen > 100
        short = PbrRenderer(CAMERA)
        short.begin(content())
        image = short.render(VIEW)
        assert red() == seen
        assert np.array_equal(short.render(VIEW), image)
        short.close()
        assert red() == seen
    renderer.begin(content())
    assert renderer.render(VIEW).std() > 5


def test_more_samples_smooth_edges(renderer: PbrRenderer) -> None:
    renderer.begin(content())
    hard = renderer.render(VIEW).astype(int)
    smooth = PbrRenderer(CAMERA)
    smooth.begin(content())
    soft = smooth.render(VIEW).astype(int)
    smooth.close()
    view = Annotator(CAMERA).look(content().rays, owners(content().things), VIEW)
    inner = away_from_edges(view.ids, view.depth, view.normals)
    change = np.abs(hard - soft).max(axis=2)
    assert change[~inner].max() > 40 and np.quantile(change[inner], 0.999) <= 4


def test_it_says_when_there_is_nothing_to_render() -> None:
    renderer = PbrRenderer(CAMERA)
    with pytest.raises(RenderingError, match="begin"):
        renderer.render(VIEW)
    renderer.begin(content())
    renderer.close()
    with pytest.raises(RenderingError, match="close"):
        renderer.render(VIEW)
