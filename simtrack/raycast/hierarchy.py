"""Embree's side of a scene: the instances under one RTCScene, and the ground beside it."""

import weakref
from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from simtrack.contracts import Float64
from simtrack.geometry.transforms import inverse
from simtrack.raycast import embree as rtc
from simtrack.raycast import instancing
from simtrack.raycast.mesh import TriangleMesh
from simtrack.raycast.table import InstanceTable

_MAX_LISTED = 256
"""Kernels look at instances one by one, to see which rays may meet them, up to this number of them."""
_MUCH_LARGER = 2.0
"""Times the bounding radius of the next largest instance from which on an instance is the ground."""
_IDENTITY = np.eye(4)


class Hierarchy:
    """Keeps Embree in step with the instances of a scene, which tells it of every change and when to commit."""

    def __init__(
        self, meshes: Mapping[int, TriangleMesh], motions: Mapping[int, Float64], table: InstanceTable
    ) -> None:
        """Create an empty hierarchy.

        Args:
            meshes: by instance id; the scene's, which changes.
            motions: (K, 4, 4) keys of the instances that move, by id; the scene's.
            table: the scene's.

        Raises:
            RaycastError: the library cannot be used.
        """
        self._meshes, self._motions, self._table = meshes, motions, table
        api = rtc.embree().api
        self._top: int = api.rtcNewScene(rtc.embree().device)
        api.rtcSetSceneFlags(self._top, rtc.RTC_SCENE_FLAG_DYNAMIC)
        rtc.embree().check("rtcNewScene")
        self._ground: int | None = None
        self._others = np.zeros(0, np.int32)
        self.world: tuple[object, ...] = ()
        """The fields of `kernels.World`, as of the last commit."""
        self.release = weakref.finalize(self, api.rtcReleaseScene, self._top)
        """Give Embree's memory back; done at the latest when nobody holds this object."""

    def attach(self, numbers: npt.NDArray[np.int64]) -> None:
        """Put instances under the RTCScene."""
        table, geometries = self._table, np.zeros(len(numbers), np.int64)
        scenes = np.array([self._meshes[number].scene_handle for number in numbers.tolist()], np.int64)
        columns = instancing.columns(table.poses[numbers])
        instancing.place(rtc.embree().device, self._top, scenes, numbers, columns, geometries)
        rtc.embree().check("rtcAttachGeometryByID")
        table.handles[numbers] = geometries
        for number in numbers[~table.enabled[numbers]].tolist():
            self.show(number)
        for number in self._motions.keys() & set(numbers.tolist()):
            self.set_off(np.array([number]), self._motions[number][None])

    def detach(self, numbers: npt.NDArray[np.int64]) -> None:
        """Take instances out; the ground too may be among them."""
        held = numbers[self._table.handles[numbers] != 0]
        if len(held):
            self._table.handles[held] = 0
            instancing.detach(self._top, held)
            rtc.embree().check("rtcDetachGeometry")
        if self._ground in numbers:
            self._ground = None

    def move(self, numbers: npt.NDArray[np.int64]) -> None:
        """Tell of new poses of instances at rest."""
        instancing.move(self._table.handles, numbers, self._table.poses)

    def set_off(self, numbers: npt.NDArray[np.int64], keys: Float64) -> None:
        """Tell of the motion of instances (N,) through as many keys (N, K, 4, 4) each."""
        held = self._table.handles[numbers] != 0
        transforms = instancing.columns(keys[held].reshape(-1, 4, 4)).reshape(-1, keys.shape[1], 12)
        instancing.set_off(self._table.handles[numbers[held]], transforms)

    def show(self, number: int) -> None:
        """Tell whether an instance is enabled."""
        geometry = int(self._table.handles[number])
        if geometry:
            api = rtc.embree().api
            (api.rtcEnableGeometry if self._table.enabled[number] else api.rtcDisableGeometry)(geometry)
            api.rtcCommitGeometry(geometry)

    def commit(self) -> None:
        """Make changes effective.

        Raises:
            RaycastError: Embree could not build the hierarchy, or refused one of the changes.
        """
        table = self._table
        if table.members_changed:
            self._choose_ground()
            others = table.enabled.copy()
            if self._ground is not None:
                others[self._ground] = False
            self._others = np.flatnonzero(others).astype(np.int32)
        device = rtc.embree()
        device.api.rtcCommitScene(self._top)
        device.check("rtcCommitScene")
        table.members_changed = False
        ground, T_ground_map = (0, -1), _IDENTITY
        if self._ground is not None:
            ground = self._meshes[self._ground].scene_handle, self._ground
            T_ground_map = inverse(table.poses[self._ground])
        listed = self._others if len(self._others) <= _MAX_LISTED else self._others[:0]
        tables = listed, table.rows, table.motion, table.keys
        self.world = (self._top if len(self._others) else 0, *ground, T_ground_map, *tables)

    def _choose_ground(self) -> None:
        """An instance much larger than all others leaves the RTCScene, if it is rigid; what was the ground returns."""
        table = self._table
        radii = np.where(table.enabled, table.rows[:, 12], np.float32(0.0))
        best = int(np.argmax(radii)) if len(radii) else -1
        ground = None
        if best >= 0 and table.enabled[best] and table.rigid[best]:
            largest, radii[best] = radii[best], 0.0
            ground = best if largest > _MUCH_LARGER * radii.max() else None
        if ground == self._ground:
            return
        former, self._ground = self._ground, ground
        if former is not None:
            self.attach(np.array([former]))
        if ground is not None:
            instancing.detach(self._top, np.array([ground]))
            table.handles[ground] = 0
