"""A room of a seed as it truly is, as an MJCF scene in which doors open and things can be carried."""

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from simtrack import paths
from simtrack.geometry.meshes import box_mesh, transformed
from simtrack.geometry.transforms import inverse, transform
from simtrack.perception.reconstruction.body_tree import Body, BodyJoint, BodyTree, Shape
from simtrack.perception.reconstruction.candidates import CadCandidate
from simtrack.perception.reconstruction.files import write_scene
from simtrack.perception.reconstruction.kinematic_tree import FIXED_CLASSES, LAYOUT_FRICTION, LIFTABLE, ROOT, bodies_of
from simtrack.simulation.building.cache import digest
from simtrack.simulation.building.rooms.physics import FLOOR, RoomEntity, SettledRoom, settled_room
from simtrack.simulation.building.rooms.plan import RoomKind

WALL = 0.2
"""Metres: thickness of walls and floor where nobody sees it."""


def functional_room(seed: int, kind: RoomKind | None = None) -> Path:
    """The MJCF file of a room, kept in the user's cache folder; made the first time, which takes some seconds.

    Args:
        seed: of the room.
        kind: of the room; drawn from the seed if None.
    """
    own = [source.read_bytes() for source in sorted(Path(__file__).parent.glob("*.py"))]
    folder = paths.cache_dir() / "functional-rooms" / f"{kind or 'any'}-{seed}-{digest(*own)}"
    file = folder / "scene.xml"
    if not file.is_file():
        folder.parent.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(prefix=f"{folder.name}-", dir=folder.parent, ignore_cleanup_errors=True) as work:
            made = Path(work) / "room"
            write_scene(room_tree(settled_room(seed, kind)), made)
            try:
                made.rename(folder)
            except OSError:  # another process was first
                if not file.is_file():
                    raise
    return file


def room_tree(room: SettledRoom) -> BodyTree:
    """A settled room as bodies and joints: furniture and what hangs is fixed, the rest is free where it came to rest.

    As in reconstructed scenes, every joint is at 0 where it came to rest.
    """
    hung = {cleat.thing for cleat in room.plan.cleats}
    bodies, taken = [Body(ROOT, semantic_class="scene")], {ROOT, *(entity.name for entity in room.entities)}
    for entity in room.entities:
        if entity.placed is None:
            bodies.append(_layout(entity, room))
            continue
        model, T = entity.placed.model, entity.placed.T_map_model
        fixed = entity.name in hung or entity.semantic_class in FIXED_CLASSES or model.mass > LIFTABLE
        kind = "fixed" if fixed else "floating"
        joint = BodyJoint(f"{entity.name}/{kind}", kind, ROOT, T)
        candidate = CadCandidate(model, T, 1.0, entity.placed.positions)
        bodies += bodies_of(candidate, entity.name, joint, entity.semantic_class, taken)
    return BodyTree(f"{room.plan.kind}-{room.plan.seed}", tuple(bodies))


def _layout(entity: RoomEntity, room: SettledRoom) -> Body:
    """Floor or wall: its sheets as they are seen, a slab behind them, and the cleats of what hangs on it."""
    low, high = np.vstack([room.plan.room.polygon.min(axis=0), room.plan.room.polygon.max(axis=0)])
    size, middle = np.array([*(high - low) + 2 * WALL, WALL]), np.array([*(low + high) / 2, -WALL / 2])
    if entity.name != FLOOR:
        side = entity.mesh.vertices.mean(axis=0)[:2] - middle[:2]
        axis = int(np.argmax(np.abs(side) / (high - low)))
        size[axis], size[2] = WALL, room.plan.room.height
        middle[axis] = high[axis] + WALL / 2 if side[axis] > 0 else low[axis] - WALL / 2
        middle[2] = room.plan.room.height / 2
    boxes = [(transform(None, middle), size)]
    boxes += [box for cleat in room.plan.cleats if cleat.wall == entity.name for box in cleat.boxes]
    shapes = [Shape("convex", mesh=transformed(box_mesh(extents), T)) for T, extents in boxes]
    joint = BodyJoint(f"{entity.name}/fixed", "fixed", ROOT, inverse(np.eye(4)))
    return Body(
        entity.name, joint, entity.mesh, tuple(shapes), friction=LAYOUT_FRICTION, semantic_class=entity.semantic_class
    )
