"""The believed world as one scene of mesh instances: the static map and every object that is believed to be there.

The tracking paper shares one geometric scene between localization, tracking and pre-segmentation. Localization and
pre-segmentation cast into this scene, in the map frame; the tracker registers the same meshes in the camera frame.
"""

from collections.abc import Iterable, Mapping

from simtrack.contracts import StaticMap, Track
from simtrack.objects import ObjectModel
from simtrack.raycast import RayScene, TriangleMesh

MAP = 0
"""Instance id of the static map; the instance of a track has the track's id, which is 1 or more."""


class BelievedScene:
    """Keeps a `RayScene` in step with the tracks."""

    def __init__(self, static_map: StaticMap, models: Mapping[str, ObjectModel]) -> None:
        self._place(
            TriangleMesh(static_map.vertices, static_map.faces),
            {name: TriangleMesh(m.mesh.vertices, m.mesh.faces) for name, m in models.items()},
        )

    def _place(self, static: TriangleMesh, meshes: Mapping[str, TriangleMesh]) -> None:
        self.scene = RayScene()
        self.scene.add(static, instance=MAP)
        self._meshes = meshes
        self._placed: dict[int, str] = {}

    def twin(self) -> "BelievedScene":
        """Another scene of the same meshes, for another thread: only the map is in it yet."""
        other = BelievedScene.__new__(BelievedScene)
        other._place(self.scene.mesh(MAP), self._meshes)
        return other

    def close(self) -> None:
        """Release the scene's memory."""
        self.scene.close()

    def update(self, tracks: Iterable[Track]) -> None:
        """Place the believed tracks where they are believed to be, and remove all others."""
        believed = {t.id: t for t in tracks if t.believed}
        for instance in [i for i in self._placed if i not in believed]:
            self.scene.remove(instance)
            del self._placed[instance]
        for instance, track in believed.items():
            if instance not in self._placed:
                self.scene.add(self._meshes[track.class_name], track.T_map_object, instance=instance)
                self._placed[instance] = track.class_name
            else:
                self.scene.set_pose(instance, track.T_map_object)
