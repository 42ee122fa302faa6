import sys
from collections.abc import Callable, Iterator
from typing import TypeAlias

import cv2
import mujoco
import numpy as np
import pytest

from simtrack.contracts import CameraIntrinsics, Command
from simtrack.errors import InvalidValueError, RenderingError
from simtrack.simulation import rendering
from simtrack.simulation.rendering import EmbreeRenderer, MujocoRenderer, make_renderer
from simtrack.simulation.scene_file import SceneFile
from simtrack.simulation.simulation import FAR, Simulation

MakeScene: TypeAlias = Callable[..., SceneFile]
HAND = {"rest": [2.5, 4.2, 1.1], "script": [{"do": "wait", "seconds": [5.0, 5.0]}]}
PRIMITIVES = """<mujoco><worldbody>
  <geom type='sphere' size='.08' pos='2.2 4.3 1.2'/> <geom type='capsule' size='.03 .1' pos='3.0 4.3 1.2'/>
  <body pos='2.9 4.2 1.4'><geom type='ellipsoid' size='.03 .05 .08' euler='30 20 10'/></body>
  <geom type='cylinder' size='.05 .05' pos='2.3 4.4 1.45' euler='40 0 0'/>
  <geom type='box' size='.02 .03 .04' pos='2.6 4.4 1.5'/>
</worldbody></mujoco>"""


@pytest.fixture(scope="module")
def renderers(
    small_scene: MakeScene, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[tuple[Simulation, MujocoRenderer, EmbreeRenderer]]:
    """Both renderers of a scene with objects, a hand in view, and primitives of a user."""
    folder = tmp_path_factory.mktemp("scene")
    (folder / "mine.xml").write_text(PRIMITIVES)
    scene = small_scene(folder, hand=HAND, mjcf="mine.xml")
    with Simulation(scene, seed=1, renderer="embree") as simulation:
        try:
            gl = MujocoRenderer(simulation.world, simulation.camera.intrinsics, FAR)
        except RenderingError as error:
            pytest.skip(str(error))
        rays = simulation._renderer
        assert isinstance(rays, EmbreeRenderer)
        simulation.advance(Command(torso=0.3, head_tilt=-0.3))
        simulation._history.load(simulation.now, simulation._scratch)
        yield simulation, gl, rays
        gl.close()
        gl.close()


def away_from_edges(depth: np.ndarray, ids: np.ndarray) -> np.ndarray:
    """Pixels whose neighbours show the same thing at about the same depth."""
    kernel = np.ones((3, 3), np.uint8)
    names = ids.astype(np.float32)
    same = cv2.dilate(names, kernel) == cv2.erode(names, kernel)
    return same & (cv2.dilate(depth, kernel) - cv2.erode(depth, kernel) < 0.02)


@pytest.mark.gl
def test_renderers_agree(renderers: tuple[Simulation, MujocoRenderer, EmbreeRenderer]) -> None:
    simulation, gl, rays = renderers
    state = simulation._scratch
    ids_gl, ids_rays = gl.ids(state), rays.ids(state)
    depth_gl, depth_rays = gl.depth(state).copy(), rays.depth(state).copy()
    seen = {simulation.world.names[k] for k in np.unique(ids_rays) if k >= 0}
    assert {"materialbox", "relay", "mug", "hand", "workbench", "mjcf/world"} <= seen
    inside = away_from_edges(depth_rays, ids_rays)
    assert inside.mean() > 0.6
    error = np.abs(depth_gl - depth_rays)[inside]
    assert np.quantile(error, 0.9999) < 1e-4
    assert np.median(error) < 1e-5
    assert (ids_gl == ids_rays)[inside].mean() > 0.99999
    assert (ids_gl == ids_rays).mean() > 0.999  # edges too: the same pixel convention


@pytest.mark.gl
def test_colours_agree_roughly(renderers: tuple[Simulation, MujocoRenderer, EmbreeRenderer]) -> None:
    simulation, gl, rays = renderers
    a, b = gl.rgb(simulation._scratch).astype(int), rays.rgb(simulation._scratch).astype(int)
    assert a.shape == b.shape == (480, 640, 3)
    ids = rays.ids(simulation._scratch)
    for name in ("materialbox", "hand"):
        mask = ids == simulation.world.names.index(name)
        hue = [image[mask].mean(axis=0) / image[mask].mean() for image in (a, b)]
        assert np.abs(hue[0] - hue[1]).max() < 0.25


@pytest.mark.gl
def test_a_closed_renderer_says_so(small_scene: MakeScene) -> None:
    with Simulation(small_scene(), 0, renderer="mujoco") as simulation:
        if simulation.renderer != "mujoco":
            pytest.skip("no EGL")
    with pytest.raises(RenderingError, match="closed"):
        simulation.advance(Command())


def test_without_egl_one_warning_and_rays(resting: Simulation, monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(*_: object) -> None:
        raise RenderingError("OpenGL cannot be used without a display here (EGL: none).")

    monkeypatch.setattr(rendering, "gl_context", missing)
    with pytest.warns(RuntimeWarning, match="--renderer embree") as caught:
        renderer = make_renderer("mujoco", resting.world, resting._rays, resting.camera.intrinsics, FAR)
    assert renderer.name == "embree"
    assert len(caught) == 1


def test_what_opengl_needs_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco.egl", None)
    with pytest.raises(RenderingError, match=r"libEGL and a driver .*apt install.*EGL says ModuleNotFoundError"):
        rendering.gl_context(CameraIntrinsics(64, 48, 60.0, 60.0, 31.5, 23.5))


def test_unknown_renderer(resting: Simulation) -> None:
    with pytest.raises(InvalidValueError, match="mujoco or embree"):
        make_renderer("vulkan", resting.world, resting._rays, resting.camera.intrinsics, FAR)


def test_reversed_depth_is_undone_exactly() -> None:
    model = mujoco.MjModel.from_xml_string("<mujoco/>")
    near, far = 0.03, 80.0
    model.vis.map.znear, model.vis.map.zfar = near, far
    renderer = object.__new__(MujocoRenderer)
    renderer._model, renderer._far = model, 10.0
    z = np.array([[0.05, 0.5, 1.0, 9.99]])
    renderer._buffer = (near * (far - z) / (z * (far - near))).astype(np.float32)
    np.testing.assert_allclose(renderer._metres(), z, rtol=1e-6)
