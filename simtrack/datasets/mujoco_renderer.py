"""Colour images of generated scenes by MuJoCo's OpenGL renderer."""

from typing import TYPE_CHECKING

import numpy as np

from simtrack.contracts import CameraIntrinsics, Float64, Uint8
from simtrack.datasets.content import Content, Light, Material, Shape
from simtrack.datasets.corners import corners_of
from simtrack.errors import InvalidValueError, RenderingError
from simtrack.geometry.meshes import Mesh
from simtrack.geometry.transforms import quaternion_from_rotation
from simtrack.simulation.rendering import gl_context, gl_resources, in_view

if TYPE_CHECKING:
    import mujoco

NEAR, FAR = 0.03, 80.0
"""Clip planes, metres."""
CAMERA = "camera"
_HIDDEN = 5
"""A geom group that is not drawn."""


class MujocoColorRenderer:
    """A `ColorRenderer`. Each scene is compiled anew, so that nothing of the one before can show.

    Compiling and uploading take about 0.2 s of CPU time a scene; a scene has many views.
    """

    def __init__(self, intrinsics: CameraIntrinsics, samples: int = 1) -> None:
        """Create the renderer; OpenGL is started with the first scene.

        Args:
            intrinsics: of the camera.
            samples: of multisampling, a pixel; 1 = off.

        Raises:
            InvalidValueError: the intrinsics are not those of a centred camera with square pixels.
        """
        centred = (intrinsics.cx, intrinsics.cy) == ((intrinsics.width - 1) / 2, (intrinsics.height - 1) / 2)
        if not centred or intrinsics.fx != intrinsics.fy:
            raise InvalidValueError("intrinsics", intrinsics, "cx = (width - 1) / 2, cy = (height - 1) / 2, fx = fy")
        self._intrinsics, self._samples = intrinsics, samples
        self._half = np.array([intrinsics.width, intrinsics.height]) / (2 * intrinsics.fx)
        self._image = np.empty((intrinsics.height, intrinsics.width, 3), np.uint8)
        self._gl = None
        self._context: mujoco.MjrContext | None = None

    def begin(self, content: Content) -> None:
        """See `ColorRenderer`. Raises RenderingError where there is no working EGL."""
        import mujoco

        model = _compile(content, self._intrinsics, self._samples)
        if self._gl is None:
            self._gl = gl_context(self._intrinsics)
        self._gl.make_current()
        if self._context is not None:
            self._context.free()
        self._context = gl_resources(model)
        self._model, self._data = model, mujoco.MjData(model)
        self._scene = mujoco.MjvScene(model, maxgeom=model.ngeom + 16)
        self._options = mujoco.MjvOption()
        self._options.geomgroup[:] = 0
        self._options.geomgroup[0] = 1
        self._camera = mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self._camera.fixedcamid = model.camera(CAMERA).id

    def render(self, T_map_camera: Float64) -> Uint8:
        """See `ColorRenderer`. Raises RenderingError before the first scene and after the end."""
        import mujoco

        if self._gl is None or self._context is None:
            raise RenderingError("the renderer has no scene: call begin() first, and not after close()")
        self._data.mocap_pos[0] = T_map_camera[:3, 3]
        self._data.mocap_quat[0] = quaternion_from_rotation(T_map_camera[:3, :3])
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)
        # Vertices are what costs under a software rasteriser: what cannot be in the image is not handed to it.
        seen = in_view(self._model, self._data, self._camera.fixedcamid, self._half, np.inf)
        self._model.geom_group[:] = np.where(seen, 0, _HIDDEN)
        everything = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(self._model, self._data, self._options, None, self._camera, everything, self._scene)
        self._scene.flags[:] = 0
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SKYBOX] = 1
        self._gl.make_current()
        rectangle = mujoco.MjrRect(0, 0, self._intrinsics.width, self._intrinsics.height)
        mujoco.mjr_render(rectangle, self._scene, self._context)
        mujoco.mjr_readPixels(self._image, None, rectangle, self._context)
        return np.ascontiguousarray(self._image[::-1])

    def close(self) -> None:
        """See `ColorRenderer`."""
        if self._gl is not None:
            self._gl.make_current()
            if self._context is not None:
                self._context.free()
                self._context = None
            self._gl.free()
            self._gl = None


def _compile(content: Content, intrinsics: CameraIntrinsics, samples: int) -> "mujoco.MjModel":
    """A model of what is seen; nothing in it moves but the camera."""
    import mujoco

    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.compiler.usethread = False  # see `simtrack.datasets.local.thread_limits`
    visual = spec.visual
    visual.global_.offwidth, visual.global_.offheight = intrinsics.width, intrinsics.height
    visual.quality.offsamples = 0 if samples == 1 else samples
    visual.quality.shadowsize = 0
    spec.stat.extent = 1.0  # so that the clip planes are metres
    visual.map.znear, visual.map.zfar = NEAR, FAR
    visual.headlight.ambient, visual.headlight.diffuse = content.ambient, [0.0] * 3
    visual.headlight.specular = [0.0] * 3
    eye = spec.worldbody.add_body(name=CAMERA, mocap=True)
    # MuJoCo's cameras look along -z with y up: half a turn about x from the optical frame.
    camera = eye.add_camera(name=CAMERA, quat=[0.0, 1.0, 0.0, 0.0])
    camera.fovy = float(np.degrees(2.0 * np.arctan(intrinsics.height / (2.0 * intrinsics.fy))))
    for light in content.lights:
        _add_light(spec, light)
    sky = spec.add_texture(name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, width=4, height=4)
    sky.builtin = mujoco.mjtBuiltin.mjBUILTIN_FLAT
    sky.rgb1 = sky.rgb2 = content.background
    looks = _Looks(spec)
    for number, shape in enumerate(content.shapes):
        _add_shape(spec, looks, number, shape)
    return spec.compile()


def _add_light(spec: "mujoco.MjSpec", light: Light) -> None:
    import mujoco

    added = spec.worldbody.add_light(
        pos=light.position, dir=light.direction, diffuse=light.color, specular=light.color, castshadow=False
    )
    if light.directional:
        added.type = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    else:
        # Its classic renderer leaves point lights out; a spot light that shines everywhere is one.
        added.type = mujoco.mjtLightType.mjLIGHT_SPOT
        added.cutoff, added.exponent = 180.0, 0.0
        added.attenuation = [0.0, 0.0, 1.0 / light.reach**2]


class _Looks:
    """Materials of a spec, each added once."""

    def __init__(self, spec: "mujoco.MjSpec") -> None:
        self._spec = spec
        self._names: dict[int, str] = {}

    def textured(self, material: Material) -> str:
        """Name of a material with a texture."""
        if id(material) not in self._names:
            assert material.texture is not None
            self._names[id(material)] = self._add(material, material.texture)
        return self._names[id(material)]

    def painted(self, material: Material, colors: Uint8) -> str:
        """Name of a material whose texture is a row of colours (K, 3)."""
        return self._add(material, colors[None])

    def _add(self, material: Material, image: Uint8) -> str:
        import mujoco

        name = f"look{len(self._spec.materials)}"
        texture = self._spec.add_texture(
            name=name, type=mujoco.mjtTexture.mjTEXTURE_2D, width=image.shape[1], height=image.shape[0], nchannel=3
        )
        texture.data = image.tobytes()
        # MuJoCo knows Phong's model: what reflects less sharply reflects less strongly too.
        gloss = 1.0 - material.roughness
        added = self._spec.add_material(
            name=name, specular=0.1 + 0.6 * gloss * (0.5 + 0.5 * material.metallic), shininess=0.05 + 0.8 * gloss**2
        )
        added.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name
        return name


def _add_shape(spec: "mujoco.MjSpec", looks: _Looks, number: int, shape: Shape) -> None:
    """Add a mesh that is fixed in the world: scale and all go into its vertices."""
    import mujoco

    T = shape.T_map_mesh
    scale = np.linalg.norm(T[:3, :3], axis=0)
    mesh = Mesh(shape.mesh.vertices * scale, shape.mesh.faces)
    if shape.uv is not None and shape.material.texture is not None:
        look, uv = looks.textured(shape.material), shape.uv
    else:
        palette, which = _palette(shape.mesh)
        look = looks.painted(shape.material, palette)
        # Every face samples one texel, so that colours are exact and nothing is filtered.
        u = ((which + 0.5) / len(palette)).astype(np.float32)
        uv = np.full((len(mesh.faces), 3, 2), 0.5, np.float32)
        uv[:, :, 0] = u[:, None]
    # Left to itself, MuJoCo shades boxes as if they were round.
    vertices, normals, texcoords, faces = corners_of(mesh, uv)
    asset = spec.add_mesh(name=f"shape{number}")
    asset.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL  # open sheets have no volume
    asset.uservert, asset.userface = vertices.ravel(), faces.ravel()
    asset.usernormal, asset.usertexcoord = normals.ravel(), texcoords.ravel()
    spec.worldbody.add_geom(
        name=f"shape{number}", type=mujoco.mjtGeom.mjGEOM_MESH, meshname=asset.name, material=look, mass=0.0,
        contype=0, conaffinity=0, pos=T[:3, 3], quat=quaternion_from_rotation(T[:3, :3] / scale),
    )  # fmt: skip


def _palette(mesh: Mesh) -> tuple[Uint8, np.ndarray]:
    """(K, 3) colours of a mesh, and (F,) which of them a face has."""
    if mesh.face_colors is None:
        return np.full((1, 3), 200, np.uint8), np.zeros(len(mesh.faces), np.int64)
    keys, which = np.unique(mesh.face_colors.astype(np.int32) @ np.array([65536, 256, 1]), return_inverse=True)
    return np.stack([keys >> 16, keys >> 8 & 255, keys & 255], axis=1).astype(np.uint8), which
