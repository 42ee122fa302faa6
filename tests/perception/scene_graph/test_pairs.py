"""Pairs evaluated where something moved, with bounds in the place of margins, against exact margins of all pairs."""

from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from simtrack.contracts import Float64
from simtrack.geometry.transforms import exp_so3, transform
from simtrack.perception.scene_graph import RELATIONS, Body, Interior, RelationConfig, Shape, box_shape, kernels
from simtrack.perception.scene_graph.bodies import BodyArrays
from simtrack.perception.scene_graph.pairs import PairTable

LOW, HIGH = np.array([0.02, 0.02, 0.02]), np.array([0.3, 0.3, 0.2])


def random_shape(rng: np.random.Generator) -> Shape:
    extents = rng.uniform(LOW, HIGH)
    hollow = Interior(np.zeros(3), 0.9 * extents) if rng.random() < 0.3 else None
    return box_shape(extents, interior=hollow, layout=rng.random() < 0.1)


def random_pose(rng: np.random.Generator, spread: float) -> Float64:
    turn = rng.uniform(-2, 2, 3) if rng.random() < 0.3 else np.array([0.0, 0.0, rng.uniform(-3, 3)])
    # Levels are shared, so that surfaces meet.
    return transform(exp_so3(turn), (*rng.uniform(-spread, spread, 2), rng.choice([0.0, 0.1, 0.2])))


class Crowd:
    """Bodies that move at random, and the masks of all their pairs."""

    def __init__(self, count: int, config: RelationConfig, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        self.config = config
        self.spread = 0.15 * np.sqrt(count)
        self.arrays = BodyArrays({}, config)
        for number in range(count):
            self.arrays.declare(str(number), random_shape(self.rng))
        self.slots = np.array([self.arrays.add(str(n), random_pose(self.rng, self.spread)) for n in range(count)])
        self.table = PairTable()
        self.masks: dict[tuple[int, int], int] = {}

    def update(self, moved: np.ndarray, T_map: Float64) -> None:
        shift = self.arrays.set_poses(moved, T_map)
        self.apply(self.table.update(self.arrays.world, self.slots, moved, shift, self.config.parameters()))

    def drop(self, gone: np.ndarray) -> None:
        self.apply(self.table.drop(self.arrays.world, self.slots, gone))
        self.slots = np.setdiff1d(self.slots, gone)

    def apply(self, changes: np.ndarray) -> None:
        for a, b, old, new in changes.tolist():
            assert self.masks.get((a, b), 0) == old != new
            self.masks[a, b] = new

    def from_scratch(self) -> dict[tuple[int, int], int]:
        pairs = np.array([(a, b) for a in self.slots for b in self.slots if a != b])
        holds = kernels.margin_table(self.arrays.world, pairs, self.config.parameters()) >= 0.0
        return dict(zip(map(tuple, pairs.tolist()), (holds @ (1 << np.arange(len(RELATIONS)))).tolist(), strict=True))


@settings(max_examples=12)
@given(seed=st.integers(0, 2**32 - 1), projection=st.booleans(), strict=st.booleans())
def test_updates_equal_all_pairs_from_scratch(seed: int, projection: bool, strict: bool) -> None:
    config = RelationConfig(leave_margin=0.0, projection=projection, strict=strict)
    crowd = Crowd(40, config, seed)
    crowd.update(crowd.slots, np.stack([random_pose(crowd.rng, crowd.spread) for _ in crowd.slots]))
    for _ in range(4):
        moved = crowd.rng.choice(crowd.slots, 5, replace=False)
        crowd.update(moved, np.stack([random_pose(crowd.rng, crowd.spread) for _ in moved]))
        crowd.drop(crowd.rng.choice(crowd.slots, 2, replace=False))
        expected = crowd.from_scratch()
        assert {pair: mask for pair, mask in crowd.masks.items() if mask} == {p: m for p, m in expected.items() if m}


def test_the_table_grows_and_forgets() -> None:
    crowd = Crowd(160, RelationConfig(leave_margin=0.0), seed=5)
    for _ in range(2):
        crowd.update(crowd.slots, np.stack([random_pose(crowd.rng, crowd.spread) for _ in crowd.slots]))
    related = {pair: mask for pair, mask in crowd.masks.items() if mask}
    assert len(related) > 1024
    assert related == {pair: mask for pair, mask in crowd.from_scratch().items() if mask}
    crowd.drop(crowd.slots)
    assert not any(crowd.masks.values())


@settings(max_examples=60)
@given(seed=st.integers(0, 2**32 - 1), leave=st.sampled_from([0.0, 0.002, 0.02]), enter=st.sampled_from([0.0, 0.005]))
def test_bounds_lie_on_the_side_of_the_margins(seed: int, leave: float, enter: float) -> None:
    """With a limit, margins may be bounds, which decide as the exact ones do: beginning and ending to hold."""
    rng = np.random.default_rng(seed)
    config = replace(RelationConfig(), leave_margin=leave, enter_margin=enter)
    arrays = BodyArrays({"a": random_shape(rng), "b": random_shape(rng)}, config)
    a, b = (arrays.add(name, random_pose(rng, 0.3)) for name in ("a", "b"))
    parameters, limit = config.parameters(), max(leave, enter)
    exact = kernels.margin_table(arrays.world, np.array([(a, b)]), parameters)[0]
    distance = kernels.box_distance(arrays.world, a, b, parameters, limit)
    bounds, t, e = np.empty(len(RELATIONS)), np.empty(3), np.empty(3)
    kernels.pair_margins(arrays.world, a, b, distance, parameters, limit, t, e, bounds)
    for threshold in (-leave, enter):
        np.testing.assert_array_equal(bounds >= threshold, exact >= threshold)
    close = np.abs(bounds) < limit
    np.testing.assert_allclose(bounds[close], exact[close], atol=1e-9)


def test_relations_end_within_the_reach() -> None:
    """No pair outside of the spheres in which pairs are looked for is related."""
    rng = np.random.default_rng(3)
    config = RelationConfig()
    for _ in range(300):
        bodies = [Body(random_shape(rng), random_pose(rng, 1.5)) for _ in range(2)]
        arrays = BodyArrays({str(k): body.shape for k, body in enumerate(bodies)}, config)
        a, b = (arrays.add(str(k), body.T_map) for k, body in enumerate(bodies))
        world = arrays.world
        span = max(world.reach[a] + world.radii[b], world.reach[b] + world.radii[a])
        if np.linalg.norm(world.centres[a] - world.centres[b]) > span:
            margins = kernels.margin_table(world, np.array([(a, b), (b, a)]), config.parameters())
            assert (margins < -config.leave_margin).all()
