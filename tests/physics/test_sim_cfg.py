import copy

import mujoco
import pytest

from ksim_rl.physics import SimCfg
from tests.physics.models import cartpole


def test_only_given_settings_are_applied():
    mj_model = copy.copy(cartpole())
    SimCfg(
        timestep=0.004, integrator="implicitfast", solver="cg", impratio=10.0, iterations=7
    ).apply_to(mj_model)
    assert mj_model.opt.timestep == 0.004
    assert mj_model.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    assert mj_model.opt.solver == mujoco.mjtSolver.mjSOL_CG
    assert mj_model.opt.impratio == 10.0
    assert mj_model.opt.iterations == 7
    assert mj_model.opt.cone == cartpole().opt.cone
    assert mj_model.opt.ls_iterations == cartpole().opt.ls_iterations


def test_a_spec_takes_the_settings_too():
    spec = mujoco.MjSpec()
    SimCfg(cone="elliptic", ls_iterations=5).apply_to(spec)
    assert spec.option.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
    assert spec.option.ls_iterations == 5


@pytest.mark.parametrize(
    ("field", "value", "hint"),
    [
        ("timestep", 0.0, r"expected a finite number in \(0"),
        ("timestep", float("nan"), "finite"),
        ("impratio", -1.0, "finite number"),
        ("integrator", "implicit_fast", "did you mean 'implicitfast'"),
        ("solver", "pgs", "valid: cg, newton"),
        ("cone", "elliptical", "did you mean 'elliptic'"),
        ("iterations", 0, "iterations=0"),
        ("iterations", 2.5, "whole number"),
        ("njmax", True, "whole number"),
        ("nconmax", -3, "nconmax=-3"),
        ("require_graphs", 1, "expected true or false"),
        ("nan_guard", "folder", "expected a NanGuardCfg"),
    ],
)
def test_wrong_values_name_the_field_and_what_is_valid(field, value, hint):
    with pytest.raises(ValueError, match=hint) as caught:
        SimCfg(**{field: value})
    assert field in str(caught.value)
