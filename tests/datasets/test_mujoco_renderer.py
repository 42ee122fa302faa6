"""MuJoCo's images show what rays see, at the same pixels, in the light that the scene says."""

from collections.abc import Iterator

import numpy as np
import pytest

from simtrack.contracts import CameraIntrinsics, Uint8
from simtrack.datasets.annotate import Annotator
from simtrack.datasets.content import ColorRenderer, Content, Light, Material, Shape
from simtrack.datasets.mujoco_renderer import MujocoColorRenderer
from simtrack.errors import InvalidValueError, RenderingError
from simtrack.geometry.meshes import Mesh, box_mesh, painted
from simtrack.raycast import RayScene
from simtrack.sensors.camera import project
from tests.datasets.tabletop import BOX, BRACKET, CAMERA, CAN, FLOOR, content, look_at, owners, ray_scene, tabletop

pytestmark = pytest.mark.gl

VIEW = look_at((0.5, -0.6, 0.5), (0.0, 0.0, 0.05))
COLORS = np.array([(250, 250, 250), (250, 0, 0), (0, 250, 0), (0, 0, 250)], np.uint8)


@pytest.fixture
def renderer() -> Iterator[MujocoColorRenderer]:
    made = MujocoColorRenderer(CAMERA)
    yield made
    made.close()


def sheet(light: Light, roughness: float = 1.0, uv: bool = False, texture: Uint8 | None = None) -> Content:
    """A white sheet of 2 x 2 m at z = 0 under one light, without ambient light."""
    corners = np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
    mesh = painted(Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]], np.int32)), (255, 255, 255))
    coordinates = ((mesh.vertices[mesh.faces][..., :2] + 1) / 2).astype(np.float32) if uv else None
    shape = Shape(mesh, np.eye(4), Material(texture, roughness), coordinates)
    return Content(0, (shape,), (), RayScene(), (light,), np.zeros(3), np.array([0.2, 0.4, 0.6]))


def sun(color: tuple[float, float, float]) -> Light:
    return Light(np.array([0.0, 0.0, 2.0]), np.array([0.0, 0.0, -1.0]), np.array(color), True)


def test_it_is_a_color_renderer(renderer: MujocoColorRenderer) -> None:
    assert isinstance(renderer, ColorRenderer)
    with pytest.raises(RenderingError, match="begin"):
        renderer.render(VIEW)
    off_centre = CameraIntrinsics(64, 48, 60.0, 60.0, 32.0, 24.0)
    with pytest.raises(InvalidValueError, match=r"cx = \(width - 1\) / 2"):
        MujocoColorRenderer(off_centre)


def test_every_pixel_shows_the_thing_that_its_ray_meets(renderer: MujocoColorRenderer) -> None:
    things = tabletop()
    meshes = (FLOOR, BRACKET, CAN, BOX)
    poses = (np.eye(4), *(thing.T_map_mesh for thing in things))
    shapes = tuple(
        Shape(painted(mesh, tuple(color.tolist())), T, Material())
        for mesh, T, color in zip(meshes, poses, COLORS, strict=True)
    )
    with ray_scene(things) as rays:
        lit = Content(0, shapes, things, rays, (), np.ones(3), np.array([0.0, 0.0, 0.0]))
        renderer.begin(lit)
        image = renderer.render(VIEW)
        ids = Annotator(CAMERA).look(rays, owners(things), VIEW).ids
    expected = np.where(ids[..., None] >= 0, COLORS[ids], 0)
    wrong = (np.abs(image.astype(int) - expected) > 8).any(axis=2)
    assert wrong.mean() < 2e-4
    # one pixel aside it fits clearly worse: the convention of pixel centres is the same
    for shift in ((0, 1), (1, 0), (0, -1), (-1, 0)):
        moved = (np.abs(np.roll(image, shift, (0, 1)).astype(int) - expected) > 8).any(axis=2)
        assert moved.mean() > 0.01


@pytest.mark.parametrize("height", [1.0, 2.0])
def test_point_lights_fall_with_the_square_of_the_distance(renderer: MujocoColorRenderer, height: float) -> None:
    color = np.array([0.8, 0.5, 0.2])
    lamp = Light(np.array([0.0, 0.0, height]), np.array([0.0, 0.0, -1.0]), color, False, reach=1.0)
    shape = Shape(box_mesh((0.02, 0.02, 0.001), (255, 255, 255)), np.eye(4), Material(None, 1.0))
    renderer.begin(Content(0, (shape,), (), RayScene(), (lamp,), np.zeros(3), np.zeros(3)))
    middle = renderer.render(look_at((0.02, 0.0, 0.06), (0.0, 0.0, 0.0)))[60, 80] / 255.0
    assert middle == pytest.approx(color / height**2, rel=0.12, abs=0.01)  # a tenth of gloss is left


def test_directional_lights_shine_evenly_and_the_background_shows(renderer: MujocoColorRenderer) -> None:
    renderer.begin(sheet(sun((0.6, 0.3, 0.1))))
    image = renderer.render(look_at((0.01, 0.0, 1.5), (0.0, 0.0, 0.0))) / 255.0
    assert np.ptp(image, axis=(0, 1)).max() < 0.08
    assert image.mean(axis=(0, 1)) == pytest.approx([0.6, 0.3, 0.1], rel=0.12)
    sky = renderer.render(look_at((0.0, 0.0, 1.0), (1.0, 0.0, 2.0)))
    assert np.abs(sky / 255.0 - [0.2, 0.4, 0.6]).max() < 0.01


def test_textures_lie_where_their_coordinates_say(renderer: MujocoColorRenderer) -> None:
    quarters = np.zeros((64, 64, 3), np.uint8)
    quarters[:32, :32], quarters[:32, 32:], quarters[32:, :32] = (250, 0, 0), (0, 250, 0), (0, 0, 250)
    renderer.begin(sheet(sun((1.0, 1.0, 1.0)), uv=True, texture=quarters))
    T = look_at((0.01, 0.0, 1.5), (0.0, 0.0, 0.0))
    image = renderer.render(T)
    for (x, y), color in {(-0.3, -0.3): 0, (0.3, -0.3): 1, (-0.3, 0.3): 2}.items():
        u, v = project((np.array([[x, y, 0.0]]) - T[:3, 3]) @ T[:3, :3], CAMERA)[0].round().astype(int)
        assert image[v, u].argmax() == color
        assert image[v, u].max() > 200


def test_a_scene_looks_the_same_whatever_was_shown_before(renderer: MujocoColorRenderer) -> None:
    first, other = content(), content(lights=(), surface=Material(None, 0.2, 1.0), scene=1)
    renderer.begin(first)
    fresh = renderer.render(VIEW)
    renderer.begin(other)
    assert not np.array_equal(renderer.render(VIEW), fresh)
    renderer.begin(first)
    assert np.array_equal(renderer.render(VIEW), fresh)
    renderer.close()
    renderer.close()
    with pytest.raises(RenderingError, match="close"):
        renderer.render(VIEW)
