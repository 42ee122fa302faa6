"""Joints of the CAD catalogue and of the rooms' families move through their range without running into anything."""

import numpy as np
import pytest

from simtrack.objects.cad import CadModel, cad_models
from simtrack.simulation.building.rooms.families import FAMILIES
from simtrack.simulation.building.rooms.physics import add_model
from simtrack.simulation.building.rooms.plan import PlacedModel


def deepest(model: CadModel, joint: str, positions: np.ndarray) -> float:
    """Deepest penetration between parts of a model while one joint moves, metres."""
    import mujoco

    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    add_model(spec, PlacedModel("thing", model, np.eye(4), {}))
    compiled = spec.compile()
    compiled.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_FILTERPARENT  # a door and its carcass are tested too
    data, worst = mujoco.MjData(compiled), 0.0
    for position in positions:
        mujoco.mj_resetData(compiled, data)
        data.joint(f"thing/{joint}").qpos[0] = position
        mujoco.mj_forward(compiled, data)
        worst = max(worst, *(-data.contact.dist)) if data.ncon else worst
    return worst


@pytest.mark.parametrize("semantic_class", ["microwave", "fridge"])
def test_catalogue(semantic_class: str) -> None:
    for model in cad_models(semantic_class):
        for joint in model.joints:
            assert deepest(model, joint.name, np.linspace(joint.lower, joint.upper, 8)) < 1e-4, (model.name, joint.name)


@pytest.mark.parametrize("family", ["cabinet", "counter", "fridge", "microwave", "wall cabinet"])
def test_families(family: str) -> None:
    model = FAMILIES[family](np.random.default_rng(3)).finish(family)
    for joint in model.joints:
        assert deepest(model, joint.name, np.linspace(joint.lower, joint.upper, 8)) < 1e-4, joint.name


def test_a_door_that_opens_inwards_is_found() -> None:
    model = cad_models("fridge")[0]
    assert deepest(model, model.joints[0].name, np.array([-0.5])) > 0.005
