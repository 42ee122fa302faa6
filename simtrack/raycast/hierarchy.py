"""Embree's side of a scene: the instances under one RTCScene, and the ground beside it."""

import weakref
from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from simtrack.contracts import Float64
from simtrack.raycast import embree as rtc
from simtrack.raycast import instancing
from simtrack.raycast.mesh import TriangleMesh
from simtrack.raycast.table import InstanceTable

_MAX_LISTED = 256
"""Kernels look at instances one by one, to see which rays may meet them, up to this number of them."""


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
            self.set_off(number)

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
        held = numbers[self._table.handles[numbers] != 0]
        instancing.move(self._table.handles[held], instancing.columns(self._table.poses[held]))

    def set_off(self, number: int) -> None:
        """Tell of an instance's motion."""
        geometry, keys = int(self._table.handles[number]), self._motions[number]
        if geometry:
            api = rtc.embree().api
            api.rtcSetGeometryTimeStepCount(geometry, len(keys))
            for step, columns in enumerate(instancing.columns(keys)):
                layout = rtc.RTC_FORMAT_FLOAT3X4_COLUMN_MAJOR
                api.rtcSetGeometryTransform(geometry, step, layout, columns.ctypes.data)
            api.rtcCommitGeometry(geometry)

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
        if table.ground_stale:
            self._choose_ground()
        if table.members_changed or table.ground_stale:
            others = table.enabled.copy()
            if self._ground is not None:
                others[self._ground] = False
            self._others = np.flatnonzero(others).astype(np.int32)
        rtc.embree().api.rtcCommitScene(self._top)
        rtc.embree().check("rtcCommitScene")
        table.members_changed = table.ground_stale = False
        ground = (0, -1) if self._ground is None else (self._meshes[self._ground].scene_handle, self._ground)
        listed = self._others if len(self._others) <= _MAX_LISTED else self._others[:0]
        self.world = (self._top if len(self._others) else 0, *ground, listed, table.rows, table.motion, table.keys)

    def _choose_ground(self) -> None:
        """The largest enabled instance at the identity leaves the RTCScene; what was the ground returns to it."""
        table = self._table
        candidates = np.flatnonzero(table.enabled & table.unmoved)
        best = int(candidates[np.argmax(table.rows[candidates, 12])]) if len(candidates) else None
        if best == self._ground:
            return
        former, self._ground = self._ground, best
        if former is not None:
            self.attach(np.array([former]))
        if best is not None:
            held = np.array([best])
            instancing.detach(self._top, held)
            table.handles[held] = 0
