"""What is really the case, at any moment so far. Nothing that estimates may import this."""

from bisect import bisect_right
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

import numpy as np
import numpy.typing as npt

from simtrack.contracts import NANOSECONDS, Bool, CameraIntrinsics, Float32, Float64, Int32
from simtrack.errors import UnknownNameError
from simtrack.geometry.transforms import difference, inverse
from simtrack.raycast import RayBundle, RayHits, RayScene, TriangleMesh
from simtrack.simulation.contacts import SUPPORTING, contact_pairs
from simtrack.simulation.history import History
from simtrack.simulation.placement import DEEP
from simtrack.simulation.rendering import NEAR
from simtrack.simulation.silhouettes import silhouette_rays
from simtrack.simulation.world import SENSOR_BODIES, World, body_pose, body_poses
from simtrack.simulation.world_rays import WorldRays

if TYPE_CHECKING:
    import mujoco

CONTACT_WINDOW = 20_000_000
"""Nanoseconds: contacts within it count, so that one that chatters for a physics step does not flicker."""


@dataclass(frozen=True, slots=True)
class ObjectTruth:
    """One movable thing at one moment."""

    name: str
    """Name in the scene, e.g. ``screwdriver-2``."""
    class_name: str
    """Name of its model; ``hand`` for the hand."""
    kind: Literal["catalogue", "clutter", "actor"]
    T_map_object: Float64
    """(4, 4)."""
    velocity: Float64
    """(6,), m/s of the origin and rad/s, map frame."""


@dataclass(frozen=True, slots=True)
class Truth:
    """The world at one moment."""

    stamp: int
    """Nanoseconds."""
    T_map_base: Float64
    """(4, 4)."""
    T_map_camera: Float64
    """(4, 4), optical frame."""
    T_map_lidar: Float64
    """(4, 4)."""
    objects: Mapping[str, ObjectTruth]
    """By name; what is away from the world is missing."""
    contacts: frozenset[tuple[str, str]]
    """(supported, supporter): touches it from above; supporters are objects or furniture."""
    touching: frozenset[tuple[str, str]]
    """Pairs in alphabetical order that touch anyhow."""
    joints: Mapping[str, float] = field(default_factory=dict)
    """Positions of the building's doors and drawers, rad or m."""


@dataclass(frozen=True, slots=True)
class Visibility:
    """How much of an object the camera sees."""

    pixels: int
    """Visible pixels in the image, estimated from strided rays."""
    fraction: float
    """0 to 1: visible share of the whole silhouette, including the part of it outside of the image."""


class GroundTruth:
    """Answers for any stamp from 0 to now (nanoseconds); later ones raise `InvalidValueError`."""

    def __init__(self, world: World, history: History, rays: WorldRays, intrinsics: CameraIntrinsics) -> None:
        import mujoco

        self._world, self._history, self._rays = world, history, rays
        self._intrinsics = intrinsics
        self._scratch = mujoco.MjData(world.model)
        self._sensors = {frame: world.model.body(body).id for frame, body in SENSOR_BODIES.items()}
        self._movable = {name: body for name, body in world.bodies.items() if name != "robot"}
        self._joints = {
            moving.part.name: int(world.model.joint(moving.joint).qposadr[0]) for moving in world.static.moving
        }
        self._contacts = _ContactLog(world, history.key)
        self._alone: RayScene | None = None
        self._corners = np.array([model.keypoints[:8] for model in world.objects.values()]).reshape(-1, 8, 3)
        self._object_ids = np.array([world.names.index(name) for name in world.objects], np.int32)
        self._lidar: dict[int, Int32] = {}
        self._images: dict[int, RayHits] = {}
        """What the pixels of the last images met, where rays rendered them."""
        self._full: RayBundle | None = None
        self._seen: tuple[int, dict[str, Visibility]] | None = None
        """The last answers of `visibility`: detector and evaluation ask about the same images."""

    @property
    def names(self) -> tuple[str, ...]:
        """What ids index: furniture and building parts, ``robot``, ``hand``, objects and clutter."""
        return self._world.names

    def class_of(self, name: str) -> str:
        """Name of the model of an object of the scene, ``hand`` for the hand."""
        if name in self._world.objects:
            return self._world.objects[name].name
        if name in self._movable:
            return name
        raise UnknownNameError("object of the scene", name, self._movable)

    def kind_of(self, name: str) -> Literal["catalogue", "clutter", "actor"]:
        """What sort of thing a movable thing is."""
        if name not in self._world.objects:
            return "actor"
        return "catalogue" if self._world.is_catalogue(name) else "clutter"

    def at(self, stamp: int) -> Truth:
        """Everything at a stamp."""
        scratch = self._scratch
        early = max(self._history.start, stamp - self._history.key)
        late = min(self._history.end, stamp + self._history.key)
        bodies = list(self._movable.values())
        self._history.load(early, scratch)
        before = body_poses(scratch, bodies)
        self._history.load(late, scratch)
        after = poses = body_poses(scratch, bodies)
        seconds = max(late - early, 1) / NANOSECONDS
        if stamp != late:  # which is now
            self._history.load(stamp, scratch)
            poses = body_poses(scratch, bodies)
        moved = (after != before).any(axis=(1, 2)).tolist()  # most things rest
        objects = {
            name: ObjectTruth(
                name, self.class_of(name), self.kind_of(name), poses[k],
                difference(after[k], before[k]) / seconds if moved[k] else np.zeros(6),
            )
            for k, name in enumerate(self._movable)
            if poses[k, 2, 3] > -DEEP / 2
        }  # fmt: skip
        contacts, touching = self._contacts.at(stamp)
        base = body_pose(scratch, self._world.bodies["robot"])
        camera, lidar = (body_pose(scratch, self._sensors[frame]) for frame in ("camera", "lidar"))
        joints = {name: float(scratch.qpos[address]) for name, address in self._joints.items()}
        return Truth(stamp, base, camera, lidar, objects, contacts, touching, joints)

    def joint_positions(self, stamp: int) -> dict[str, float]:
        """True positions of the robot's joints, rad or m."""
        values = self._world.controller.joint_positions(self._history.qpos(stamp))
        return dict(zip(self._world.controller.joint_names, values.tolist(), strict=True))

    # ------------------------------------------------------------------------------------------------------- visibility

    def visibility(self, stamp: int, names: Collection[str] | None = None) -> dict[str, Visibility]:
        """How much of each object (catalogue and clutter) the camera sees; objects behind it are not seen at all.

        Args:
            stamp: nanoseconds.
            names: of the objects that are asked about, all if None; what is no object is left out.
        """
        if self._seen is None or self._seen[0] != stamp:
            self._seen = stamp, {}
        wanted = [name for name in self._world.objects if names is None or name in names]
        if missing := {name for name in wanted if name not in self._seen[1]}:
            self._seen[1].update(self._look(stamp, missing))
        return {name: self._seen[1][name] for name in wanted}

    def _look(self, stamp: int, wanted: Collection[str]) -> dict[str, Visibility]:
        self._history.load(stamp, self._scratch)
        T_map_camera = body_pose(self._scratch, self._sensors["camera"])
        names, poses = self._object_poses()
        T_camera_object = inverse(T_map_camera) @ poses
        asked = np.array([k for k, name in enumerate(names) if name in wanted], np.int32)
        owners, rays, pixels, size = silhouette_rays(self._corners[asked], T_camera_object[asked], self._intrinsics)
        if not len(rays):
            return dict.fromkeys(wanted, Visibility(0, 0.0))
        owners, area = asked[owners], np.zeros(len(names))
        area[asked] = size
        directions = rays @ T_map_camera[:3, :3].T.astype(np.float32)
        # Each object alone: they stand far apart from one another, and each ray starts in front of its own.
        alone, offsets = self._objects_apart(names, poses, np.flatnonzero(area))

        def meets(chosen: Bool) -> Bool:
            starts = T_map_camera[:3, 3] + offsets[owners[chosen]]
            return alone.cast_rays(starts, directions[chosen]).instances == owners[chosen]

        own, seen = np.zeros(len(rays), np.bool_), np.zeros(len(rays), np.bool_)
        if stamp in self._images:
            inside = np.flatnonzero(pixels >= 0)
            ids, depth = self._rendered(stamp, pixels[inside])
            seen[inside] = own[inside] = ids == self._object_ids[owners[inside]]
            # What lies behind all of an object does not hide it: such rays pass it by.
            farthest = (self._corners @ T_camera_object[:, 2, :3, None])[:, :, 0].max(axis=1) + T_camera_object[:, 2, 3]
            passing = np.zeros(len(rays), np.bool_)
            passing[inside] = depth > farthest[owners[inside]]
            left = ~own & ~passing
            own[left] = meets(left)
        else:
            self._rays.place(self._scratch)
            own = meets(np.ones(len(rays), np.bool_))
            chosen = own & (pixels >= 0)
            origins = np.broadcast_to(T_map_camera[:3, 3], (int(chosen.sum()), 3))
            hits = self._rays.scene.cast_rays(origins, directions[chosen], min_distance=NEAR)
            seen[chosen] = self._rays.ids(hits) == self._object_ids[owners[chosen]]
        whole = np.bincount(owners[own], minlength=len(names)).tolist()
        visible = np.bincount(owners[seen], minlength=len(names)).tolist()
        return {
            name: Visibility(round(visible[k] * float(area[k])), visible[k] / max(whole[k], 1))
            for k, name in enumerate(names)
            if name in wanted
        }

    def _rendered(self, stamp: int, pixels: Int32) -> tuple[Int32, Float32]:
        """Index into `names`, -1 = nothing, and depth, inf = nothing, of pixels of an image that is kept."""
        image = self._images[stamp]
        met = RayHits(image.distances[pixels], image.normals[:0], image.faces[pixels], image.instances[pixels])
        return self._rays.ids(met), met.distances

    def ids(self, stamp: int) -> Int32:
        """(H, W), index into `names` of what each pixel of the camera sees, -1 = nothing."""
        self._load(stamp)
        if self._full is None:
            self._full = RayBundle.from_camera(self._intrinsics)
        T_map_camera = body_pose(self._scratch, self._sensors["camera"])
        hits = self._rays.scene.cast(self._full, T_map_camera, min_distance=NEAR)
        return self._rays.ids(hits).reshape(self._intrinsics.height, self._intrinsics.width)

    def rays(self, stamp: int) -> WorldRays:
        """The world as it was at a stamp, to cast rays at until the next question or step."""
        self._load(stamp)
        return self._rays

    def lidar_ids(self, stamp: int) -> Int32:
        """(N,), index into `names` of what each shot of the scan that began at `stamp` hit, -1 = nothing.

        The last scans are kept; older ones raise `UnknownNameError`.
        """
        if stamp not in self._lidar:
            raise UnknownNameError("scan", str(stamp), (str(kept) for kept in self._lidar))
        return self._lidar[stamp]

    # ------------------------------------------------------------------------------------------- what the clock reports

    def record(self, data: "mujoco.MjData") -> None:
        """Take the contacts of the key that was just appended to the history."""
        self._contacts.append(data)

    def record_scan(self, stamp: int, ids: Int32, keep: int = 8) -> None:
        """Keep what the shots of a scan hit, of the last `keep` scans."""
        self._lidar[stamp] = ids
        while len(self._lidar) > keep:
            del self._lidar[min(self._lidar)]

    def record_image(self, stamp: int, hits: RayHits, keep: int = 4) -> None:
        """Keep what the pixels of an image met that rays rendered, of the last `keep` images."""
        self._images[stamp] = RayHits(hits.distances.copy(), hits.normals[:0], hits.faces.copy(), hits.instances.copy())
        while len(self._images) > keep:
            del self._images[min(self._images)]

    def clear(self) -> None:
        """Forget what was, as the history does: the clock begins anew."""
        self._contacts.clear()
        self._images.clear()
        self._lidar.clear()
        self._seen = None

    # -------------------------------------------------------------------------------------------------------- internals

    def _load(self, stamp: int) -> None:
        self._history.load(stamp, self._scratch)
        self._rays.place(self._scratch)

    def _object_poses(self) -> tuple[list[str], Float64]:
        names = list(self._world.objects)
        return names, body_poses(self._scratch, [self._movable[name] for name in names])

    def _objects_apart(
        self, names: list[str], poses: Float64, placed: npt.NDArray[np.int64]
    ) -> tuple[RayScene, Float64]:
        """A scene in which object k, of those that are `placed`, is instance k, displaced by row k of the offsets."""
        if self._alone is None:
            self._alone = RayScene()
            meshes: dict[int, TriangleMesh] = {}
            for k, name in enumerate(names):
                mesh = self._world.objects[name].mesh
                if id(mesh) not in meshes:
                    meshes[id(mesh)] = TriangleMesh(mesh.vertices, mesh.faces, name)
                self._alone.add(meshes[id(mesh)], instance=k)
        offsets = np.zeros((len(names), 3))
        offsets[:, 2] = 200.0 * np.arange(len(names))
        shifted = poses[placed]
        shifted[:, :3, 3] += offsets[placed]
        self._alone.set_poses(placed.tolist(), shifted)
        return self._alone, offsets

    def close(self) -> None:
        """Release ray scenes."""
        if self._alone is not None:
            self._alone.close()


class _ContactLog:
    """Contacts between things, kept only where they change."""

    def __init__(self, world: World, key: int) -> None:
        names = world.names
        self._names, self._key = names, key
        robot = [k for k, name in enumerate(names) if name == "robot"]
        self._owner = np.where(np.isin(world.geom_owners, robot), -1, world.geom_owners)
        self._is_object = np.array([name in world.objects for name in names])
        trees = world.model.body_treeid
        self._trees = np.array([trees[world.bodies[name]] if name in world.objects else -1 for name in names])
        self._fixed = np.array([name not in world.bodies for name in names])
        self.clear()

    def clear(self) -> None:
        self._keys: list[int] = []
        self._sets: list[tuple[np.ndarray, np.ndarray]] = []
        self._count = 0
        self._last = b""
        self._told: tuple[tuple[int, int], tuple[frozenset[tuple[str, str]], frozenset[tuple[str, str]]]]
        self._told = (-1, -1), (frozenset(), frozenset())
        """The last answer, and which of the sets it is of."""

    def append(self, data: "mujoco.MjData") -> None:
        contact = data.contact
        stamp, self._count = self._count * self._key, self._count + 1
        geoms, apart, up = contact.geom, contact.dist > 0.0, contact.frame[:, 2]
        asleep = data.tree_asleep >= 0
        fingerprint = geoms.tobytes() + apart.tobytes() + (np.abs(up) > SUPPORTING).tobytes() + asleep.tobytes()
        if fingerprint == self._last:  # mostly so: things rest
            return
        self._last = fingerprint
        supports, touches = contact_pairs(data, self._owner, self._is_object)
        last = self._sets[-1] if self._sets else None
        if last is not None and asleep.any():  # physics leaves out the contacts of what sleeps; it goes on touching
            supports, touches = self._kept(last[0], supports, asleep), self._kept(last[1], touches, asleep)
        if last is None or not (np.array_equal(last[0], supports) and np.array_equal(last[1], touches)):
            self._keys.append(stamp)
            self._sets.append((supports, touches))

    def _kept(self, old: np.ndarray, new: np.ndarray, asleep: Bool) -> np.ndarray:
        """Pairs (P, 2) of now, with the old ones in which nothing is awake."""
        tree = self._trees[old]
        still = (self._fixed[old] | ((tree >= 0) & asleep[tree])).all(axis=1)
        return np.unique(np.concatenate([old[still], new]), axis=0)

    def at(self, stamp: int) -> tuple[frozenset[tuple[str, str]], frozenset[tuple[str, str]]]:
        low = max(0, bisect_right(self._keys, stamp - CONTACT_WINDOW) - 1)
        high = min(max(low + 1, bisect_right(self._keys, stamp + CONTACT_WINDOW)), len(self._sets))
        if self._told[0] != (low, high):  # mostly so: things rest
            self._told = (low, high), self._between(low, high)
        return self._told[1]

    def _between(self, low: int, high: int) -> tuple[frozenset[tuple[str, str]], frozenset[tuple[str, str]]]:
        """Names of what was supported by what, and of what touched what, in some of the sets."""
        supports = {(int(a), int(b)) for kept in self._sets[low:high] for a, b in kept[0]}
        touches = {(int(a), int(b)) for kept in self._sets[low:high] for a, b in kept[1]}

        def named(pair: tuple[int, int]) -> tuple[str, str]:
            return self._names[pair[0]], self._names[pair[1]]

        pairs = frozenset((a, b) if a < b else (b, a) for a, b in map(named, touches))
        return frozenset(map(named, supports)), pairs
