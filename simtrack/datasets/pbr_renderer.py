"""Colour images with physically based materials, by pyrender: metallic-roughness surfaces under several lights.

pyrender's own off-screen renderer ends EGL for the whole process when it is deleted, and with it MuJoCo's renderers.
So its drawing is used here in a context that is made, and given back, as MuJoCo makes its own.
"""

from typing import TYPE_CHECKING

import numpy as np

from simtrack.contracts import CameraIntrinsics, Float32, Float64, Uint8
from simtrack.datasets.content import Content
from simtrack.errors import RenderingError
from simtrack.simulation.rendering import gl_context

if TYPE_CHECKING:
    from mujoco.egl import GLContext

    from simtrack.datasets.pbr_drawing import Drawing


class PbrRenderer:
    """A `ColorRenderer` of glTF's metallic-roughness materials.

    Light adds up in linear space and is encoded with a gamma of 2.2; a white matt surface that faces a light of colour
    c, 0 to 1, is as bright as c. Lights cast no shadows (`simtrack.datasets.effects` adds them).
    """

    def __init__(self, intrinsics: CameraIntrinsics, samples: int = 4) -> None:
        """Create the renderer; OpenGL is started with the first scene.

        Args:
            intrinsics: of the camera.
            samples: a pixel, to smooth edges; 1 = at its centre alone. A driver may know fewer (llvmpipe: 1 and 4).
        """
        self._intrinsics, self._samples = intrinsics, samples
        self._gl: GLContext | None = None
        self._drawing: Drawing | None = None

    def begin(self, content: Content) -> None:
        """See `ColorRenderer`. Raises RenderingError where there is no working EGL."""
        context = self._gl = self._gl or gl_context(self._intrinsics)
        context.make_current()
        from simtrack.datasets.pbr_drawing import Drawing  # OpenGL has to be told of EGL first

        if self._drawing is None:
            self._drawing = Drawing(self._intrinsics, self._samples)
        self._drawing.begin(content)

    def render(self, T_map_camera: Float64) -> Uint8:
        """See `ColorRenderer`. Raises RenderingError before the first scene and after the end."""
        return self._draw(T_map_camera, depth=False)[0]

    def depth(self, T_map_camera: Float64) -> Float32:
        """(H, W), metres along the optical axis, 0 = nothing: the rasteriser's own, to check it against rays.

        It is that of pixel centres if there is one sample a pixel.
        """
        return self._draw(T_map_camera, depth=True)[1]

    def _draw(self, T_map_camera: Float64, depth: bool) -> tuple[Uint8, Float32]:
        if self._gl is None or self._drawing is None:
            raise RenderingError("the renderer has no scene: call begin() first, and not after close()")
        self._gl.make_current()
        color, metres = self._drawing.draw(np.asarray(T_map_camera, float), depth)
        return np.ascontiguousarray(color), np.ascontiguousarray(metres)

    def close(self) -> None:
        """See `ColorRenderer`."""
        if self._gl is not None:
            self._gl.make_current()
            if self._drawing is not None:
                self._drawing.delete()
                self._drawing = None
            self._gl.free()
            self._gl = None
