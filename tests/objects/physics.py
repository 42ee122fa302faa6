"""Put an object on a plane in MuJoCo, for tests."""

import mujoco
import numpy as np

from simtrack.objects import ObjectModel


def stand_on_plane(model: ObjectModel, seconds: float = 1.0, drop: float = 0.002) -> tuple[np.ndarray, np.ndarray]:
    """Drop the object's collision parts from just above a plane; returns its (3,) position and (3, 3) rotation."""
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[1, 1, 0.1], friction=[model.friction, 0.005, 1e-4])
    body = spec.worldbody.add_body(name="object", pos=[0, 0, 0.5 * model.extents[2] + drop])
    body.add_freejoint()
    body.explicitinertial = True
    body.mass, body.ipos = model.mass, model.centre_of_mass
    inertia = model.inertia
    body.fullinertia = [*np.diag(inertia), inertia[0, 1], inertia[0, 2], inertia[1, 2]]
    for k, part in enumerate(model.collision):
        spec.add_mesh(name=f"part{k}", uservert=part.vertices.ravel(), userface=part.faces.ravel())
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"part{k}", friction=[model.friction, 0.005, 1e-4])
    world = spec.compile()
    data = mujoco.MjData(world)
    for _ in range(round(seconds / world.opt.timestep)):
        mujoco.mj_step(world, data)
    return data.body("object").xpos.copy(), data.body("object").xmat.reshape(3, 3).copy()
