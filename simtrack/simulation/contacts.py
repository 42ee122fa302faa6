"""Who touches whom, and who stands on whom, from MuJoCo's contacts."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from simtrack.contracts import Bool, Int32

if TYPE_CHECKING:
    import mujoco

SUPPORTING = 0.5
"""Cosine between a contact's normal and the vertical above which one thing stands on the other."""


def contact_pairs(data: "mujoco.MjData", owners: Int32, movable: Bool) -> tuple[np.ndarray, np.ndarray]:
    """Contacts in the state of `data` that a movable thing takes part in.

    Args:
        data: after `mj_forward` or a step.
        owners: (ngeom,), number of the thing each geom belongs to; -1 = no thing.
        movable: (N,), whether a thing can be carried.

    Returns:
        (S, 2) pairs (carried, carrier) of direct contacts from above, and (T, 2) pairs (lower number first) that touch
        anyhow; each pair once, ascending.
    """
    contact = data.contact
    pairs = owners[contact.geom].reshape(-1, 2)
    real = (pairs >= 0).all(axis=1) & (contact.dist <= 0.0) & (pairs[:, 0] != pairs[:, 1])
    first, second, up = pairs[real, 0], pairs[real, 1], contact.frame[real, 2]
    real = movable[first] | movable[second]
    first, second, up = first[real].astype(np.int64), second[real].astype(np.int64), up[real]
    # The normal points from the first geom to the second.
    above, below = np.where(up > 0, second, first), np.where(up > 0, first, second)
    stands = (np.abs(up) > SUPPORTING) & movable[above]
    base = len(movable)
    supports = np.unique((above * base + below)[stands])
    touches = np.unique(np.minimum(first, second) * base + np.maximum(first, second))
    return np.stack(np.divmod(supports, base), axis=1), np.stack(np.divmod(touches, base), axis=1)


def support_tree(
    data: "mujoco.MjData", owners: Int32, movable: Bool, names: Sequence[str]
) -> tuple[tuple[str, str], ...]:
    """(carried, carrier) by name, see `contact_pairs`."""
    supports, _ = contact_pairs(data, owners, movable)
    return tuple((names[int(carried)], names[int(carrier)]) for carried, carrier in supports.tolist())
