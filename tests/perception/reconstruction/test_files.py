"""Written scenes load in every reader and mean the same there."""

import shutil
import subprocess
from pathlib import Path

import mujoco
import numpy as np
import pytest

from simtrack.errors import InvalidValueError
from simtrack.geometry.meshes import box_mesh
from simtrack.geometry.transforms import exp_so3, rotation_from_rpy, rpy_from_rotation, transform
from simtrack.perception.reconstruction.body_tree import Body, BodyJoint, BodyTree, Shape
from simtrack.perception.reconstruction.files import write_scene

ANGLES = {"lid": 0.6, "slide": 0.1}


def tree() -> BodyTree:
    """Turned frames, an off-centre mass with a full inertia, all kinds of joints and shapes."""
    inertia = np.array([[0.3, 0.05, 0.01], [0.05, 0.4, -0.02], [0.01, -0.02, 0.5]])
    turned = transform(exp_so3(np.array([0.1, -0.2, 0.8])), (0.2, 0.1, 0.5))
    axis = np.array([0.6, 0.8, 0.0])
    floor = Body("floor", None, None, (Shape("box", (4.0, 4.0, 0.1), T_body_shape=transform(None, (0, 0, -0.05))),))
    chest = Body(
        "chest <&> 1", BodyJoint("stand", "floating", "floor", turned), box_mesh((0.4, 0.3, 0.2), (200, 10, 10)),
        (Shape("convex", mesh=box_mesh((0.4, 0.3, 0.2))),), 6.0, np.array([0.02, 0.01, -0.03]), inertia, 0.4,
    )  # fmt: skip
    lid = Body(
        "lid", BodyJoint("lid", "revolute", chest.name, turned, axis, -0.5, 1.2, 0.3, 0.1), None,
        (Shape("cylinder", (0.1, 0.02)),), 1.0, None, 0.01 * np.eye(3),
    )  # fmt: skip
    drawer = Body(
        "drawer", BodyJoint("slide", "prismatic", chest.name, turned, axis, 0.0, 0.3), None,
        (Shape("sphere", (0.05,)),), 1.0, None, 0.01 * np.eye(3),
    )  # fmt: skip
    ball = Shape("sphere", (0.04,))
    cup = Body("cup", BodyJoint("in", "floating", "drawer", turned), None, (ball,), 0.2, None, 1e-4 * np.eye(3))
    return BodyTree("scene", (floor, chest, lid, drawer, cup))


def test_check_urdf_accepts_it(tmp_path: Path) -> None:
    program = shutil.which("check_urdf")
    if program is None:
        pytest.skip("check_urdf (liburdfdom-tools) is not installed")
    result = subprocess.run([program, write_scene(tree(), tmp_path).urdf], capture_output=True, text=True, check=False)
    assert result.returncode == 0 and "Successfully Parsed" in result.stdout, result.stdout + result.stderr


def test_mujoco_puts_every_body_where_the_description_has_it(tmp_path: Path) -> None:
    scene = tree()
    model = mujoco.MjModel.from_xml_path(str(write_scene(scene, tmp_path).mjcf))
    data = mujoco.MjData(model)
    for name, position in ANGLES.items():
        data.joint(name).qpos[0] = position
    mujoco.mj_kinematics(model, data)
    moved = scene.forward(ANGLES)
    for body in scene.bodies:
        assert model.body(body.name).mass[0] == pytest.approx(body.mass)
        if body.name == "cup":  # free: the drawer does not carry it
            moved[body.name] = scene.forward()[body.name]
        assert np.allclose(data.body(body.name).xpos, moved[body.name][:3, 3], atol=1e-8)
        assert np.allclose(data.body(body.name).xmat.reshape(3, 3), moved[body.name][:3, :3], atol=1e-8)
    text = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_TEXT, "support:cup")
    start, size = model.text_adr[text], model.text_size[text]
    assert text >= 0 and model.text_data[start : start + size - 1] == b"drawer"
    turned = model.body("chest <&> 1")
    axes = np.empty(9)
    mujoco.mju_quat2Mat(axes, turned.iquat)
    axes = axes.reshape(3, 3)
    assert np.allclose(axes @ np.diag(turned.inertia) @ axes.T, np.asarray(scene.bodies[1].inertia), atol=1e-7)


def test_yourdfpy_reads_the_same_poses_and_moves_the_joints(tmp_path: Path) -> None:
    yourdfpy = pytest.importorskip("yourdfpy")
    scene = tree()
    robot = yourdfpy.URDF.load(str(write_scene(scene, tmp_path).urdf), load_collision_meshes=True)
    robot.update_cfg(ANGLES)
    for name, T in scene.forward(ANGLES).items():
        assert np.allclose(robot.get_transform(name, "floor"), T, atol=1e-7), name


def test_the_folder_can_be_moved(tmp_path: Path) -> None:
    write_scene(tree(), tmp_path / "here", "room")
    shutil.move(tmp_path / "here", tmp_path / "there")
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "there" / "room.xml"))
    assert model.nmesh == 2
    for name in ("room.urdf", "room.xml"):
        assert str(tmp_path) not in (tmp_path / "there" / name).read_text()


def test_the_glb_holds_every_body_with_y_up(tmp_path: Path) -> None:
    import trimesh

    scene = tree()
    loaded = trimesh.load_scene(write_scene(scene, tmp_path).glb)
    turn = transform(exp_so3(np.array([-np.pi / 2, 0.0, 0.0])))
    for name, T in scene.forward().items():
        assert np.allclose(loaded.graph.get(name)[0], turn @ T, atol=1e-6)
    low, high = loaded.bounds
    assert low[1] == pytest.approx(-0.1, abs=1e-6) and high[0] - low[0] == pytest.approx(4.0, abs=1e-5)


def test_the_tree_is_cut_at_floating_joints() -> None:
    scene = tree()
    assert [[body.name for body in part.bodies] for part in scene.components] == [
        ["floor"], ["chest <&> 1", "lid", "drawer"], ["cup"]
    ]  # fmt: skip
    assert [part.support for part in scene.components] == [None, "floor", "drawer"]
    assert scene.below("drawer") == {"drawer", "cup"}


def test_roll_pitch_yaw_round_trip() -> None:
    rng = np.random.default_rng(0)
    for rotation in [*(exp_so3(rng.normal(size=3) * 2.0) for _ in range(200)), rotation_from_rpy(0.3, np.pi / 2, 0.2)]:
        assert np.allclose(rotation_from_rpy(*rpy_from_rotation(rotation)), rotation, atol=1e-7)


def test_wrong_descriptions_are_refused() -> None:
    with pytest.raises(InvalidValueError, match="box, sphere"):
        Shape("cone", (1.0,))  # pyright: ignore[reportArgumentType]
    with pytest.raises(InvalidValueError, match="principal moments"):
        Body("a", mass=1.0, inertia=np.diag([1.0, 1.0, 3.0]))
    with pytest.raises(InvalidValueError, match="lower <= upper"):
        BodyJoint("j", "revolute", "a", np.eye(4), None, 1.0, 0.0)
    with pytest.raises(InvalidValueError, match="earlier in the list"):
        BodyTree("t", (Body("a"), Body("b", BodyJoint("j", "fixed", "c", np.eye(4)))))
    with pytest.raises(InvalidValueError, match="positive mass"):
        BodyTree("t", (Body("a"), Body("b", BodyJoint("j", "continuous", "a", np.eye(4)))))
