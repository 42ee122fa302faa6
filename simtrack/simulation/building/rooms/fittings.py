"""What hangs on walls and leans against them: pictures, shelves, wall cabinets, boards.

What hangs has a batten at its back, flush with its rear side, behind which there is a gap: it is hooked over a cleat of
the wall, a rail with a lip, and stays there by its own weight.
"""

from dataclasses import dataclass

import numpy as np

from simtrack.contracts import Float64
from simtrack.geometry.transforms import transform
from simtrack.objects.cad.builder import ModelBuilder
from simtrack.objects.cad.designs.pieces import carcass, door
from simtrack.objects.cad.materials import GREY_BOARD, OAK, PAPER, PINE, WALNUT, WHITE_BOARD, Material
from simtrack.objects.cad.model import CadModel

BATTEN, GAP, DROP = 0.010, 0.013, 0.06
"""Metres: thickness of a batten, least free depth before it, its lower edge below the top of what hangs."""
_LIP, _RISE, _RAIL, _PLAY = 0.005, 0.012, 0.006, 0.002
"""Metres: thickness of a cleat's lip, its height above the rail, thickness of the rail, play of the batten."""
_WOODS = (OAK, PINE, WALNUT, WHITE_BOARD)


def _wood(rng: np.random.Generator, materials: tuple[Material, ...] = _WOODS) -> Material:
    return materials[int(rng.integers(len(materials)))]


def picture(rng: np.random.Generator) -> ModelBuilder:
    """A painted panel in a frame of four rails."""
    b, wood = ModelBuilder("picture", "picture in a frame"), _wood(rng)
    p, x, h, y, rail = b.part(), rng.uniform(0.16, 0.42), rng.uniform(0.28, 0.62), 0.017, rng.uniform(0.022, 0.03)
    r, g, c = (int(v) for v in rng.integers(40, 215, 3))
    p.block((-x + rail, -y + 0.003, rail), (x - rail, y - BATTEN - GAP, h - rail), PAPER.painted((r, g, c)))
    for s in (-1, 1):
        p.block((s * x, -y, 0.0), (s * (x - rail), y, h), wood)
    p.block((-x + rail, -y, 0.0), (x - rail, y, rail), wood)
    p.block((-x + rail, -y, h - rail), (x - rail, y, h), wood)
    p.block((-x + rail, y - BATTEN, h - DROP), (x - rail, y, h - rail), wood)
    return b


def wall_shelf(rng: np.random.Generator) -> ModelBuilder:
    """One board between two cheeks below a rear panel."""
    b, wood = ModelBuilder("shelf", "wall shelf of one board"), _wood(rng)
    p, x, y, h, t = b.part(), rng.uniform(0.26, 0.48), rng.uniform(0.09, 0.12), rng.uniform(0.16, 0.24), 0.018
    panel = y - BATTEN - GAP
    p.block((-x, -y, 0.0), (x, y, t), wood)
    p.block((-x, panel - 0.012, t), (x, panel, h), wood)
    p.block((-x, panel, h - 0.03), (x, y, h), wood)
    p.block((-x + t, y - BATTEN, h - DROP), (x - t, y, h - 0.03), wood)
    for s in (-1, 1):
        p.block((s * x, -y, t), (s * (x - t), panel - 0.012, 0.5 * h), wood)
    depth = panel - 0.012 + y
    b.support(p, (0.0, -y + depth / 2, t), (2 * (x - t), depth))
    return b


def wall_cabinet(rng: np.random.Generator) -> ModelBuilder:
    """A box with one door and one shelf, its rear panel let in."""
    b, wood = ModelBuilder("cabinet", "wall cabinet"), _wood(rng, (WHITE_BOARD, GREY_BOARD, OAK))
    p, x, y, h, t = b.part(), rng.uniform(0.2, 0.34), rng.uniform(0.13, 0.17), rng.uniform(0.48, 0.68), 0.018
    panel = y - BATTEN - GAP
    carcass(p, (-x, x), (-y, y), (0.0, h), t, wood, back=False)
    p.block((-x + t, panel - 0.008, t), (x - t, panel, h - t), wood)
    p.block((-x + t, y - BATTEN, h - DROP), (x - t, y, h - t), wood)
    middle = rng.uniform(0.45, 0.55) * h
    p.block((-x + t, -y + 0.02, middle - 0.008), (x - t, panel - 0.008, middle + 0.008), wood)
    b.hollow(p, (-x + t, -y + 0.02, t), (x - t, panel - 0.008, middle - 0.008))
    b.hollow(p, (-x + t, -y + 0.02, middle + 0.008), (x - t, panel - 0.008, h - t))
    b.support(p, (0.0, 0.0, h), (2 * x, 2 * y))
    side = "left" if rng.random() < 0.5 else "right"
    door(b, "door", (-x, x), (0.0, h), -y, side, wood, thickness=0.018, grip=(0.06, 0.2))
    return b


def board(rng: np.random.Generator) -> ModelBuilder:
    """A plank."""
    b = ModelBuilder("board", "plank")
    x, y, h = rng.uniform(0.12, 0.24), rng.uniform(0.01, 0.015), rng.uniform(0.9, 1.4)
    b.part().block((-x, -y, 0.0), (x, y, h), _wood(rng))
    return b


@dataclass(frozen=True, slots=True, eq=False)
class Cleat:
    """What a thing hangs on: boxes that are part of a wall."""

    thing: str
    """Name of what hangs."""
    wall: str
    """Name of the wall."""
    boxes: tuple[tuple[Float64, Float64], ...]
    """(T_map_box (4, 4), full side lengths (3,)): rail and lip."""


def cleat(thing: str, wall: str, model: CadModel, T_map_model: Float64) -> Cleat:
    """The cleat for a thing that hangs with its rear side in a wall's face."""
    width, rear, top = 0.6 * model.extents[0], model.extents[1] / 2, model.extents[2] / 2
    reach, level = BATTEN + _PLAY + _LIP, top - DROP
    spans = (
        ((rear - reach, rear), (level - _RAIL, level)),
        ((rear - reach, rear - reach + _LIP), (level, level + _RISE)),
    )
    boxes = []
    for (y0, y1), (z0, z1) in spans:
        T = T_map_model @ transform(None, np.array([0.0, (y0 + y1) / 2, (z0 + z1) / 2]))
        boxes.append((T, np.array([width, y1 - y0, z1 - z0])))
    return Cleat(thing, wall, tuple(boxes))
