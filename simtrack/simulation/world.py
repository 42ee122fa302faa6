"""From a scene file and a seed to a MuJoCo model: composed through MjSpec, never from XML strings."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np

from simtrack.contracts import Float64, Int32
from simtrack.errors import FileFormatError, InvalidValueError, UnknownNameError
from simtrack.geometry.kinematics import KinematicTree, Link
from simtrack.geometry.meshes import Mesh, area, painted
from simtrack.geometry.transforms import quaternion_from_rotation, transform
from simtrack.objects import ObjectModel, load_object
from simtrack.objects.tiago import CAMERA, GRIPPER, LIDAR, tiago
from simtrack.simulation import hand
from simtrack.simulation.building.parts import StaticWorld
from simtrack.simulation.composer import COLLISION, COLOR_ONLY, DEPTH_ONLY, Composer, Kind
from simtrack.simulation.placement import place_objects, start_pose
from simtrack.simulation.randomness import stream
from simtrack.simulation.robot import PREFIX as ROBOT
from simtrack.simulation.robot import RobotController, add_robot
from simtrack.simulation.scene_file import SceneFile

if TYPE_CHECKING:
    import mujoco

TIMESTEP_NS = 2_000_000
"""Physics step, nanoseconds."""

STATIC_BITS, OBJECT_BITS, ROBOT_BITS, HAND_BITS = (1, 0), (2, 15), (4, 1), (8, 0)
"""contype and conaffinity: objects touch everything, the robot touches furniture and objects but not itself."""


@dataclass(frozen=True, slots=True, eq=False)
class Instance:
    """One rigid visible thing: both renderers and all ray casts see exactly these."""

    name: str
    """Name of what it is a part of: ``relay``, ``robot``, ``workbench``."""
    kind: Kind
    body: int
    """MuJoCo body id, 0 = fixed in the world."""
    mesh: Mesh
    """Full resolution, coloured."""
    T_body_mesh: Float64
    """(4, 4)."""


@dataclass(eq=False)
class World:
    """A compiled world at time 0."""

    scene: SceneFile
    seed: int
    model: "mujoco.MjModel"
    data: "mujoco.MjData"
    static: StaticWorld
    robot: KinematicTree
    controller: RobotController
    objects: Mapping[str, ObjectModel]
    """Object name -> model, catalogue objects first, then clutter, in the scene file's order."""
    instances: tuple[Instance, ...]
    names: tuple[str, ...]
    """Names of all instances, each once; ids in images index it."""
    geom_owners: Int32
    """(ngeom,), index into `names` of what each MuJoCo geom, seen or touched, belongs to; -1 = nothing named."""
    bodies: Mapping[str, int] = field(default_factory=dict)
    """Name of each movable thing -> MuJoCo body id (``hand`` is the palm, ``robot`` the base)."""

    def is_catalogue(self, name: str) -> bool:
        """Whether an object of the scene is one that the tracker has a model of."""
        return name in self._catalogue

    @cached_property
    def _catalogue(self) -> frozenset[str]:
        return frozenset(thing.id for thing in self.scene.objects)


def build_world(
    scene: SceneFile,
    seed: int,
    fovy: float = 0.79,
    image_size: tuple[int, int] = (640, 480),
    sleep: bool = False,
) -> World:
    """Compose, compile and settle the world of a scene for one seed.

    Args:
        scene: the validated scene file.
        seed: of the run; places, building and start are drawn from it.
        fovy: vertical field of view of the robot's camera, radians.
        image_size: width and height of the largest image to be rendered.
        sleep: leave things that rest out of the physics until something touches them.

    Raises:
        FileFormatError: the scene names things that do not exist, has no room for them, or its MJCF is broken.
        UnknownNameError: an object that is not in the catalogue; lists those that are.
    """
    from simtrack.simulation.settling import settle

    static = build_static(scene, seed)
    models = _models(scene)
    start = start_pose(scene, static, stream(seed, "start"))
    poses = place_objects(scene, static, models, stream(seed, "placement"))
    robot = tiago()

    composer = Composer()
    _set_options(composer.spec, image_size, sleep)
    if scene.static.builder == "mjcf":
        from simtrack.simulation.mjcf_world import floor_height
        from simtrack.simulation.user_mjcf import attach

        attach(composer.spec, scene, composer.show_own_shape, without=models, lowered=floor_height(scene))
    else:
        _add_static(composer, static)
        if scene.mjcf_path is not None:
            from simtrack.simulation.user_mjcf import attach

            attach(composer.spec, scene, composer.show_user_shape)
    for name, model in models.items():
        trackable = any(thing.id == name for thing in scene.objects)
        _add_object(composer, name, model, poses[name], "catalogue" if trackable else "clutter")
    _add_robot(composer, robot, fovy)
    if scene.robot.suction:
        _add_suction(composer, models, static)
    if scene.hand is not None:
        _add_hand(composer, scene)
    world = _assembled(scene, seed, composer, static, robot, models)
    settle(world, poses, start)
    return world


def build_static(scene: SceneFile, seed: int) -> StaticWorld:
    """The building of a scene; raises FileFormatError for a configuration that its builder does not take."""
    building_seed = seed if scene.static.seed is None else scene.static.seed
    if scene.static.builder == "mjcf":
        from simtrack.simulation.mjcf_world import mjcf_building

        return mjcf_building(scene)
    if scene.static.builder == "room":
        from simtrack.simulation.building.rooms.static import RoomConfig, room_world

        return room_world(building_seed, configured(RoomConfig, scene.static.config, scene, "static.config"))
    rng = stream(building_seed, "building")
    if scene.static.builder == "lab_room":
        from simtrack.simulation.building.lab_room import LabRoomConfig, lab_room

        return lab_room(rng, configured(LabRoomConfig, scene.static.config, scene, "static.config"))
    from simtrack.simulation.building.office_floor import OfficeFloorConfig, office_floor

    return office_floor(rng, configured(OfficeFloorConfig, scene.static.config, scene, "static.config"))


class UserFile(Protocol):
    """A file that a user wrote."""

    @property
    def path(self) -> Path:
        """Where it was read from."""
        ...


def configured(config: type, values: Mapping[str, object], scene: UserFile, where: str, base: object = None):
    """A configuration dataclass from a user file's mapping; errors name the file, the field and what is allowed.

    `base` is an instance whose fields hold unless the mapping says otherwise.
    """
    from dataclasses import fields, is_dataclass, replace

    known = {f.name: f for f in fields(config)}
    if unknown := sorted(set(values) - set(known)):
        allowed = ", ".join(sorted(known))
        raise FileFormatError(scene.path, f"{where}.{unknown[0]}", f"unknown field; allowed: {allowed}")
    try:
        current = config() if base is None else base
        changes = {}
        for name, value in values.items():
            old = getattr(current, name)
            if is_dataclass(old) and isinstance(value, Mapping):
                changes[name] = configured(type(old), value, scene, f"{where}.{name}", old)
            else:
                changes[name] = tuple(value) if isinstance(value, list) else value
        return replace(current, **changes)  # type: ignore[type-var]
    except (InvalidValueError, TypeError, ValueError) as error:
        raise FileFormatError(scene.path, where, str(error)) from error


def _models(scene: SceneFile) -> dict[str, ObjectModel]:
    models: dict[str, ObjectModel] = {}
    for kind, things, trackable in (("objects", scene.objects, True), ("clutter", scene.clutter, False)):
        for k, thing in enumerate(things):
            try:
                models[thing.id] = load_object(thing.model)
            except UnknownNameError as error:
                raise FileFormatError(scene.path, f"{kind}.{k}.model", str(error)) from error
            if trackable and not models[thing.id].trackable:
                reason = f"'{thing.model}' is clutter, which no tracker has a model of; list it under 'clutter'"
                raise FileFormatError(scene.path, f"{kind}.{k}.model", reason)
    return models


def _set_options(spec: "mujoco.MjSpec", image_size: tuple[int, int], sleep: bool) -> None:
    import mujoco

    if sleep:
        spec.option.enableflags |= int(mujoco.mjtEnableBit.mjENBL_SLEEP)
    spec.compiler.degree = False
    spec.option.timestep = TIMESTEP_NS * 1e-9
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 5.0  # resting things do not creep
    spec.visual.global_.offwidth, spec.visual.global_.offheight = image_size
    spec.visual.quality.offsamples = 0  # ids and depth must not be blended at edges
    spec.visual.quality.numslices, spec.visual.quality.numstacks = 64, 32
    spec.stat.extent = 1.0  # so that the clip planes below are metres
    spec.visual.map.znear, spec.visual.map.zfar = 0.03, 80.0
    spec.visual.headlight.ambient = [0.38, 0.38, 0.38]
    spec.visual.headlight.diffuse = [0.22, 0.22, 0.22]
    spec.visual.headlight.specular = [0.0, 0.0, 0.0]
    for direction, strength in (((0.25, 0.35, -1.0), 0.42), ((-0.6, -0.2, -0.7), 0.16)):
        light = spec.worldbody.add_light(dir=direction, diffuse=[strength] * 3, specular=[0.0] * 3, castshadow=False)
        light.type = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL


def _add_static(composer: Composer, static: StaticWorld) -> None:
    import mujoco

    ground = composer.spec.worldbody
    for part in static.parts:
        if len(part.mesh.faces):
            asset = composer.mesh(f"static/{part.name}", part.mesh)
            composer.show(ground, asset, f"static/{part.name}", part.T_map_part)
            composer.instances.append((part.name, "static", "world", part.mesh, part.T_map_part))
        for k, (T_part_box, extents) in enumerate(part.collision):
            T = part.T_map_part @ T_part_box
            ground.add_geom(
                name=f"static/{part.name}#{k}", type=mujoco.mjtGeom.mjGEOM_BOX, size=np.asarray(extents) / 2,
                pos=T[:3, 3], quat=quaternion_from_rotation(T[:3, :3]), group=COLLISION,
                contype=STATIC_BITS[0], conaffinity=STATIC_BITS[1], friction=[0.6, 0.005, 0.0001],
            )  # fmt: skip


def _add_object(composer: Composer, name: str, model: ObjectModel, T_map_object: Float64, kind: Kind) -> None:
    import mujoco

    body = composer.spec.worldbody.add_body(
        name=f"object/{name}", pos=T_map_object[:3, 3], quat=quaternion_from_rotation(T_map_object[:3, :3])
    )
    body.add_freejoint(name=f"object/{name}")
    body.explicitinertial = True
    body.mass, body.ipos = model.mass, model.centre_of_mass
    inertia = model.inertia
    body.fullinertia = [*np.diag(inertia), inertia[0, 1], inertia[0, 2], inertia[1, 2]]
    identity = np.eye(4)
    if _same_surface(model.visual, model.mesh):
        composer.show(body, composer.mesh(f"visual/{model.name}", model.visual), f"object/{name}", identity)
    else:
        composer.show(body, composer.mesh(f"visual/{model.name}", model.visual), f"color/{name}", identity, COLOR_ONLY)
        full = composer.mesh(f"full/{model.name}", model.mesh, colored=False)
        composer.show(body, full, f"object/{name}", identity, DEPTH_ONLY)
    for k, part in enumerate(model.collision):
        body.add_geom(
            name=f"object/{name}#{k}", type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=composer.mesh(f"collision/{model.name}#{k}", part, colored=False), group=COLLISION, mass=0.0,
            contype=OBJECT_BITS[0], conaffinity=OBJECT_BITS[1], friction=[model.friction, 0.005, 0.0002], condim=4,
        )  # fmt: skip
    composer.instances.append((name, kind, f"object/{name}", model.mesh, identity))


def _same_surface(a: Mesh, b: Mesh) -> bool:
    """Whether one mesh is a mere retessellation of the other (then the lighter one can stand for both)."""
    if not np.allclose(a.bounds, b.bounds, rtol=0.0, atol=1e-6):
        return False
    whole = area(b)
    return abs(area(a) - whole) <= 1e-5 * whole


def _add_robot(composer: Composer, robot: KinematicTree, fovy: float) -> None:
    def add_visual(body: "mujoco.MjsBody", link: Link) -> str:
        color = tuple(round(255 * channel) for channel in link.color)
        mesh = painted(Mesh(link.vertices.astype(np.float64), link.faces), color)
        asset = composer.mesh(ROBOT + link.name, mesh)
        composer.show(body, asset, ROBOT + link.name, np.eye(4))
        composer.instances.append(("robot", "robot", ROBOT + link.name, mesh, np.eye(4)))
        return asset

    add_robot(composer.spec, robot, add_visual, ROBOT_BITS, COLLISION)
    # MuJoCo's cameras look along -z with y up: half a turn about x from the optical frame.
    camera = composer.spec.body(ROBOT + CAMERA).add_camera(name="camera", quat=[0.0, 1.0, 0.0, 0.0])
    camera.fovy = float(np.degrees(fovy))


def _add_suction(composer: Composer, models: Mapping[str, ObjectModel], static: StaticWorld) -> None:
    """A constraint for each object, door and drawer that ties it to the gripper while the cup holds it."""
    import mujoco

    for name in models:
        composer.spec.add_equality(
            name=f"suction/{name}", type=mujoco.mjtEq.mjEQ_WELD, objtype=mujoco.mjtObj.mjOBJ_BODY,
            name1=ROBOT + GRIPPER, name2=f"object/{name}", active=False, solref=[0.012, 1.0],
        )  # fmt: skip
    for moving in static.moving:  # what hangs on a joint of its own turns under the cup
        composer.spec.add_equality(
            name=f"suction/{moving.part.name}", type=mujoco.mjtEq.mjEQ_CONNECT, objtype=mujoco.mjtObj.mjOBJ_BODY,
            name1=ROBOT + GRIPPER, name2=moving.body, active=False, solref=[0.02, 1.0],
        )  # fmt: skip


def _add_hand(composer: Composer, scene: SceneFile) -> None:
    import mujoco

    from simtrack.simulation.scene_file import Carry

    assert scene.hand is not None
    capsule = mujoco.mjtGeom.mjGEOM_CAPSULE
    for name, mesh in zip(hand.PARTS, hand.hand_meshes(), strict=True):
        body = composer.spec.worldbody.add_body(name=name, mocap=True, pos=scene.hand.rest)
        composer.show(body, composer.mesh(name, mesh), name, np.eye(4))
        composer.instances.append(("hand", "actor", name, mesh, np.eye(4)))
        if name == "hand/fingers":
            for k, (y, length) in enumerate(hand.FINGERS):
                body.add_geom(
                    name=f"hand/contact{k}", type=capsule, size=[0.0095, 0, 0], group=COLLISION,
                    fromto=[0.03, y, 0.05, 0.03, y, 0.088 - 0.088 * length],
                    contype=HAND_BITS[0], conaffinity=HAND_BITS[1],
                    friction=[0.6, 0.005, 0.0001],
                )  # fmt: skip
    for carried in sorted({action.object for action in scene.hand.script if isinstance(action, Carry)}):
        composer.spec.add_equality(
            name=f"grip/{carried}", type=mujoco.mjtEq.mjEQ_WELD, objtype=mujoco.mjtObj.mjOBJ_BODY,
            name1=hand.PARTS[0], name2=f"object/{carried}", active=False, solref=[0.012, 1.0],
        )  # fmt: skip


def _assembled(
    scene: SceneFile,
    seed: int,
    composer: Composer,
    static: StaticWorld,
    robot: KinematicTree,
    models: dict[str, ObjectModel],
) -> World:
    """The compiled world before physics has begun."""
    import mujoco

    from simtrack.simulation.settling import standing

    model = composer.finish()
    bodies = {name: model.body(f"object/{name}").id for name in models}
    bodies["robot"] = model.body(ROBOT + "base").id
    if scene.hand is not None:
        bodies["hand"] = model.body(hand.PARTS[0]).id
    instances = tuple(
        Instance(name, kind, model.body(body).id, mesh, T) for name, kind, body, mesh, T in composer.instances
    )
    names = tuple(dict.fromkeys(instance.name for instance in instances))
    owners = _geom_owners(model, instances, names)
    data, controller = mujoco.MjData(model), standing(scene, model, robot)
    return World(scene, seed, model, data, static, robot, controller, models, instances, names, owners, bodies)


def _geom_owners(model: "mujoco.MjModel", instances: tuple[Instance, ...], names: tuple[str, ...]) -> Int32:
    import mujoco

    index = {name: k for k, name in enumerate(names)}
    by_body = {instance.body: index[instance.name] for instance in instances if instance.body != 0}
    owners = np.full(model.ngeom, -1, np.int32)
    for geom in range(model.ngeom):
        if (body := int(model.geom_bodyid[geom])) != 0:
            owners[geom] = by_body.get(body, -1)
        else:
            name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_GEOM, geom) or ""
            # Collision boxes and a user's shapes are numbered: "static/NAME#3".
            owners[geom] = index.get(name.removeprefix("static/").partition("#")[0], -1)
    return owners


SENSOR_BODIES = {CAMERA: ROBOT + CAMERA, LIDAR: ROBOT + LIDAR}
"""Sensor frame -> name of its MuJoCo body."""


def body_pose(data: "mujoco.MjData", body: int) -> Float64:
    """(4, 4) T_map_body, copied."""
    return transform(data.xmat[body].reshape(3, 3), data.xpos[body])


def body_poses(data: "mujoco.MjData", bodies: Sequence[int]) -> Float64:
    """(N, 4, 4) T_map_body of several bodies, copied."""
    poses = np.zeros((len(bodies), 4, 4))
    poses[:, :3, :3] = data.xmat[bodies].reshape(-1, 3, 3)
    poses[:, :3, 3] = data.xpos[bodies]
    poses[:, 3, 3] = 1.0
    return poses
