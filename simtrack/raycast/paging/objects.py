"""Where ten million objects stand: compact arrays that answer which objects a region holds."""

import numpy as np
import numpy.typing as npt

from simtrack.contracts import Float64, Int32
from simtrack.errors import InvalidValueError
from simtrack.geometry.transforms import is_rigid, quaternion_from_rotation
from simtrack.raycast.paging import object_kernels as kernels
from simtrack.raycast.paging.regions import Regions

EVERYWHERE = -1
"""Region of objects that belong to no region: a `PagedScene` keeps them live always."""
_REMOVED = -2


class ObjectIndex:
    """Model, region and pose of every object, 38 bytes each, and the objects of every region as linked lists.

    Positions are kept in float32 from the lower corner of the region's box, which makes them as exact kilometres from
    the map's origin as near it. Ids are rows: 0 to N - 1 in the order given, and on from there for objects added.
    """

    def __init__(
        self,
        regions: Regions,
        bounds: npt.ArrayLike,
        models: npt.ArrayLike,
        region_of: npt.ArrayLike,
        positions: npt.ArrayLike,
        quaternions: npt.ArrayLike,
        spare: int = 0,
    ) -> None:
        """Index objects. Arrays of the right dtype and no `spare` are taken over, not copied.

        Args:
            regions: the regions.
            bounds: (M, 2, 3) lower and upper corner of each model's box, in the model's frame, metres.
            models: (N,) uint16, rows of `bounds`.
            region_of: (N,) int32, the region that holds the object, or `EVERYWHERE`.
            positions: (N, 3) float32 of the models' origins, metres, axes of the map, from the lower corner of the
                region's box (of the map frame for `EVERYWHERE`).
            quaternions: (N, 4) float32 wxyz, map from object.
            spare: rows to reserve for objects that are added later.

        Raises:
            InvalidValueError: wrong shapes, a model or region that is not there, or a pose that is not finite.
        """
        self.regions = regions
        self._bounds = np.array(bounds, np.float64)
        if self._bounds.ndim != 3 or self._bounds.shape[1:] != (2, 3):
            raise InvalidValueError("bounds", self._bounds.shape, "(M, 2, 3)")
        count = len(np.asarray(models))
        self._count = count
        size = count + spare
        if size > np.iinfo(np.int32).max:
            raise InvalidValueError("models, spare", (count, spare), "no more than 2^31 - 1 objects in all")
        self._models = _column(models, np.uint16, (), count, size, "models")
        self._regions = _column(region_of, np.int32, (), count, size, "region_of")
        self._positions = _column(positions, np.float32, (3,), count, size, "positions")
        self._quaternions = _column(quaternions, np.float32, (4,), count, size, "quaternions")
        self._check_rows()
        self._head = np.full(len(regions) + 1, -1, np.int32)
        self._next = np.full(size, -1, np.int32)
        kernels.link(self._regions[:count], self._head, self._next)
        self.overhang = self._overhang(0, count)
        """Metres: how far from its portals an object can be seen that sticks out of its region; never shrinks."""

    @staticmethod
    def from_poses(
        regions: Regions, bounds: npt.ArrayLike, models: npt.ArrayLike, T_map_objects: npt.ArrayLike, spare: int = 0
    ) -> "ObjectIndex":
        """Index objects by their poses; each belongs to the region that holds its box's centre, or to `EVERYWHERE`.

        Args:
            regions: the regions.
            bounds: (M, 2, 3), see `ObjectIndex`.
            models: (N,) rows of `bounds`.
            T_map_objects: (N, 4, 4), rigid.
            spare: rows to reserve for objects that are added later.
        """
        poses = np.asarray(T_map_objects, np.float64).reshape(-1, 4, 4)
        for number, T in enumerate(poses):
            _check_pose(T, f"T_map_objects[{number}]")
        numbers, middle = np.asarray(models, np.int64), np.asarray(bounds, np.float64).mean(axis=1)
        if numbers.shape != (len(poses),) or (numbers < 0).any() or (numbers >= len(middle)).any():
            raise InvalidValueError("models", numbers.shape, f"({len(poses)},) of 0..{len(middle) - 1}")
        region_of = regions.locate(np.einsum("nij,nj->ni", poses[:, :3, :3], middle[numbers]) + poses[:, :3, 3])
        corner = np.where((region_of >= 0)[:, None], regions.low[region_of], 0.0)
        quaternions = np.array([quaternion_from_rotation(T[:3, :3]) for T in poses]).reshape(-1, 4)
        return ObjectIndex(regions, bounds, models, region_of, poses[:, :3, 3] - corner, quaternions, spare)

    def __len__(self) -> int:
        """Number of ids given out, objects removed since included."""
        return self._count

    @property
    def nbytes(self) -> int:
        """Bytes of all arrays."""
        rows = self._models, self._regions, self._positions, self._quaternions, self._next
        return sum(array.nbytes for array in rows) + self._head.nbytes

    @property
    def bounds(self) -> Float64:
        """(M, 2, 3), lower and upper corner of each model's box, model frame, metres."""
        return self._bounds

    def members(self, region: int) -> npt.NDArray[np.int64]:
        """(K,) ids of the objects of a region (or of `EVERYWHERE`), ascending."""
        if region != EVERYWHERE:
            self.regions.check_region(region)
        return kernels.members(region, self._head, self._next)

    def region(self, number: int) -> int:
        """Region of an object, or `EVERYWHERE`."""
        self._check(number)
        return int(self._regions[number])

    def models(self, numbers: npt.ArrayLike) -> Int32:
        """(K,) models of objects."""
        return self._models[self._rows(numbers)].astype(np.int32)

    def pose(self, number: int) -> Float64:
        """(4, 4) T_map_object of an object."""
        return self.poses([number])[0]

    def poses(self, numbers: npt.ArrayLike) -> Float64:
        """(K, 4, 4) T_map_object of objects."""
        rows = self._rows(numbers)
        return kernels.poses(rows, self.regions.low, self._regions, self._positions, self._quaternions)

    def move(self, number: int, T_map_object: npt.ArrayLike) -> int:
        """Give an object a pose; returns its region.

        It stays in its region if that still holds the centre of its box, else goes to the lowest region that does, or
        to `EVERYWHERE` if none does.

        Raises:
            InvalidValueError: no such object, or the pose is not rigid.
        """
        self._check(number)
        T = _check_pose(T_map_object, "T_map_object")
        old = int(self._regions[number])
        candidates = self._belongs(int(self._models[number]), T)
        new = old if old in candidates else int(candidates[0]) if len(candidates) else EVERYWHERE
        if new != old:
            kernels.unlink(number, old, self._head, self._next)
            kernels.insert(number, new, self._head, self._next)
        self._write(number, new, T)
        return new

    def add(self, model: int, T_map_object: npt.ArrayLike) -> int:
        """Put an object into the lowest region that holds the centre of its box, else `EVERYWHERE`; returns its id.

        Raises:
            InvalidValueError: no such model, the pose is not rigid, or no row is left (see `spare`).
        """
        T = _check_pose(T_map_object, "T_map_object")
        if not 0 <= model < len(self._bounds):
            raise InvalidValueError("model", model, f"0..{len(self._bounds) - 1}")
        if self._count == len(self._models):
            raise InvalidValueError(
                "spare", "no row left", f"more spare rows than were reserved for {self._count} objects"
            )
        number = self._count
        self._count += 1
        self._models[number] = model
        candidates = self._belongs(model, T)
        region = int(candidates[0]) if len(candidates) else EVERYWHERE
        kernels.insert(number, region, self._head, self._next)
        self._write(number, region, T)
        return number

    def remove(self, number: int) -> None:
        """Take an object out; its id is not given to another."""
        self._check(number)
        kernels.unlink(number, int(self._regions[number]), self._head, self._next)
        self._regions[number] = _REMOVED

    def _write(self, number: int, region: int, T: Float64) -> None:
        corner = self.regions.low[region] if region >= 0 else np.zeros(3)
        self._regions[number] = region
        self._positions[number] = T[:3, 3] - corner
        self._quaternions[number] = quaternion_from_rotation(T[:3, :3])
        self.overhang = max(self.overhang, self._overhang(number, number + 1))

    def _overhang(self, first: int, last: int) -> float:
        boxes = self._bounds, self.regions.low, self.regions.high
        rows = self._models, self._regions, self._positions, self._quaternions
        return float(kernels.overhang(first, last, *boxes, *rows))

    def _belongs(self, model: int, T: Float64) -> Int32:
        """(K,) regions that hold the centre of a model's box at a pose, ascending."""
        return self.regions.containing(T[:3, :3] @ self._bounds[model].mean(axis=0) + T[:3, 3])

    def _check(self, number: int) -> None:
        if not 0 <= number < self._count or self._regions[number] == _REMOVED:
            raise InvalidValueError("object", number, f"0..{self._count - 1} and not one that was removed")

    def _rows(self, numbers: npt.ArrayLike) -> npt.NDArray[np.int64]:
        rows = np.asarray(numbers, np.int64).reshape(-1)
        wrong = (rows < 0) | (rows >= self._count)
        wrong[~wrong] = self._regions[rows[~wrong]] == _REMOVED
        if wrong.any():
            self._check(int(rows[wrong][0]))
        return rows

    def _check_rows(self) -> None:
        models, regions, count = self._models[: self._count], self._regions[: self._count], self._count
        if not count:
            return
        if models.max() >= len(self._bounds):
            raise InvalidValueError("models", int(models.max()), f"0..{len(self._bounds) - 1}")
        if regions.min() < EVERYWHERE or regions.max() >= len(self.regions):
            extremes = int(regions.min()), int(regions.max())
            raise InvalidValueError("region_of", extremes, f"{EVERYWHERE} or 0..{len(self.regions) - 1}")
        bad = int(kernels.first_bad_pose(self._positions[:count], self._quaternions[:count]))
        if bad >= 0:
            value = (self._positions[bad].tolist(), self._quaternions[bad].tolist())
            raise InvalidValueError(f"pose of object {bad}", value, "finite, with a unit quaternion")


def _column(
    values: npt.ArrayLike, kind: type[np.generic], shape: tuple[int, ...], count: int, size: int, name: str
) -> np.ndarray:
    """`values` as (size, *shape) of a dtype, checked; the same array if it is one already."""
    given = np.asarray(values)
    if given.shape != (count, *shape):
        raise InvalidValueError(name, given.shape, f"{(count, *shape)}")
    if issubclass(kind, np.integer) and count:
        limits = np.iinfo(kind)
        if not np.issubdtype(given.dtype, np.integer):
            raise InvalidValueError(name, given.dtype, "integers")
        if given.min() < limits.min or given.max() > limits.max:
            raise InvalidValueError(name, (int(given.min()), int(given.max())), f"{limits.min}..{limits.max}")
    if size == count:
        return np.ascontiguousarray(given, kind)
    out = np.zeros((size, *shape), kind)
    out[:count] = given
    return out


def _check_pose(T_map_object: npt.ArrayLike, name: str) -> Float64:
    T = np.asarray(T_map_object, np.float64)
    if T.shape != (4, 4) or not np.isfinite(T).all() or not is_rigid(T, 1e-5):
        raise InvalidValueError(name, T.tolist(), "a rigid (4, 4) transform")
    return T
