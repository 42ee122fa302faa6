"""Images of the simulated world: MuJoCo's OpenGL renderer, and a ray renderer that needs no OpenGL. They agree."""

import os
import warnings
from typing import TYPE_CHECKING, Protocol, runtime_checkable

import numpy as np

from simtrack.contracts import Bool, CameraIntrinsics, Float32, Float64, Int32, Uint8
from simtrack.errors import InvalidValueError, RenderingError
from simtrack.geometry.transforms import transform
from simtrack.raycast import RayBundle, RayHits
from simtrack.simulation.composer import COLLISION, COLOR_ONLY, DEPTH_ONLY, SHOWN
from simtrack.simulation.world import SENSOR_BODIES, World
from simtrack.simulation.world_rays import WorldRays

if TYPE_CHECKING:
    import mujoco
    from mujoco.egl import GLContext

RENDERERS = ("mujoco", "embree")
NEAR = 0.03
"""Metres from the eye within which rays hit nothing, as in MuJoCo, so that both show the same."""
BACKGROUND = (0.62, 0.72, 0.82)
"""Colour of nothing."""


@runtime_checkable
class Renderer(Protocol):
    """Renders what the robot's camera sees in the state that `data` holds (body poses must be up to date)."""

    name: str
    """One of `RENDERERS`."""

    def depth(self, data: "mujoco.MjData") -> Float32:
        """(H, W), metres along the optical axis, 0 = nothing within the far plane."""
        ...

    def rgb(self, data: "mujoco.MjData") -> Uint8:
        """(H, W, 3)."""
        ...

    def ids(self, data: "mujoco.MjData") -> Int32:
        """(H, W), index into `World.names`, -1 = nothing."""
        ...

    def close(self) -> None:
        """Release what it holds; may be called twice."""
        ...


def make_renderer(name: str, world: World, rays: WorldRays, intrinsics: CameraIntrinsics, far: float) -> Renderer:
    """The renderer called `name`; without EGL one clear warning and the ray renderer.

    Args:
        name: one of `RENDERERS`.
        world: what to render.
        rays: the same as a ray scene.
        intrinsics: of the robot's camera.
        far: metres beyond which depth and id images show nothing.

    Raises:
        InvalidValueError: unknown name.
    """
    if name not in RENDERERS:
        raise InvalidValueError("renderer", name, " or ".join(RENDERERS))
    if name == "mujoco":
        try:
            return MujocoRenderer(world, intrinsics, far)
        except RenderingError as error:
            message = f"{error} Rendering with rays (--renderer embree) instead; RGB images have no shading detail."
            warnings.warn(message, RuntimeWarning, stacklevel=2)
    return EmbreeRenderer(world, rays, intrinsics, far)


class MujocoRenderer:
    """MuJoCo's classic renderer in an EGL context of its own, made on first need."""

    name = "mujoco"

    def __init__(self, world: World, intrinsics: CameraIntrinsics, far: float) -> None:
        """Create the renderer.

        Raises:
            RenderingError: there is no working EGL.
            InvalidValueError: the intrinsics are not those of a centred camera with square pixels.
        """
        centred = (intrinsics.cx, intrinsics.cy) == ((intrinsics.width - 1) / 2, (intrinsics.height - 1) / 2)
        if not centred or intrinsics.fx != intrinsics.fy:
            raise InvalidValueError("intrinsics", intrinsics, "cx = (width - 1) / 2, cy = (height - 1) / 2, fx = fy")
        self._gl = gl_context(intrinsics)
        self._context = gl_resources(world.model)
        import mujoco

        self._model, self._far = world.model, far
        self._size = (intrinsics.height, intrinsics.width)
        self._rect = mujoco.MjrRect(0, 0, intrinsics.width, intrinsics.height)
        self._scene = mujoco.MjvScene(world.model, maxgeom=world.model.ngeom + 16)
        self._camera = mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self._camera.fixedcamid = world.model.camera("camera").id
        self._half = np.array([intrinsics.width, intrinsics.height]) / (2 * intrinsics.fx)
        self._owners = np.append(world.geom_owners, np.int32(-1))
        self._color = np.empty((*self._size, 3), np.uint8)
        self._buffer = np.empty(self._size, np.float32)

    def depth(self, data: "mujoco.MjData") -> Float32:
        """See `Renderer`."""
        self._draw(data, (SHOWN, DEPTH_ONLY), self._far, segment=True, color=False, depth=True)
        return self._metres()

    def rgb(self, data: "mujoco.MjData") -> Uint8:
        """See `Renderer`."""
        self._draw(data, (SHOWN, COLOR_ONLY), np.inf, segment=False, color=True, depth=False)
        return np.ascontiguousarray(self._color[::-1])

    def ids(self, data: "mujoco.MjData") -> Int32:
        """See `Renderer`; from MuJoCo's own segmentation pass."""
        self._draw(data, (SHOWN, DEPTH_ONLY), self._far, segment=True, color=True, depth=False)
        code = self._color[::-1].astype(np.int32) @ np.array([1, 1 << 8, 1 << 16], np.int32)
        geom_of_code = np.full(self._scene.ngeom + 1, self._model.ngeom, np.int64)
        for k in range(self._scene.ngeom):
            shape = self._scene.geoms[k]
            geom_of_code[shape.segid + 1] = shape.objid
        return self._owners[geom_of_code[code]]

    def _draw(
        self, data: "mujoco.MjData", groups: tuple[int, int], far: float, *, segment: bool, color: bool, depth: bool
    ) -> None:
        import mujoco

        if self._context is None:
            raise RenderingError("the renderer is closed")
        mujoco.mj_camlight(self._model, data)
        options = mujoco.MjvOption()
        options.geomgroup[:] = 0
        options.geomgroup[list(groups)] = 1
        options.sitegroup[:] = 0
        kept = self._model.geom_group.copy()
        # Vertices are what costs under a software rasteriser: what cannot be in the image is not handed to it.
        self._model.geom_group[~in_view(self._model, data, self._camera.fixedcamid, self._half, far)] = COLLISION
        try:
            category = mujoco.mjtCatBit.mjCAT_ALL
            mujoco.mjv_updateScene(self._model, data, options, None, self._camera, category, self._scene)
        finally:
            self._model.geom_group[:] = kept
        flags = self._scene.flags
        flags[:] = 0  # no shadows, no reflections, both sides of every face as rays see them
        if segment:
            flags[mujoco.mjtRndFlag.mjRND_SEGMENT] = 1
            flags[mujoco.mjtRndFlag.mjRND_IDCOLOR] = 1
        self._gl.make_current()
        mujoco.mjr_render(self._rect, self._scene, self._context)
        mujoco.mjr_readPixels(
            self._color if color else None, self._buffer if depth else None, self._rect, self._context
        )

    def _metres(self) -> Float32:
        """Undo the projection (reversed z in 0..1, far = 0) in float64, top row first."""
        near, far = np.float32(self._model.vis.map.znear), np.float32(self._model.vis.map.zfar)
        scale, offset = float(near) * float(far), float(near)
        out = self._buffer[::-1].astype(np.float64)
        nothing = out <= 0.0
        out *= float(far) - offset
        out += offset
        np.divide(scale, out, out=out)
        out[nothing | (out > self._far)] = 0.0
        return out.astype(np.float32)

    def close(self) -> None:
        """See `Renderer`."""
        if self._context is not None:
            self._gl.make_current()
            self._context.free()
            self._context = None
            self._gl.free()


def gl_context(intrinsics: CameraIntrinsics) -> "GLContext":
    """A current EGL context for images of that size; raises RenderingError if there is no working EGL."""
    os.environ.setdefault("MUJOCO_GL", "egl")
    try:
        from mujoco.egl import GLContext

        gl = GLContext(intrinsics.width, intrinsics.height)
    except Exception as error:  # PyOpenGL raises what it likes: AttributeError, ImportError, EGLError, RuntimeError
        needed = "it takes libEGL and a driver such as Mesa's (Debian: apt install libegl1 libgl1-mesa-dri)"
        raise RenderingError(
            f"OpenGL cannot be used without a display here: {needed}. EGL says {error!r:.120}."
        ) from error
    gl.make_current()
    return gl


def gl_resources(model: "mujoco.MjModel") -> "mujoco.MjrContext":
    """MuJoCo's resources for a model in the current OpenGL context, for drawing off screen."""
    import mujoco

    context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
    mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, context)
    context.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR
    return context


def in_view(model: "mujoco.MjModel", data: "mujoco.MjData", camera: int, half: Float64, far: float) -> Bool:
    """(ngeom,), whether the bounding sphere of a geom reaches into the view of a camera.

    `half` (2,) are the tangents of half the angles of view, `far` is in metres along the optical axis.
    """
    local = (data.geom_xpos - data.cam_xpos[camera]) @ data.cam_xmat[camera].reshape(3, 3)
    reach = np.where(model.geom_rbound > 0, model.geom_rbound, np.inf)
    ahead, sides = -local[:, 2], np.abs(local[:, :2])
    outside = (sides - ahead[:, None] * half) / np.sqrt(1.0 + half**2)
    return (ahead > -reach) & (ahead < far + reach) & (outside < reach[:, None]).all(axis=1)


def ray_image(
    rays: WorldRays, bundle: RayBundle, T_map_camera: Float64, shape: tuple[int, int], out: RayHits | None = None
) -> Uint8:
    """(H, W, 3) colour image of the world as `rays` has it: face colours under sun and headlight, without shadows.

    Args:
        rays: the world, moved to the moment.
        bundle: rays through the pixel centres.
        T_map_camera: (4, 4), optical frame.
        shape: (H, W).
        out: hits of an earlier image, to be overwritten.
    """
    return shaded(
        rays, bundle, T_map_camera, shape, rays.scene.cast(bundle, T_map_camera, np.inf, min_distance=NEAR, out=out)
    )


def shaded(rays: WorldRays, bundle: RayBundle, T_map_camera: Float64, shape: tuple[int, int], hits: RayHits) -> Uint8:
    """As `ray_image`, of rays that have been cast."""
    sun = np.array([0.25, 0.35, -1.0]) / np.linalg.norm([0.25, 0.35, -1.0])
    view = bundle.directions @ T_map_camera[:3, :3].T.astype(np.float32)
    view /= np.linalg.norm(view, axis=1, keepdims=True)
    head = np.abs(np.einsum("ij,ij->i", hits.normals, view))
    light = 0.38 + 0.24 * head + 0.42 * np.maximum(-(hits.normals @ sun.astype(np.float32)), 0.0)
    image = np.minimum(rays.colors(hits) * light[:, None], 1.0)
    image[~hits.hit] = BACKGROUND
    return np.round(255.0 * image).astype(np.uint8).reshape(*shape, 3)


class EmbreeRenderer:
    """Rays through every pixel centre: depth and ids exact, RGB from face colours with diffuse light."""

    name = "embree"

    def __init__(self, world: World, rays: WorldRays, intrinsics: CameraIntrinsics, far: float) -> None:
        self._rays, self._far = rays, far
        self._body = world.model.body(SENSOR_BODIES["camera"]).id
        self._bundle = RayBundle.from_camera(intrinsics)
        self._shape = (intrinsics.height, intrinsics.width)
        self._hits = RayHits.empty(len(self._bundle))
        self._moment = b""
        """What `_hits` are of: where everything was, the camera last."""

    def depth(self, data: "mujoco.MjData") -> Float32:
        """See `Renderer`."""
        distances = self._cast(data)[0].distances
        return np.where(distances <= self._far, distances, np.float32(0.0)).reshape(self._shape)

    def ids(self, data: "mujoco.MjData") -> Int32:
        """See `Renderer`."""
        hits, _ = self._cast(data)
        return np.where(hits.distances <= self._far, self._rays.ids(hits), -1).astype(np.int32).reshape(self._shape)

    def rgb(self, data: "mujoco.MjData") -> Uint8:
        """See `Renderer`."""
        hits, T_map_camera = self._cast(data)
        return shaded(self._rays, self._bundle, T_map_camera, self._shape, hits)

    @property
    def hits(self) -> RayHits:
        """What the pixels of the last image met, at any distance; overwritten by the next one."""
        return self._hits

    def _cast(self, data: "mujoco.MjData") -> tuple[RayHits, Float64]:
        """What the pixels meet, at any distance, and the camera's pose; images of one moment share one cast."""
        T_map_camera = transform(data.xmat[self._body].reshape(3, 3), data.xpos[self._body])
        poses = self._rays.poses(data)
        moment = poses.tobytes() + T_map_camera.tobytes()
        if moment != self._moment:
            self._rays.place(data, poses)
            self._rays.scene.cast(self._bundle, T_map_camera, min_distance=NEAR, out=self._hits)
            self._moment = moment
        return self._hits, T_map_camera

    def close(self) -> None:
        """See `Renderer`; the ray scene belongs to whoever made it."""
