"""A scene's true entities at time 0: the pieces of its building and its objects, at rest."""

from simtrack.objects import ObjectModel
from simtrack.perception.scene_graph.contact.nodes import EntityMesh
from simtrack.simulation.scene_file import SceneFile
from simtrack.simulation.world import body_pose, build_world


def true_entities(scene: SceneFile, seed: int = 0) -> tuple[tuple[EntityMesh, ...], dict[str, ObjectModel]]:
    """Exact meshes of everything but robot and hand, and the models of the objects by name.

    Args:
        scene: of any builder; what its own MJCF file adds is left out.
        seed: of the run whose beginning is meant.

    Raises:
        FileFormatError, UnknownNameError: the scene cannot be built; see `build_world`.
    """
    world = build_world(scene, seed)
    pieces = [
        EntityMesh(part.name, part.semantic_class, part.mesh, part.T_map_part)
        for part in world.static.parts
        if len(part.mesh.faces)
    ]
    objects = [
        EntityMesh(name, model.name, model.visual, body_pose(world.data, world.bodies[name]))
        for name, model in world.objects.items()
    ]
    return (*pieces, *objects), dict(world.objects)
