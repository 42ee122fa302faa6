import mujoco
import numpy as np

from simtrack.simulation.contacts import contact_pairs, support_tree

STACK = """<mujoco><option gravity='-11 0 -9.81'/><worldbody>
  <geom name='floor' type='plane' size='2 2 .1'/>
  <geom name='wall' type='box' size='.05 1 1' pos='-.25 0 1'/>
  <body pos='0 0 .1'><freejoint/><geom name='low' type='box' size='.2 .1 .1' density='800'/></body>
  <body pos='.05 0 .25'><freejoint/><geom name='high' type='box' size='.05 .05 .05'/></body>
  <body pos='1 0 .5'><freejoint/><geom name='falling' type='sphere' size='.05'/></body>
</worldbody></mujoco>"""


def test_support_follows_contacts_from_above() -> None:
    model = mujoco.MjModel.from_xml_string(STACK)
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, nstep=40)
    names = ["floor", "wall", "low", "high", "falling"]
    owners = np.array([names.index(model.geom(k).name) for k in range(model.ngeom)], np.int32)
    movable = np.array([False, False, True, True, True])
    assert support_tree(data, owners, movable, names) == (("low", "floor"), ("high", "low"))
    _, touching = contact_pairs(data, owners, movable)
    assert touching.tolist() == [[0, 2], [1, 2], [2, 3]]  # the wall is leant on, and carries nothing
    owners[0] = -1
    assert support_tree(data, owners, movable, names) == (("high", "low"),)
    assert support_tree(mujoco.MjData(model), owners, movable, names) == ()


def test_support_does_not_depend_on_which_geom_comes_first() -> None:
    turned = STACK.replace("<geom name='floor' type='plane' size='2 2 .1'/>", "").replace(
        "</worldbody>", "<geom name='floor' type='box' size='2 2 .05' pos='0 0 -.05'/></worldbody>"
    )
    model = mujoco.MjModel.from_xml_string(turned)
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, nstep=40)
    names = sorted(model.geom(k).name for k in range(model.ngeom))
    owners = np.array([names.index(model.geom(k).name) for k in range(model.ngeom)], np.int32)
    movable = np.array([name in ("low", "high", "falling") for name in names])
    assert set(support_tree(data, owners, movable, names)) == {("low", "floor"), ("high", "low")}
