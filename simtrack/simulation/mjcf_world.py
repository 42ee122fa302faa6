"""An MJCF file as a whole world: what is fixed in it is the building, known objects are tracked, the robot joins in.

``simtrack reconstruct`` writes such files; any other MJCF with a level floor will do. Elements ``custom/text`` named
``class:BODY`` state the semantic classes of bodies; a free body of the class of an object that trackers have a model of
becomes that object.
"""

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from simtrack.contracts import Float64, Room
from simtrack.errors import FileFormatError
from simtrack.geometry.meshes import Mesh, concatenate, face_areas, face_normals, transformed
from simtrack.geometry.planes import detect_planes
from simtrack.geometry.transforms import apply, inverse, rotation_from_quaternion, rpy_from_rotation, transform
from simtrack.geometry.upright_boxes import upright_box
from simtrack.objects import load_object
from simtrack.objects.registry import catalogue
from simtrack.simulation.building.parts import MovingPart, StaticPart, StaticWorld, Support, polygon_area, room_at
from simtrack.simulation.placement import blocking
from simtrack.simulation.scene_file import SceneFile, parse_scene
from simtrack.simulation.user_mjcf import geom_shape, read_model

CLASS = "class:"
FLOOR = "floor"
FLAT = 0.95
"""Cosine off the vertical up to which faces can be driven on."""
LEVEL = 0.03
"""Metres within which faces are of one floor."""
LEAST_FLOOR = 1.0
"""Square metres."""
LEAST_SUPPORT = 0.01
"""Square metres of a face that things stand on."""
VIEW = 1.3
"""Metres between the robot and what it looks at first."""
SURVEYED = 0.6
"""Metres: free bodies that are larger, and those with doors, are furniture, and surveyed where they stand."""
TRIES = 2000


def mjcf_scene(path: Path) -> SceneFile:
    """The scene of an MJCF file: the objects in it that have models, and a place for the robot.

    Raises:
        FileFormatError: MuJoCo cannot use the file, there is no floor in it, or no room for the robot.
    """
    path = Path(path)
    reading = _Reading(path, path.resolve().parent)
    world = reading.building(supports=False)
    objects = [
        {"model": model, "name": reading.name(body), "place": {"pose": reading.pose_of(body)}}
        for body, model in reading.known_objects()
    ]
    x, y, yaw = _start(path, world, np.array([thing["place"]["pose"]["xyz"] for thing in objects]).reshape(-1, 3))
    name = re.sub("[^A-Za-z0-9_.-]", "-", path.resolve().parent.name if path.stem == "scene" else path.stem)
    document = {
        "name": name[:64].lstrip("_.-") or "scene",
        "static": {"builder": "mjcf"},
        "mjcf": path.name,
        "objects": objects,
        "robot": {"start": {"x": x, "y": y, "yaw": yaw}, "torso": 0.3, "head_tilt": -0.4},
    }
    return parse_scene(document, path)


def mjcf_building(scene: SceneFile, *, supports: bool = True) -> StaticWorld:
    """What is fixed in a scene's MJCF file, its floor at height 0; `supports`: with the faces that things stand on.

    Raises:
        FileFormatError: the scene names no MJCF file, or that cannot be used as a building.
    """
    if scene.mjcf_path is None:
        raise FileFormatError(scene.path, "mjcf", "missing; the builder 'mjcf' makes the building of this file")
    return _Reading(scene.mjcf_path, scene.path.parent).building(supports=supports)


def level_faces(part: StaticPart) -> tuple[Support, ...]:
    """Rectangles around the level planes of a part that look up, part frame."""
    return tuple(_supports(part.mesh, np.eye(4)))


def free_bodies(scene: SceneFile) -> dict[str, Float64]:
    """Name of each free body that is no known object -> (2, 3) bounds of what is seen of it, map frame."""
    assert scene.mjcf_path is not None
    reading = _Reading(scene.mjcf_path, scene.path.parent)
    known = {body for body, _ in reading.known_objects()}
    return {
        reading.name(body): mesh.bounds - (0.0, 0.0, reading.floor[1])
        for body, mesh in reading.surfaces.items()
        if reading.is_free(body) and body not in known
    }


def floor_height(scene: SceneFile) -> float:
    """Z of the floor in the file of a scene whose builder is ``mjcf``, metres: what its world is lowered by."""
    assert scene.mjcf_path is not None
    return _Reading(scene.mjcf_path, scene.path.parent).floor[1]


class _Reading:
    """A compiled file at rest."""

    def __init__(self, path: Path, folder: Path) -> None:
        import mujoco

        self.path = path
        spec, self.model = read_model(path, folder)
        self.data = mujoco.MjData(self.model)
        mujoco.mj_kinematics(self.model, self.data)
        stated = [text for text in spec.texts if text.name.startswith(CLASS)]
        self.classes = {text.name.removeprefix(CLASS): text.data for text in stated}
        self.surfaces = dict(self._surfaces())
        self.floor = self._floor()

    def name(self, body: int) -> str:
        """Of a body; ``world`` for the fixed one that everything hangs on."""
        return self.model.body(body).name or f"body{body - 1}"

    def is_free(self, body: int) -> bool:
        """Whether a body hangs on a free joint, itself or through others."""
        import mujoco

        joint = int(self.model.body_jntadr[self.model.body_rootid[body]])
        return joint >= 0 and self.model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE

    def known_objects(self) -> Iterator[tuple[int, str]]:
        """Free bodies that are objects which trackers have models of: body, name of the model."""
        known = catalogue()
        for body in range(1, self.model.nbody):
            semantic_class = self.classes.get(self.name(body), "")
            if self.is_free(body) and semantic_class in known and load_object(semantic_class).trackable:
                yield body, semantic_class

    def pose_of(self, body: int) -> dict[str, Any]:
        """Pose of a body as a scene file has it, the floor at height 0."""
        x, y, z = self.data.xpos[body].tolist()
        roll, pitch, yaw = rpy_from_rotation(self.data.xmat[body].reshape(3, 3))
        return {"xyz": (x, y, z - self.floor[1]), "rpy": (roll, pitch, yaw)}

    def _surfaces(self) -> Iterator[tuple[int, Mesh]]:
        """Body -> what is seen of it, frame of the file's world."""
        shapes: dict[int, list[Mesh]] = {}
        for geom in range(self.model.ngeom):
            if self.model.geom_group[geom] <= 2:
                body, mesh, T = geom_shape(self.model, geom, self.path)
                shapes.setdefault(body, []).append(transformed(mesh, self._pose(body) @ T))
        for body, meshes in shapes.items():
            yield body, concatenate(meshes)

    def _pose(self, body: int) -> Float64:
        return transform(rotation_from_quaternion(self.data.xquat[body]), self.data.xpos[body])

    def _floor(self) -> tuple[int, float]:
        """Body with the floor, and its height: the largest level surface of class ``floor``, else of all."""
        fixed = {body: mesh for body, mesh in self.surfaces.items() if not self.is_free(body)}
        named = {body: mesh for body, mesh in fixed.items() if self.classes.get(self.name(body)) == FLOOR}
        best = (0.0, -1, 0.0)
        for body, mesh in (named or fixed).items():
            up, areas = face_normals(mesh)[:, 2] > FLAT, face_areas(mesh)
            heights = mesh.triangles[:, :, 2].mean(axis=1)
            if not up.any():
                continue
            order = np.argsort(heights[up])
            share = np.cumsum(areas[up][order])
            level = float(heights[up][order][np.searchsorted(share, 0.5 * share[-1])])
            area = float(areas[up & (np.abs(heights - level) < LEVEL)].sum())
            best = max(best, (area, body, level))
        if best[0] < LEAST_FLOOR:
            reason = f"there is no floor: no fixed body shows a level surface of {LEAST_FLOOR:g} square metre or more"
            raise FileFormatError(self.path, "worldbody", f"{reason}; a plane or a box at the bottom will do")
        return best[1], best[2]

    def building(self, *, supports: bool = True) -> StaticWorld:
        """All that is fixed, one part a body, and the room that the floor is of; `supports`: with faces to stand on."""
        lowered = transform(None, (0.0, 0.0, -self.floor[1]))
        movers = {body: self._mover(body) for body in self.surfaces}
        bearers = {int(self.model.body_rootid[mover]) for mover in movers.values() if mover}
        parts, moving = [], []
        for body, mesh in self.surfaces.items():
            bears = int(self.model.body_rootid[body]) in bearers
            if self.is_free(body) and not bears and mesh.extents.max() < SURVEYED:
                continue
            if not movers[body]:
                parts.append(self._part(body, mesh, lowered, supports=supports))
            elif movers[body] == body and not self._mover(int(self.model.body_parentid[body])):
                moving.append(self._moving(body, movers, lowered))
        return StaticWorld(tuple(parts), (self._room(),), tuple(moving))

    def _mover(self, body: int) -> int:
        """The body nearest to the root, from this one up, that a hinge or a slide moves; 0 if nothing does."""
        import mujoco

        found = 0
        while body:
            first, count = int(self.model.body_jntadr[body]), int(self.model.body_jntnum[body])
            if any(self.model.jnt_type[first : first + count] != mujoco.mjtJoint.mjJNT_FREE):
                found = body
            body = int(self.model.body_parentid[body])
        return found

    def _part(self, body: int, mesh: Mesh, lowered: Float64, *, supports: bool) -> StaticPart:
        low, high = mesh.bounds
        T_map_part = lowered @ transform(None, (low + high) / 2)
        T_part_file = inverse(T_map_part) @ lowered
        return StaticPart(
            name=self.name(body),
            semantic_class=FLOOR if body == self.floor[0] else self.classes.get(self.name(body), "furniture"),
            mesh=transformed(mesh, T_part_file),
            T_map_part=T_map_part,
            extents=high - low,
            supports=tuple(_supports(mesh, T_part_file)) if supports else (),
            room="room",
            collision=tuple(self._boxes(body, T_part_file)),
        )

    def _moving(self, body: int, movers: Mapping[int, int], lowered: Float64) -> MovingPart:
        """A door or drawer with all that hangs on it; of several joints of one body the first."""
        import mujoco

        from simtrack.simulation.user_mjcf import PREFIX

        joint = int(self.model.body_jntadr[body])
        mesh = concatenate([shape for other, shape in self.surfaces.items() if movers[other] == body])
        slides = self.model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE
        limited, bounds = bool(self.model.jnt_limited[joint]), self.model.jnt_range[joint]
        lower, upper = bounds.tolist() if limited else (-1.0, 1.0) if slides else (-np.pi, np.pi)
        return MovingPart(
            part=self._part(body, mesh, lowered, supports=False),
            joint=PREFIX + self.model.joint(joint).name,
            body=PREFIX + self.name(body),
            kind="prismatic" if slides else "revolute",
            anchor=apply(lowered, self.data.xanchor[joint][None])[0],
            axis=self.data.xaxis[joint].copy(),
            lower=float(lower),
            upper=float(upper),
        )

    def _boxes(self, body: int, T_part_file: Float64) -> Iterator[tuple[Float64, Float64]]:
        """Boxes around what a body collides with."""
        for geom in range(self.model.ngeom):
            if int(self.model.geom_bodyid[geom]) == body and self.model.geom_contype[geom]:
                middle, half = self.model.geom_aabb[geom, :3], self.model.geom_aabb[geom, 3:]
                if not (half > 0.0).any() or half.max() > 1e3:  # an endless plane is the floor
                    continue
                T = self._pose(body) @ transform(
                    rotation_from_quaternion(self.model.geom_quat[geom]), self.model.geom_pos[geom].copy()
                )
                yield T_part_file @ T @ transform(None, middle.copy()), 2.0 * half

    def _room(self) -> Room:
        """The outline of the floor's largest piece; as high as the highest thing."""
        from shapely import Polygon, union_all

        mesh, level = self.surfaces[self.floor[0]], self.floor[1]
        triangles = mesh.triangles
        floor = (face_normals(mesh)[:, 2] > FLAT) & (np.abs(triangles[:, :, 2].mean(axis=1) - level) < LEVEL)
        whole = union_all([Polygon(corners[:, :2]).buffer(1e-3) for corners in triangles[floor]]).simplify(0.01)
        largest = max(getattr(whole, "geoms", [whole]), key=lambda piece: piece.area)
        outline = np.array(largest.exterior.coords)[:-1]
        outline = outline if polygon_area(outline) > 0.0 else outline[::-1]
        top = max(float(surface.vertices[:, 2].max()) for surface in self.surfaces.values()) - level
        return Room("room", outline, 0.0, max(top, 2.0))


def _supports(mesh: Mesh, T_part_file: Float64) -> Iterator[tuple[Float64, Float64]]:
    """Rectangles around the level planes of a mesh that look up: T_part_face (4, 4), size (2,)."""
    for plane in detect_planes(mesh, np.random.default_rng(0)):
        if plane.normal[2] > FLAT and plane.area > LEAST_SUPPORT:
            box = upright_box(mesh.vertices[np.unique(mesh.faces[plane.faces])])
            T_file_face = box.T_map_box.copy()
            T_file_face[2, 3] = plane.height_at(*T_file_face[:2, 3].tolist())
            yield T_part_file @ T_file_face, box.extents[:2]


def _start(path: Path, world: StaticWorld, objects: Float64) -> tuple[float, float, float]:
    """x, y, yaw of a free place on the floor from which the robot looks at the (N, 3) objects, or at the middle."""
    outline = world.rooms[0].polygon
    rng = np.random.default_rng(0)
    aim = np.median(objects[:, :2], axis=0) if len(objects) else outline.mean(axis=0)
    tried = rng.uniform(outline.min(axis=0), outline.max(axis=0), (TRIES, 2))
    order = np.argsort(np.abs(np.linalg.norm(tried - aim, axis=1) - VIEW))
    for x, y in tried[order].tolist():
        if room_at(world.rooms, x, y) is not None and blocking(world.solid, x, y) is None:
            return x, y, float(np.arctan2(aim[1] - y, aim[0] - x))
    raise FileFormatError(path, "worldbody", "there is no free place on the floor for the robot, 0.6 m across")
