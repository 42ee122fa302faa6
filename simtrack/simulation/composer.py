"""Collects the visible meshes of a MuJoCo specification with their colours, which become one palette."""

from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np

from simtrack.contracts import Float64, Uint8
from simtrack.geometry.meshes import Mesh
from simtrack.geometry.transforms import quaternion_from_rotation

if TYPE_CHECKING:
    import mujoco

SHOWN, COLOR_ONLY, DEPTH_ONLY, COLLISION = 0, 1, 2, 3
"""Geom groups: seen always, in RGB images only, in depth and id images only, never."""

Kind: TypeAlias = Literal["static", "catalogue", "clutter", "actor", "robot"]


class Composer:
    """Collects meshes, colours and instances while a spec is being composed."""

    def __init__(self) -> None:
        import mujoco

        self.spec = mujoco.MjSpec()
        self.instances: list[tuple[str, Kind, str, Mesh, Float64]] = []
        self._meshes: dict[int, tuple[str, Mesh]] = {}
        self._colored: list[tuple[object, Mesh]] = []

    def mesh(self, name: str, mesh: Mesh, colored: bool = True) -> str:
        """Name of the asset that holds a mesh; the same mesh is stored once."""
        import mujoco

        if id(mesh) in self._meshes:
            return self._meshes[id(mesh)][0]
        asset = self.spec.add_mesh(name=name)
        asset.uservert = mesh.vertices.ravel()
        asset.userface = mesh.faces.ravel()
        # Open sheets have no volume; no inertia is taken from meshes anyway.
        asset.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
        self._meshes[id(mesh)] = (name, mesh)
        if colored and mesh.face_colors is not None:
            self._colored.append((asset, mesh))
        return name

    def show(self, body: "mujoco.MjsBody", asset: str, name: str, T: Float64, group: int = SHOWN) -> None:
        """Give a body a visible mesh that touches nothing."""
        import mujoco

        body.add_geom(
            name=name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=asset, material="palette", group=group, mass=0.0,
            contype=0, conaffinity=0, pos=T[:3, 3], quat=quaternion_from_rotation(T[:3, :3]),
        )  # fmt: skip

    def show_user_shape(self, body: "mujoco.MjsBody", name: str, mesh: Mesh, T: Float64) -> None:
        """Show a shape of the user's MJCF; it counts as furniture named after its body."""
        self.show(body, self.mesh(name, mesh), f"static/{name}", T)
        self.instances.append((name.rpartition("#")[0], "static", body.name, mesh, T))

    def show_own_shape(self, body: "mujoco.MjsBody", name: str, mesh: Mesh, T: Float64) -> None:
        """The same where the MJCF is the whole world: things have the names that they have there."""
        from simtrack.simulation.user_mjcf import PREFIX

        self.show(body, self.mesh(name, mesh), f"static/{name.removeprefix(PREFIX)}", T)
        self.instances.append((name.removeprefix(PREFIX).rpartition("#")[0], "static", body.name, mesh, T))

    def finish(self) -> "mujoco.MjModel":
        """Compile; every face samples one texel, so that colours are exact and no texture is ever filtered."""
        import mujoco

        used = [np.unique(_color_keys(mesh.face_colors), return_inverse=True) for _, mesh in self._colored]
        keys = np.unique(np.concatenate([*(own for own, _ in used), _color_keys(np.full((1, 3), 200, np.uint8))]))
        palette = np.stack([keys >> 16, keys >> 8 & 255, keys & 255], axis=1).astype(np.uint8)
        texture = self.spec.add_texture(
            name="palette", type=mujoco.mjtTexture.mjTEXTURE_2D, width=len(palette), height=1, nchannel=3
        )
        texture.data = palette.tobytes()
        material = self.spec.add_material(name="palette", specular=0.1, shininess=0.2)
        material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "palette"
        texcoords = np.stack([(np.arange(len(palette)) + 0.5) / len(palette), np.full(len(palette), 0.5)], axis=1)
        for (asset, _), (own, local) in zip(self._colored, used, strict=True):
            asset.usertexcoord = texcoords[np.searchsorted(keys, own)].ravel()  # type: ignore[attr-defined]
            asset.userfacetexcoord = np.repeat(local, 3).astype(np.int32)  # type: ignore[attr-defined]
        return self.spec.compile()


def _color_keys(colors: Uint8 | None) -> np.ndarray:
    """(F,) numbers that order colours (F, 3) as their channels do; single numbers are found faster than rows."""
    assert colors is not None
    return colors.astype(np.int32) @ np.array([65536, 256, 1], np.int32)
