"""What the arm works out before it works from the front: where the cup finds hold, and how it gets there.

Doors and drawers are pulled and pushed by a cup on the face that looks outwards. It hangs in a ball joint, so that it
may lean against the face; so the base need only go straight back, or forth, while a door swings.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from simtrack.contracts import Articulation, Float64
from simtrack.envs.arm import LEVEL, SHOULDER, ArmKinematics
from simtrack.envs.grasps import CLEAR, HIGHER, UNEVEN
from simtrack.geometry.transforms import apply, inverse, transform_planar, yaw_of
from simtrack.perception.tracking.articulation import motion
from simtrack.raycast import RayScene, TriangleMesh
from simtrack.simulation.suction import RIM

SPACING = 0.02
"""Metres between the places on a face that are tried."""
SEALING, LEANING = np.deg2rad(25.0), np.deg2rad(58.0)
"""Radians off a face's normal at which the cup finds hold, and up to which it may lean then."""
LEANS = np.deg2rad([0, 12, -12, 25, -25, 40, -40, 58, -58])
FACING = 0.9
"""Cosine off a door's rough direction up to which its faces belong to its front."""
FROM_RIM = 0.05
"""Metres from the upper and lower end of a door or drawer within which it is not held if there is another place."""
FROM_EDGE = 0.1
"""Metres from the outermost point at which a door is best moved: beside its handle."""
COMFORT = 0.65
"""Metres above the floor, with the torso down, at which the arm reaches farthest."""
HAND, UPPER_ARM, FOREARM, SHOULDER_HEIGHT = 0.245, 0.345, 0.24, 0.66
"""Metres: from wrist to rim, the arm's two long parts with what leads to them, the arm's first axis with the torso
down; what is farther away than that need not be tried."""
BEFORE = 0.12
"""Metres before a face from which the cup approaches it."""
WAYPOINTS = 7
"""Positions of a joint at which reach is checked."""


def flat_spots(vertices: Float64, faces: np.ndarray, direction: Float64, spacing: float = SPACING) -> Float64:
    """(N, 3) places on a mesh, same frame, at which a cup that comes along `direction` (3,), horizontal, finds hold."""
    side = np.array([-direction[1], direction[0], 0.0])
    up = np.array([0.0, 0.0, 1.0])
    u, v, depth = vertices @ side, vertices @ up, float((vertices @ direction).min()) - 0.1
    grid = np.stack(
        np.meshgrid(np.arange(u.min(), u.max(), spacing), np.arange(v.min(), v.max(), spacing), indexing="ij"), axis=-1
    ).reshape(-1, 2)
    angles = np.linspace(0.0, 2.0 * np.pi, 8, endpoint=False)
    ring = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    offsets = np.concatenate([np.zeros((1, 2)), 1.3 * RIM * ring, (RIM + CLEAR) * ring])
    places = (grid[:, None] + offsets).reshape(-1, 2)
    origins = places[:, :1] * side + places[:, 1:] * up + depth * direction
    scene = RayScene()
    try:
        scene.add(TriangleMesh(vertices, faces), instance=0)
        hits = scene.cast_rays(origins, np.broadcast_to(direction, origins.shape))
    finally:
        scene.close()
    depths = hits.distances.astype(float).reshape(len(grid), -1)
    spot, around = depths[:, :9], depths[:, 9:]
    usable = np.isfinite(spot).all(axis=1)
    with np.errstate(invalid="ignore"):
        usable &= (np.ptp(spot, axis=1) <= UNEVEN) & (spot[:, :1] - around <= HIGHER).all(axis=1)
    return origins.reshape(len(grid), -1, 3)[usable, 0] + spot[usable, :1] * direction


@dataclass(frozen=True)
class Front:
    """The outer face of a door or drawer."""

    articulation: Articulation

    @cached_property
    def outwards(self) -> Float64:
        """(3,), horizontal, with the joint at 0: where it opens to."""
        a = self.articulation
        if a.kind == "prismatic":
            return a.axis
        arm = a.vertices.astype(float).mean(axis=0) - a.anchor
        out = np.asarray(np.cross(a.axis, arm - (arm @ a.axis) * a.axis), np.float64)
        out /= float(np.linalg.norm(out))
        # The hinge lies behind the leaf, and a handle before it: the leaf's face tells better where it looks.
        corners = a.vertices.astype(float)[a.faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        facing = normals[normals @ out > FACING * np.linalg.norm(normals, axis=1)].sum(axis=0)
        facing[2] = 0.0
        length = float(np.linalg.norm(facing))
        return facing / length if length > 0.0 else out

    @cached_property
    def outwards_closed(self) -> Float64:
        """(3,), horizontal: where it looks at the lower end of its joint, closed."""
        return motion(self.articulation, self.articulation.lower)[:3, :3] @ self.outwards

    @cached_property
    def spots(self) -> Float64:
        """(N, 3), with the joint at 0, map frame."""
        a = self.articulation
        return flat_spots(a.vertices.astype(float), a.faces, -self.outwards)

    def spot(self, height: float) -> Float64 | None:
        """(3,) the one to be used by an arm that likes to work at a height, metres; None if there is none."""
        a, spots = self.articulation, self.spots
        if not len(spots):
            return None
        low, high = float(a.vertices[:, 2].min()) + FROM_RIM, float(a.vertices[:, 2].max()) - FROM_RIM
        inner = (spots[:, 2] > low) & (spots[:, 2] < high)
        spots = spots[inner] if inner.any() else spots
        cost = np.abs(spots[:, 2] - height)
        if a.kind == "revolute":
            along = np.cross(self.outwards, a.axis)
            along *= np.sign((a.vertices.astype(float).mean(axis=0) - a.anchor) @ along)
            lever = (spots - a.anchor) @ along
            widest = float(((a.vertices - a.anchor) @ along).max())
            cost = cost + 3.0 * np.abs(lever - (widest - FROM_EDGE))
        return spots[int(np.argmin(cost))]

    def at(self, spot: Float64, position: float) -> tuple[Float64, Float64]:
        """(3,) the spot and (3,) the direction inwards there, map frame, at a joint position."""
        T = motion(self.articulation, position)
        return apply(T, spot[None])[0], -T[:3, :3] @ self.outwards


class FrontReach:
    """Where the arm reaches from the front, by the robot's own description."""

    def __init__(self, arm: ArmKinematics) -> None:
        self.arm = arm

    def aim(
        self,
        place: Float64,
        inwards: Float64,
        torso: float,
        lean: float,
        start: Mapping[str, float] | None = None,
        level: bool = False,
    ) -> tuple[dict[str, float], float] | None:
        """Joint angles that bring the cup to a face, the more the cup looks ahead the better.

        Args:
            place: (3,), base frame, metres.
            inwards: (3,), base frame, horizontal.
            torso: lift, metres.
            lean: radians that the cup may lean at most.
            start: joint angles to begin with; several are tried if None.
            level: the cup's z axis shall point up.

        Returns:
            Joint angles, and how far the cup leans to the left, radians; None if it cannot be reached.
        """
        offsets = LEANS[np.abs(LEANS) <= lean + 1e-6].tolist()
        bearing = float(np.arctan2(inwards[1], inwards[0]))
        for offset in sorted(offsets, key=lambda angle: abs(bearing + angle)):
            joints = self.joints(place, turned(inwards, offset), torso, start, level)
            if joints is not None:
                return joints, offset
        return None

    def approach(
        self, place: Float64, inwards: Float64, torso: float
    ) -> tuple[dict[str, float], dict[str, float], Float64] | None:
        """How the cup gets hold of a face: joint angles before it and at it, and its direction (3,); see `aim`."""
        bearing = float(np.arctan2(inwards[1], inwards[0]))
        for offset in sorted(LEANS[np.abs(LEANS) <= SEALING + 1e-6].tolist(), key=lambda angle: abs(bearing + angle)):
            direction = turned(inwards, offset)
            joints = self.joints(place, direction, torso)
            before = None if joints is None else self.joints(place - BEFORE * direction, direction, torso, joints)
            if joints is not None and before is not None:
                return before, joints, direction
        return None

    def joints(
        self,
        place: Float64,
        direction: Float64,
        torso: float,
        start: Mapping[str, float] | None = None,
        level: bool = False,
    ) -> dict[str, float] | None:
        """Joint angles that bring the cup to a place (3,), pointing in a direction, base frame; None: out of reach."""
        wrist = place - HAND * direction - (SHOULDER, 0.0, SHOULDER_HEIGHT + torso)
        if direction[0] < 0.2 or not 0.2 < float(np.linalg.norm(wrist)) < UPPER_ARM + FOREARM:
            return None
        for posture in [start] if start is not None else postures(place):
            found = self.arm.solve(place, torso, posture, direction=direction, level=level)
            if found is not None:
                return found
        return None

    def follows(
        self, front: Front, spot: Float64, positions: tuple[float, float], T_map_base: Float64, torso: float
    ) -> float | None:
        """Whether the arm can hold on while a joint goes from one position to another and the base follows it.

        Args:
            front: what is moved.
            spot: (3,), where it is held, with the joint at 0, map frame.
            positions: of the joint, from and to.
            T_map_base: (4, 4), where the robot begins.
            torso: lift, metres.

        Returns:
            How far the cup has to lean at most, radians; None if it cannot be done.
        """
        joints, worst = None, 0.0
        for q in np.linspace(*positions, WAYPOINTS).tolist():
            T_base_map = inverse(followed(front, spot, positions[0], q, T_map_base))
            place, inwards = front.at(spot, q)
            place, inwards = apply(T_base_map, place[None])[0], T_base_map[:3, :3] @ inwards
            if joints is None:
                begun = self.approach(place, inwards, torso)
                if begun is None:
                    return None
                joints = begun[1]
                continue
            found = self.aim(place, inwards, torso, LEANING, joints)
            if found is None:
                return None
            joints, worst = found[0], max(worst, abs(found[1]))
        return worst


def followed(front: Front, spot: Float64, begin: float, position: float, T_map_base: Float64) -> Float64:
    """(4, 4) where the base stands that goes straight along with a spot that was at `begin` when it set out."""
    moved = front.at(spot, position)[0] - front.at(spot, begin)[0]
    out = T_map_base.copy()
    out[:2, 3] += float(moved[:2] @ T_map_base[:2, 0]) * T_map_base[:2, 0]
    return out


def turned(direction: Float64, angle: float) -> Float64:
    """(3,) turned about the vertical, radians."""
    return transform_planar(0.0, 0.0, angle)[:3, :3] @ direction


def postures(place: Float64) -> Iterator[dict[str, float]]:
    """Where the search for joint angles begins that bring the cup to a place in front of the robot."""
    bearing = float(np.arctan2(place[1], place[0] - SHOULDER))
    for shoulder, elbow, wrist, aside in (
        (-0.7, 1.6, -0.9, 0.0), (-1.05, 2.4, -1.35, 0.0), (-0.3, 1.2, -0.9, 0.0), (0.3, 1.0, -1.3, 0.0),
        (-0.7, 1.6, -0.9, 0.6), (-0.7, 1.6, -0.9, -0.6),
    ):  # fmt: skip
        yield {
            **LEVEL, "arm_1_joint": bearing + aside, "arm_2_joint": shoulder, "arm_3_joint": 0.8 * aside,
            "arm_4_joint": elbow, "arm_6_joint": wrist,
        }  # fmt: skip


def heading(T_map_base: Float64) -> Float64:
    """(3,) where the base looks, map frame."""
    return turned(np.array([1.0, 0.0, 0.0]), yaw_of(T_map_base))
