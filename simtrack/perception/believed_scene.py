"""The believed world as one scene of mesh instances: the static map and every object that is believed to be there.

The tracking paper shares one geometric scene between localization, tracking and pre-segmentation. Localization and
pre-segmentation cast into this scene, in the map frame; the tracker registers the same meshes in the camera frame.
"""

from collections.abc import Iterable, Mapping, Sequence

from simtrack.contracts import Articulation, JointEstimate, StaticMap, Track
from simtrack.objects import ObjectModel
from simtrack.perception.tracking.articulation import believed_poses
from simtrack.raycast import RayScene, TriangleMesh

MAP = 0
"""Instance id of the static map; those of what joints let move follow, then those of tracks by their ids."""


class BelievedScene:
    """Keeps a `RayScene` in step with the tracks."""

    def __init__(self, static_map: StaticMap, models: Mapping[str, ObjectModel]) -> None:
        self._place(
            TriangleMesh(static_map.vertices, static_map.faces),
            {name: TriangleMesh(m.mesh.vertices, m.mesh.faces) for name, m in models.items()},
            static_map.articulations,
            [TriangleMesh(a.vertices, a.faces) for a in static_map.articulations],
        )

    def _place(
        self,
        static: TriangleMesh,
        meshes: Mapping[str, TriangleMesh],
        articulations: Sequence[Articulation],
        parts: Sequence[TriangleMesh],
    ) -> None:
        self.scene = RayScene()
        self.scene.add(static, instance=MAP)
        for number, part in enumerate(parts, MAP + 1):
            self.scene.add(part, instance=number)
        self._articulations, self._parts = articulations, parts
        self._meshes = meshes
        self._placed: dict[int, str] = {}

    def twin(self) -> "BelievedScene":
        """Another scene of the same meshes, for another thread: only the map is in it yet."""
        other = BelievedScene.__new__(BelievedScene)
        other._place(self.scene.mesh(MAP), self._meshes, self._articulations, self._parts)
        return other

    def close(self) -> None:
        """Release the scene's memory."""
        self.scene.close()

    def update(self, tracks: Iterable[Track], joints: Sequence[JointEstimate] = ()) -> None:
        """Place the believed tracks where they are believed to be, and remove all others; doors as far open as that."""
        if self._parts:
            poses = believed_poses(self._articulations, joints)
            self.scene.set_poses(
                range(MAP + 1, MAP + 1 + len(self._parts)), [poses[a.name] for a in self._articulations]
            )
        believed = {len(self._parts) + t.id: t for t in tracks if t.believed}
        for instance in [i for i in self._placed if i not in believed]:
            self.scene.remove(instance)
            del self._placed[instance]
        kept = [instance for instance in believed if instance in self._placed]
        self.scene.set_poses(kept, [believed[instance].T_map_object for instance in kept])
        for instance, track in believed.items():
            if instance not in self._placed:
                self.scene.add(self._meshes[track.class_name], track.T_map_object, instance=instance)
                self._placed[instance] = track.class_name
