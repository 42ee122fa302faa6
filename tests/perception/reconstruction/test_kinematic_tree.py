"""The kinematic tree is the scaled models: same surface at every joint position, physics scaled with alpha."""

from pathlib import Path
from shutil import which
from subprocess import run

import numpy as np
import pytest
from corner import at, block, corner, cupboard_model, table_mesh, table_model

from simtrack.geometry.transforms import apply
from simtrack.perception.reconstruction.body_tree import BodyTree
from simtrack.perception.reconstruction.candidates import CadCandidate
from simtrack.perception.reconstruction.files import write_scene
from simtrack.perception.reconstruction.kinematic_tree import kinematic_tree
from simtrack.perception.scene_graph.contact import ContactGraph

MODEL, SCALE = cupboard_model(), 1.2
SEEN = {"door-joint": 0.4, "drawer-joint": 0.1}


@pytest.fixture(scope="module")
def cabinet() -> CadCandidate:
    return CadCandidate(MODEL, at(0.5, -0.3, SCALE * 0.41, yaw=0.7), SCALE, SEEN)


@pytest.fixture(scope="module")
def graph(cabinet: CadCandidate) -> ContactGraph:
    return corner(
        cabinet=("cabinet", cabinet.mesh()),
        table=("table", table_mesh((1.0, 0.6, 0.7), (-1.0, 0.0, 0.0))),
        cup=("cup", block((0.08, 0.08, 0.1), (-1.0, 0.0, 0.7))),
        picture=("picture", block((0.6, 0.03, 0.4), (0.0, 1.97, 1.4))),
    )


@pytest.fixture(scope="module")
def tree(graph: ContactGraph, cabinet: CadCandidate) -> BodyTree:
    small = table_model("other-small", (0.1, 0.1, 0.1))
    chosen = {
        "cabinet": cabinet,
        "table": CadCandidate(table_model("table-test", (1.0, 0.6, 0.7)), at(-1.0, 0.0, 0.35), 1.0),
        "cup": CadCandidate(small, at(-1.0, 0.0, 0.75), 1.0),
        "picture": CadCandidate(small, at(0.0, 1.95, 1.5), 1.0),
    }
    return kinematic_tree("corner", graph, chosen)


@pytest.mark.parametrize(
    "moved", [{}, {"door-joint": 1.1}, {"drawer-joint": -0.05}, {"door-joint": -0.4, "drawer-joint": 0.1}]
)
def test_forward_kinematics_are_those_of_the_scaled_model(tree: BodyTree, cabinet: CadCandidate, moved: dict) -> None:
    """Zero is where a joint was seen; an opening of the model by q is one of alpha q where it slides."""
    lengths = {"door-joint": 1.0, "drawer-joint": SCALE}
    poses = tree.forward({f"cabinet/{joint}": lengths[joint] * step for joint, step in moved.items()})
    expected = CadCandidate(MODEL, cabinet.T_map_model, SCALE, {j: SEEN[j] + moved.get(j, 0.0) for j in SEEN})
    found = []
    for part in MODEL.parts:
        name = "cabinet" if part.name == "body" else f"cabinet/{part.name}"
        visual = tree.by_name[name].visual
        assert visual is not None
        found.append(apply(poses[name], visual.vertices))
    np.testing.assert_allclose(np.concatenate(found), expected.mesh().vertices, atol=1e-9)


def test_ranges_reach_what_the_model_can(tree: BodyTree) -> None:
    door, drawer = (tree.joints[f"cabinet/{name}"].joint for name in ("door-joint", "drawer-joint"))
    assert door is not None and drawer is not None
    assert (door.lower, door.upper) == pytest.approx((-0.4, 1.2))
    assert (drawer.lower, drawer.upper) == pytest.approx((-0.1 * SCALE, 0.15 * SCALE))


def test_mass_grows_with_the_cube_and_inertia_with_the_fifth_power(tree: BodyTree) -> None:
    for part in MODEL.parts:
        body = tree.by_name["cabinet" if part.name == "body" else f"cabinet/{part.name}"]
        assert body.mass == pytest.approx(part.mass * SCALE**3)
        assert body.inertia is not None
        np.testing.assert_allclose(body.inertia, part.inertia * SCALE**5)


def test_a_hand_lifts_the_cup_but_no_furniture_and_nothing_that_hangs(tree: BodyTree) -> None:
    joints = {body.name: body.joint for body in tree.bodies if body.joint is not None}
    kinds = {name: (joint.kind, joint.parent) for name, joint in joints.items()}
    assert kinds["cup"] == ("floating", "table")
    assert kinds["table"] == ("fixed", "floor")
    assert kinds["cabinet"] == ("fixed", "floor")
    assert kinds["picture"] == ("fixed", "wall")
    assert kinds["floor"] == ("fixed", "scene")
    assert kinds["cabinet/door"] == ("revolute", "cabinet")


def test_all_files_of_it_are_read(tree: BodyTree, tmp_path: Path) -> None:
    import mujoco
    import yourdfpy

    files = write_scene(tree, tmp_path)
    robot = yourdfpy.URDF.load(str(files.urdf), build_scene_graph=False, load_meshes=False)
    assert set(robot.link_map) == {body.name for body in tree.bodies}
    model = mujoco.MjModel.from_xml_path(str(files.mjcf))
    assert {model.joint(k).name for k in range(model.njnt)} == {
        "cabinet/door-joint",
        "cabinet/drawer-joint",
        "cup/free",
    }
    if which("check_urdf") is None:
        pytest.skip("liburdfdom-tools are not installed")
    checked = run(["check_urdf", str(files.urdf)], capture_output=True, text=True, check=False)
    assert "Successfully Parsed XML" in checked.stdout, checked.stderr
