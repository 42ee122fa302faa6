"""What is placed comes to rest on its support, or it is said what does not."""

import numpy as np
import pytest

from simtrack.contracts import Room
from simtrack.datasets.physics import Body, PlacementError, _above, settle
from simtrack.datasets.primitives import box_mapping, primitive
from simtrack.datasets.recipe import PRIMITIVES, ArrangePlacement, DropPlacement, PrimitiveSettings
from simtrack.geometry import meshes
from simtrack.geometry.transforms import apply, is_rigid
from simtrack.objects import load_object
from simtrack.simulation.building import furniture
from simtrack.simulation.building.parts import StaticWorld
from simtrack.simulation.building.shell import room_shell
from simtrack.simulation.placement import Area, outline, separation, support_area

HEIGHT = 0.7


@pytest.fixture(scope="module")
def static() -> StaticWorld:
    corners = np.array([[-2.0, -2.0], [2.0, -2.0], [2.0, 2.0], [-2.0, 2.0]])
    shell = room_shell(Room("room", corners, 0.0, 2.5), {}, ((200, 200, 200), (90, 90, 90)))
    table = furniture.table(0.8, 1.2, HEIGHT).placed("table", 0.3, -0.2, 0.4, room="room")
    return StaticWorld((*(piece.part(1.0) for piece in shell), table))


def area_of(static: StaticWorld, x: float = 0.3, y: float = 0.3) -> Area:
    return support_area(static, "table", 0, (-x, x), (-y, y))


def some_bodies(seed: int) -> list[Body]:
    rng = np.random.default_rng(seed)
    settings = PrimitiveSettings(count=(3, 3), size=(0.04, 0.15))
    bodies = [Body(name, load_object(name), 1.0) for name in ("klt3147", "relay", "mug")]
    bodies += [Body("small mug", load_object("mug"), 0.6)]
    return bodies + [Body(f"shape-{k}", primitive(settings, rng), 1.0) for k in range(3)]


def lowest(body: Body, T: np.ndarray) -> float:
    return float(apply(T, body.scale * body.model.visual.vertices)[:, 2].min())


@pytest.mark.parametrize("seed", range(3))
def test_dropped_things_rest_on_the_table_or_on_one_another(static: StaticWorld, seed: int) -> None:
    bodies = some_bodies(seed)
    settled = settle(static, bodies, area_of(static), DropPlacement(kind="drop"), np.random.default_rng(seed))
    carried = {pair[0] for pair in settled.support}
    assert carried == {body.name for body in bodies}
    resting = dict.fromkeys((below for _, below in settled.support))
    assert "table" in resting
    assert set(resting) <= {"table", *(body.name for body in bodies)}
    for body, T in zip(bodies, settled.poses, strict=True):
        assert is_rigid(T)
        assert lowest(body, T) > HEIGHT - 0.004
        if {below for above, below in settled.support if above == body.name} == {"table"}:
            assert lowest(body, T) < HEIGHT + 0.004


def test_a_crowded_beginning_is_begun_again() -> None:
    """Four crates over a small area often leave no place for the last one; what cannot fit at all is named."""
    area, placement = Area(np.eye(4), (-0.15, 0.15), (-0.15, 0.15), np.full(2, 0.3)), DropPlacement(kind="drop")
    crates = [Body(f"crate-{k}", load_object("klt3147"), 1.0) for k in range(12)]
    reach = np.linalg.norm(crates[0].extents)
    for seed in range(30):
        at = _above(crates[:4], area, placement, range(4), 0.0, np.random.default_rng(seed))[:, :3, 3]
        apart = np.linalg.norm(at[:, None] - at[None], axis=2)[np.triu_indices(4, 1)]
        assert (apart > reach).all()
    with pytest.raises(
        PlacementError, match=r"'crate-\d+' \(box .*fall from, 5 times 200 tries; allowed: a larger area"
    ):
        _above(crates, area, placement, range(12), 0.0, np.random.default_rng(0))


def test_one_stream_gives_the_same_heap(static: StaticWorld) -> None:
    heaps = [
        settle(static, some_bodies(5), area_of(static), DropPlacement(kind="drop"), np.random.default_rng(seed))
        for seed in (1, 1, 2)
    ]
    assert heaps[0].poses.tobytes() == heaps[1].poses.tobytes()
    assert heaps[0].support == heaps[1].support
    assert heaps[0].poses.tobytes() != heaps[2].poses.tobytes()


def test_arranged_things_stand_upright_and_apart(static: StaticWorld) -> None:
    bodies, gap = some_bodies(1)[:4], 0.03
    placement = ArrangePlacement(kind="arrange", separation=gap)
    settled = settle(static, bodies, area_of(static), placement, np.random.default_rng(0))
    assert set(settled.support) == {(body.name, "table") for body in bodies}
    outlines = [outline(body.extents, T) for body, T in zip(bodies, settled.poses, strict=True)]
    for k, one in enumerate(outlines):
        assert settled.poses[k, 2, 2] > 0.999
        assert all(separation(one, other) > gap - 0.003 for other in outlines[:k])


def test_what_finds_no_room_is_named_with_its_size(static: StaticWorld) -> None:
    bodies = [Body(f"crate-{k}", load_object("klt3147"), 1.0) for k in range(9)]
    placement = ArrangePlacement(kind="arrange")
    with pytest.raises(PlacementError, match=r"'crate-\d' \(box 0\.300 x 0\.200 x 0\.147 m\) finds no free place"):
        settle(static, bodies, area_of(static), placement, np.random.default_rng(0))


def test_what_falls_off_is_named_after_a_bounded_number_of_tries(static: StaticWorld) -> None:
    giant = Body("giant", load_object("klt3147"), 6.0)  # 1.8 m long, on a table of 1.2 m, among walls that push it
    small = Area(area_of(static).T_map_face, (-0.01, 0.01), (-0.01, 0.01), np.array([0.02, 0.02]))
    with pytest.raises(PlacementError, match=r"'giant' \(box 1\.800 x .* does not stay on its support, tried 8 times"):
        settle(static, [giant], small, DropPlacement(kind="drop", settle=0.5), np.random.default_rng(3))


@pytest.mark.parametrize("kind", PRIMITIVES)
def test_shapes_are_closed_and_as_large_as_asked(kind: str) -> None:
    for seed in range(5):
        settings = PrimitiveSettings.model_validate({"kinds": [kind], "size": [0.05, 0.12], "count": [1, 1]})
        model = primitive(settings, np.random.default_rng(seed))
        assert meshes.volume(model.mesh) > 0.0
        # a capsule's length is that of its axis, a prism's corners lie on an ellipse
        assert model.extents.max() < 0.12 * (2.0 if kind == "capsule" else 1.001)
        assert model.extents.min() > 0.02
        hulls = [meshes.volume(part) for part in model.collision]
        assert sum(hulls) >= meshes.volume(model.mesh) * 0.999
        if kind != "bracket":
            assert meshes.is_closed(model.mesh)


def test_textures_have_the_same_size_on_all_sides() -> None:
    box = meshes.box_mesh((0.2, 0.3, 0.4))
    uv = box_mapping(box, 0.5, np.random.default_rng(0)).astype(float)
    edges, corners = np.diff(uv, axis=1), np.diff(box.vertices[box.faces], axis=1)
    assert np.allclose(np.linalg.norm(edges, axis=2) * 0.5, np.linalg.norm(corners, axis=2), atol=1e-6)
