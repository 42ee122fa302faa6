"""A planned room as a MuJoCo model that comes to rest, and what is then true of it: contacts, poses, support."""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from simtrack.contracts import Int32
from simtrack.geometry.meshes import Mesh, box_mesh, concatenate, transformed
from simtrack.geometry.transforms import inverse, quaternion_from_rotation, transform
from simtrack.objects.cad.model import CadPart
from simtrack.simulation.building.rooms.plan import PlacedModel, RoomKind, RoomPlan, plan_room
from simtrack.simulation.contacts import contact_pairs

if TYPE_CHECKING:
    import mujoco

SETTLE_SECONDS = 3.0
TIMESTEP = 0.002
FLOOR, WALLS = "floor", ("wall-south", "wall-east", "wall-north", "wall-west")
"""Names of the layout entities."""
MAX_DRIFT = 0.05
"""Metres that a thing may move while it settles; what moves farther, or tilts, was put badly and is taken out."""
MAX_TILT = 0.05
"""Radians."""


@dataclass(frozen=True, slots=True, eq=False)
class RoomEntity:
    """One entity of a settled room."""

    name: str
    semantic_class: str
    mesh: Mesh
    """The whole surface, map frame."""
    placed: PlacedModel | None
    """Pose and joint positions of things; None for the floor and the walls."""


@dataclass(frozen=True, slots=True, eq=False)
class SettledRoom:
    """A room at rest and the truth about it."""

    plan: RoomPlan
    entities: tuple[RoomEntity, ...]
    """Floor, walls, then things in the order of the plan."""
    supports: tuple[tuple[str, str], ...]
    """(carried, carrier) by name: direct contacts from above."""
    touches: tuple[tuple[str, str], ...]
    """Pairs in contact anyhow."""
    dropped: tuple[str, ...]
    """Things of the plan that did not come to rest where they were put."""

    def entity(self, name: str) -> RoomEntity:
        """The entity of that name; raises KeyError."""
        return {entity.name: entity for entity in self.entities}[name]


def settled_room(seed: int, kind: RoomKind | None = None) -> SettledRoom:
    """The room of a seed after it has come to rest; things that do not are taken out and the rest settles again."""
    plan, dropped = plan_room(seed, kind), []
    while True:
        model, data = compiled(plan)
        placed, unstable = _settle(plan, model, data)
        if not unstable:
            return _truth(replace(plan, placed=placed), model, data, tuple(dropped))
        dropped += unstable
        placed = tuple(thing for thing in plan.placed if thing.name not in unstable)
        cleats = tuple(cleat for cleat in plan.cleats if cleat.thing not in unstable)
        plan = replace(plan, placed=placed, cleats=cleats)


def compiled(plan: RoomPlan) -> "tuple[mujoco.MjModel, mujoco.MjData]":
    """The room as a model: the shell fixed, every thing a free body with its joints at their positions."""
    import mujoco

    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.option.timestep = TIMESTEP
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 5.0
    low, high = plan.room.polygon.min(axis=0), plan.room.polygon.max(axis=0)
    middle, half = (low + high) / 2, (high - low) / 2
    slab = mujoco.mjtGeom.mjGEOM_BOX
    spec.worldbody.add_geom(
        name=FLOOR, type=slab, pos=[*middle, -0.05], size=[*half + 0.2, 0.05], friction=[0.7, 0.005, 1e-4]
    )
    for name, (x, y) in zip(WALLS, ((0, -1), (1, 0), (0, 1), (-1, 0)), strict=True):
        centre = middle + (half + 0.1) * [x, y]
        size = [0.1 if x else half[0] + 0.2, 0.1 if y else half[1] + 0.2, plan.room.height / 2]
        spec.worldbody.add_geom(name=name, type=slab, pos=[*centre, plan.room.height / 2], size=size)
    for cleat in plan.cleats:
        for k, (T, extents) in enumerate(cleat.boxes):
            quat = quaternion_from_rotation(T[:3, :3])
            name = f"{cleat.wall}/{cleat.thing}#{k}"
            spec.worldbody.add_geom(name=name, type=slab, pos=T[:3, 3], quat=quat, size=extents / 2)
    for thing in plan.placed:
        add_model(spec, thing)
    model = spec.compile()
    data = mujoco.MjData(model)
    for thing in plan.placed:
        for joint, position in thing.positions.items():
            data.joint(f"{thing.name}/{joint}").qpos[0] = position
    mujoco.mj_forward(model, data)
    return model, data


def add_model(spec: "mujoco.MjSpec", thing: PlacedModel) -> None:
    """Add a thing as a free body called by its name; parts and joints are called ``NAME/PART`` and ``NAME/JOINT``."""
    import mujoco

    model = thing.model
    base = spec.worldbody.add_body(
        name=thing.name, pos=thing.T_map_model[:3, 3], quat=quaternion_from_rotation(thing.T_map_model[:3, :3])
    )
    base.add_freejoint(name=f"{thing.name}/free")
    bodies = {model.parts[0].name: base}
    _fill(spec, base, thing.name, model.parts[0])
    for joint in model.joints:
        body = bodies[joint.parent].add_body(name=f"{thing.name}/{joint.child}")
        kind = mujoco.mjtJoint.mjJNT_SLIDE if joint.kind == "prismatic" else mujoco.mjtJoint.mjJNT_HINGE
        body.add_joint(
            name=f"{thing.name}/{joint.name}", type=kind, pos=joint.anchor, axis=joint.axis,
            limited=joint.kind != "continuous", range=[joint.lower, joint.upper],
            frictionloss=joint.friction, damping=joint.damping, armature=0.001,
        )  # fmt: skip
        bodies[joint.child] = body
        _fill(spec, body, thing.name, model.part(joint.child))


def _fill(spec: "mujoco.MjSpec", body: "mujoco.MjsBody", name: str, part: CadPart) -> None:
    import mujoco

    body.explicitinertial = True
    body.mass, body.ipos, inertia = part.mass, part.centre_of_mass, part.inertia
    body.fullinertia = [*np.diag(inertia), inertia[0, 1], inertia[0, 2], inertia[1, 2]]
    for k, convex in enumerate(part.convex):
        asset = spec.add_mesh(name=f"{name}/{part.name}#{k}")
        asset.uservert, asset.userface = convex.vertices.ravel(), convex.faces.ravel()
        body.add_geom(
            name=f"{name}/{part.name}#{k}", type=mujoco.mjtGeom.mjGEOM_MESH, meshname=asset.name, mass=0.0,
            friction=[part.friction, 0.005, 2e-4], condim=4,
        )  # fmt: skip


def _settle(
    plan: RoomPlan, model: "mujoco.MjModel", data: "mujoco.MjData"
) -> tuple[tuple[PlacedModel, ...], list[str]]:
    """Step until everything rests; the things where they are now, and those that moved or tilted."""
    import mujoco

    mujoco.mj_step(model, data, nstep=round(SETTLE_SECONDS / TIMESTEP))
    mujoco.mj_forward(model, data)
    placed, unstable = [], []
    for thing in plan.placed:
        body = data.body(thing.name)
        T = transform(body.xmat.reshape(3, 3).copy(), body.xpos.copy())
        moved = inverse(thing.T_map_model) @ T
        tilt = float(np.arccos(np.clip(T[:3, 2] @ thing.T_map_model[:3, 2], -1.0, 1.0)))
        if not (np.linalg.norm(moved[:3, 3]) < MAX_DRIFT and tilt < MAX_TILT):
            unstable.append(thing.name)
        positions = {
            joint.name: float(data.joint(f"{thing.name}/{joint.name}").qpos[0]) for joint in thing.model.joints
        }
        placed.append(replace(thing, T_map_model=T, positions=positions))
    return tuple(placed), unstable


def geom_owners(plan: RoomPlan, model: "mujoco.MjModel") -> tuple[list[str], Int32]:
    """Names of all entities, and (ngeom,) the number of the entity that each geom belongs to."""
    names = [FLOOR, *WALLS, *(thing.name for thing in plan.placed)]
    number = {name: k for k, name in enumerate(names)}
    owners = [number[model.geom(k).name.partition("/")[0]] for k in range(model.ngeom)]
    return names, np.array(owners, np.int32)


def _truth(plan: RoomPlan, model: "mujoco.MjModel", data: "mujoco.MjData", dropped: tuple[str, ...]) -> SettledRoom:
    names, owners = geom_owners(plan, model)
    movable = np.arange(len(names)) > len(WALLS)
    supports, touches = contact_pairs(data, owners, movable)
    entities = [RoomEntity(name, name.partition("-")[0], _layout(plan, name), None) for name in names[: len(WALLS) + 1]]
    for thing in plan.placed:
        mesh = transformed(thing.model.mesh(thing.positions), thing.T_map_model)
        entities.append(RoomEntity(thing.name, thing.model.semantic_class, mesh, thing))
    return SettledRoom(
        plan=plan,
        entities=tuple(entities),
        supports=tuple((names[a], names[b]) for a, b in supports.tolist()),
        touches=tuple((names[a], names[b]) for a, b in touches.tolist()),
        dropped=dropped,
    )


def _layout(plan: RoomPlan, name: str) -> Mesh:
    """The sheets of the shell that belong to the floor or to one wall."""
    low, high = plan.room.polygon.min(axis=0), plan.room.polygon.max(axis=0)
    middle = (low + high) / 2
    chosen = []
    for part in plan.shell:
        mesh = transformed(part.mesh, part.T_map_part)
        if part.semantic_class == FLOOR or part.semantic_class == "ceiling":
            owner = part.semantic_class
        else:
            aside = (mesh.bounds.mean(axis=0)[:2] - middle) / (high - low)
            along_x = abs(aside[0]) > abs(aside[1])
            owner = WALLS[(1 if aside[0] > 0 else 3) if along_x else (2 if aside[1] > 0 else 0)]
        if owner == name:
            chosen.append(mesh)
    chosen += [transformed(box_mesh(size), T) for each in plan.cleats if each.wall == name for T, size in each.boxes]
    return concatenate(chosen)
