"""pyrender's scene and drawing, in an OpenGL context that is current. Import it only where there is one."""

from typing import Any

import numpy as np
import OpenGL.GL as gl
import pyrender
from pyrender.constants import GLTF, RenderFlags
from pyrender.renderer import Renderer

from simtrack.contracts import CameraIntrinsics, Float32, Float64, Uint8
from simtrack.datasets.content import Content, Light, Shape
from simtrack.datasets.corners import corners_of
from simtrack.geometry.meshes import Mesh, is_closed
from simtrack.geometry.transforms import transform

NEAR, FAR = 0.03, 80.0
"""Clip planes, metres."""
MAX_LIGHTS = 8
"""Of each kind; a scene with more shows those that are nearest to each shape."""
GREY = 200
"""Of meshes without colours."""
_PALETTE_WIDTH = 256
_OPTICAL_OPENGL = transform(np.diag([1.0, -1.0, -1.0]))
"""OpenGL's cameras look along -z with y up."""
_NEAREST = pyrender.Sampler(magFilter=GLTF.NEAREST, minFilter=GLTF.NEAREST)


class _OrderedScene(pyrender.Scene):
    """Its shapes and lights have an order; that of sets, and with it the last bit, differs from run to run."""

    @property
    def mesh_nodes(self) -> Any:
        """Shapes in the order in which they were added."""
        return sorted(self._mesh_nodes, key=lambda node: node.name)

    @property
    def light_nodes(self) -> Any:
        """Lights in the order in which they were added."""
        nodes = (*self._point_light_nodes, *self._spot_light_nodes, *self._directional_light_nodes)
        return sorted(nodes, key=lambda node: node.name)


class _Renderer(Renderer):
    """Drawing with another number of samples a pixel than its four, and room for more lights."""

    def __init__(self, width: int, height: int, samples: int) -> None:
        super().__init__(width, height)
        self._samples = 0 if samples == 1 else min(samples, int(gl.glGetIntegerv(gl.GL_MAX_SAMPLES)))
        self.want_depth = False

    def _configure_main_framebuffer(self) -> None:
        former = self._main_fb
        super()._configure_main_framebuffer()
        if self._main_fb != former:
            for buffer, kind in ((self._main_cb_ms, gl.GL_RGBA), (self._main_db_ms, gl.GL_DEPTH_COMPONENT24)):
                gl.glBindRenderbuffer(gl.GL_RENDERBUFFER, buffer)
                size = self.viewport_width, self.viewport_height
                gl.glRenderbufferStorageMultisample(gl.GL_RENDERBUFFER, self._samples, kind, *size)

    def _read_main_framebuffer(self, scene: Any, flags: int) -> Any:
        if self.want_depth:
            return super()._read_main_framebuffer(scene, flags)
        width, height = int(self.viewport_width), int(self.viewport_height)
        rectangle = 0, 0, width, height
        gl.glBindFramebuffer(gl.GL_READ_FRAMEBUFFER, self._main_fb_ms)
        gl.glBindFramebuffer(gl.GL_DRAW_FRAMEBUFFER, self._main_fb)
        gl.glBlitFramebuffer(*rectangle, *rectangle, gl.GL_COLOR_BUFFER_BIT, gl.GL_NEAREST)
        gl.glBindFramebuffer(gl.GL_READ_FRAMEBUFFER, self._main_fb)
        pixels: Any = gl.glReadPixels(*rectangle, gl.GL_RGB, gl.GL_UNSIGNED_BYTE)
        return np.frombuffer(pixels, np.uint8).reshape(height, width, 3)[::-1], np.empty((0, 0), np.float32)

    def _compute_max_n_lights(self, flags: int) -> list[int]:
        return [MAX_LIGHTS] * 3  # pyrender asks OpenGL anew for each shape

    def __del__(self) -> None:
        """Nothing: whoever made it deletes it while its context is current."""


class Drawing:
    """Draws one scene after the other into a buffer of one or more samples a pixel."""

    def __init__(self, intrinsics: CameraIntrinsics, samples: int) -> None:
        self._renderer = _Renderer(intrinsics.width, intrinsics.height, samples)
        # OpenGL puts pixel centres at halves.
        center = intrinsics.cx + 0.5, intrinsics.cy + 0.5
        self._lens = pyrender.IntrinsicsCamera(intrinsics.fx, intrinsics.fy, *center, NEAR, FAR)
        self._scene = _OrderedScene()
        self._eye = self._scene.add(self._lens)

    def begin(self, content: Content) -> None:
        """Take over a scene; the former one's buffers are given back with the next image."""
        self._scene = _OrderedScene(bg_color=[*content.background, 1.0], ambient_light=np.asarray(content.ambient))
        for number, shape in enumerate(content.shapes):
            self._scene.add(_drawn(shape), name=f"{number:06d}", pose=shape.T_map_mesh)
        for number, light in enumerate(content.lights):
            lamp, pose = _lamp(light)
            self._scene.add(lamp, name=f"{number:06d}", pose=pose)
        self._eye = self._scene.add(self._lens)

    def draw(self, T_map_camera: Float64, depth: bool) -> tuple[Uint8, Float32]:
        """Colours (H, W, 3) and, if it is asked for, depth (H, W) in metres, 0 = nothing."""
        self._scene.set_pose(self._eye, T_map_camera @ _OPTICAL_OPENGL)
        self._renderer.want_depth = depth
        images: Any = self._renderer.render(self._scene, RenderFlags.OFFSCREEN)
        return images

    def delete(self) -> None:
        """Give everything back to OpenGL."""
        self._renderer.delete()


def _lamp(light: Light) -> tuple[Any, Float64]:
    """The light as pyrender knows it, and its pose; it shines along -z."""
    strength = float(np.max(light.color))
    color = np.asarray(light.color, float) / max(strength, 1e-9)
    strength *= np.pi  # a matt surface scatters what falls onto it over the half sphere
    if not light.directional:
        lamp = pyrender.PointLight(color, strength * light.reach**2)
        return lamp, transform(None, light.position)
    z = -np.asarray(light.direction, float)
    x = np.cross(np.eye(3)[np.argmin(np.abs(z))], z)
    x /= np.linalg.norm(x)
    return pyrender.DirectionalLight(color, strength), transform(np.stack([x, np.cross(z, x), z], axis=1))


def _drawn(shape: Shape) -> pyrender.Mesh:
    mesh, look = shape.mesh, shape.material
    if look.texture is not None and shape.uv is not None:
        # pyrender follows glTF, where row 0 is on top, at v = 0, and turns the image over for OpenGL, but not v.
        uv, texture = (
            shape.uv * np.array([1.0, -1.0], np.float32),
            pyrender.Texture(source=look.texture, source_channels="RGB"),
        )
    else:
        colors, uv = _palette(mesh)
        texture = pyrender.Texture(source=colors, source_channels="RGB", sampler=_NEAREST)
    material = pyrender.MetallicRoughnessMaterial(
        baseColorTexture=texture, roughnessFactor=look.roughness, metallicFactor=look.metallic
    )
    positions, normals, coordinates, faces = corners_of(mesh, uv)
    if not is_closed(mesh):  # both sides of a sheet can be seen, each with a normal of its own
        faces = np.concatenate([faces, faces[:, ::-1] + np.int32(len(positions))])
        positions, coordinates = np.tile(positions, (2, 1)), np.tile(coordinates, (2, 1))
        normals = np.concatenate([normals, -normals])
    corners = {"positions": positions, "normals": normals, "texcoord_0": coordinates, "indices": faces}
    return pyrender.Mesh([pyrender.Primitive(**corners, material=material, mode=GLTF.TRIANGLES)])


def _palette(mesh: Mesh) -> tuple[Uint8, Float32]:
    """A mesh's colours as an image of one texel each, and coordinates (F, 3, 2) of each face's own texel."""
    colors = np.full((len(mesh.faces), 3), GREY, np.uint8) if mesh.face_colors is None else mesh.face_colors
    keys, which = np.unique(colors.astype(np.int32) @ np.array([65536, 256, 1]), return_inverse=True)
    width, height = min(len(keys), _PALETTE_WIDTH), -(-len(keys) // _PALETTE_WIDTH)
    image = np.zeros((height * width, 3), np.uint8)
    image[: len(keys)] = np.stack([keys >> 16, keys >> 8 & 255, keys & 255], axis=1)
    row, column = np.divmod(which, width)
    uv = np.stack([(column + 0.5) / width, 1.0 - (row + 0.5) / height], axis=1).astype(np.float32)
    return image.reshape(height, width, 3), np.repeat(uv[:, None], 3, axis=1)
