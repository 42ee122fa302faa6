"""Soft shadows against rays to every pixel and many points of a light."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from simtrack.contracts import CameraIntrinsics, Float64
from simtrack.datasets.annotate import Annotator, View
from simtrack.datasets.content import Content, Light
from simtrack.datasets.shadows import SKIN, remaining_light
from simtrack.geometry.meshes import box_mesh
from simtrack.raycast import TriangleMesh
from simtrack.sensors.camera import unproject
from tests.datasets.tabletop import content, lamp, look_at, owners

CAMERA = CameraIntrinsics(320, 240, 300.0, 300.0, 159.5, 119.5)
VIEW = look_at((0.35, -0.5, 0.55), (0.0, 0.0, 0.03))
BEHIND = (0.25, 0.4, 0.5)
"""Of the things, as the camera sees them: their shadows fall towards it."""


def seen(scene: Content, T: Float64 = VIEW) -> View:
    return Annotator(CAMERA).look(scene.rays, owners(scene.things), T)


def reference(scene: Content, view: View, samples: int) -> np.ndarray:
    """(H, W), what is left of the light of a scene with one white light, by brute force."""
    (light,) = scene.lights
    rng = np.random.default_rng(0)
    points = unproject(view.depth, CAMERA).reshape(-1, 3) @ VIEW[:3, :3].T + VIEW[:3, 3]
    normals = view.normals.reshape(-1, 3) @ VIEW[:3, :3].T
    towards = -light.direction * light.reach if light.directional else light.position - points
    distance = np.linalg.norm(towards, axis=-1, keepdims=True)
    strength = np.maximum((normals * towards / distance).sum(axis=1), 0.0) * light.color[0]
    if not light.directional:
        strength *= (light.reach / distance[:, 0]) ** 2
    left = np.zeros(len(points))
    x = np.cross([0.0, 0.0, 1.0], light.direction)
    x /= np.linalg.norm(x)
    y = np.cross(light.direction, x)
    for _ in range(samples):
        radius, angle = light.radius * np.sqrt(rng.random()), 2 * np.pi * rng.random()
        aim = towards + radius * (np.cos(angle) * x + np.sin(angle) * y) - (0 if light.directional else SKIN * normals)
        blocked = scene.rays.occluded(points + SKIN * normals, np.broadcast_to(aim, points.shape), 0.999)
        left += ~blocked / samples
    whole = scene.ambient[0] + strength
    return np.where(view.depth.ravel() > 0, (scene.ambient[0] + strength * left) / whole, 1.0).reshape(view.depth.shape)


SUN = Light(
    np.array([0.6, 0.72, 0.744]),
    np.array([-0.5, -0.6, -0.62]) / np.linalg.norm([0.5, 0.6, 0.62]),
    np.full(3, 0.6),
    True,
    1.2,
)


@pytest.mark.parametrize("light", [lamp(*BEHIND), SUN], ids=["point", "directional"])
def test_hard_shadows_are_those_of_exact_rays(light: Light) -> None:
    scene = content((light,))
    view = seen(scene)
    left = remaining_light(scene, view, VIEW, CAMERA)
    exact = reference(scene, view, 1)
    assert np.mean(exact < 0.7) > 0.05
    kernel = np.ones((9, 9), np.uint8)
    certain = cv2.dilate(exact, kernel) - cv2.erode(exact, kernel) < 0.2
    assert certain.mean() > 0.5
    error = np.abs(left[..., 1] - exact)[certain]
    assert np.quantile(error, 0.998) < 0.02 and error.max() < 0.2
    assert np.array_equal(left[..., 0], left[..., 2])  # all is white or grey here


@pytest.mark.parametrize("radius", [0.05, 0.15])
def test_soft_shadows_are_close_to_those_of_many_rays(radius: float) -> None:
    scene = content((replace(lamp(*BEHIND), radius=radius),))
    view = seen(scene)
    left = remaining_light(scene, view, VIEW, CAMERA)[..., 1]
    exact = reference(scene, view, 150)
    assert left.min() >= 0.0 and left.max() <= 1.0
    error = np.abs(left - exact)
    assert error.mean() < 0.01 and np.quantile(error, 0.99) < 0.15
    hard = remaining_light(content((lamp(*BEHIND),)), view, VIEW, CAMERA)[..., 1]
    assert np.abs(hard - exact).mean() > 1.4 * error.mean()


def test_without_anything_in_the_way_or_without_light_nothing_changes() -> None:
    scene = content((lamp(*BEHIND),))
    view = seen(scene)
    sky = view.ids < 0
    assert (remaining_light(scene, view, VIEW, CAMERA)[sky] == 1.0).all()
    for thing in scene.things:
        scene.rays.set_enabled(thing.ray_instance, False)
    empty = seen(scene)
    assert (remaining_light(scene, empty, VIEW, CAMERA) == 1.0).all()
    assert (remaining_light(replace(scene, lights=()), view, VIEW, CAMERA) == 1.0).all()
    dark = replace(scene, lights=(replace(scene.lights[0], color=np.zeros(3)),), ambient=np.zeros(3))
    assert (remaining_light(dark, view, VIEW, CAMERA) == 1.0).all()


def test_colours_of_lights_are_shadowed_apart() -> None:
    red, blue = np.array([0.6, 0.0, 0.0]), np.array([0.0, 0.0, 0.6])
    lights = (replace(lamp(*BEHIND), color=red), replace(lamp(-0.4, 0.1, 0.8), color=blue))
    scene = content(lights)
    view = seen(scene)
    both = remaining_light(scene, view, VIEW, CAMERA)
    alone = [remaining_light(content((light,)), view, VIEW, CAMERA) for light in lights]
    assert np.allclose(both[..., 0], alone[0][..., 0], atol=1e-5)
    assert np.allclose(both[..., 2], alone[1][..., 2], atol=1e-5)
    assert (both[..., 1] == 1.0).all()


def test_lights_outside_of_the_walls_shine_through_them() -> None:
    """As they do in images without shadows; things still throw theirs."""
    scene = content((lamp(0.4, 0.6, 1.0),))
    view = seen(scene)
    free = remaining_light(scene, view, VIEW, CAMERA)
    ceiling = box_mesh((4.0, 4.0, 0.02))
    scene.rays.add(TriangleMesh(ceiling.vertices + [0.0, 0.0, 0.9], ceiling.faces), instance=9)
    covered = remaining_light(scene, view, VIEW, CAMERA)
    assert np.mean(np.abs(covered - free) > 0.05) < 0.01
    assert np.mean(covered < 0.8) > 0.03


def test_bytes_repeat() -> None:
    scene = content((replace(lamp(*BEHIND), radius=0.1), SUN))
    view = seen(scene)
    first = remaining_light(scene, view, VIEW, CAMERA)
    assert np.array_equal(remaining_light(scene, view, VIEW, CAMERA), first)
