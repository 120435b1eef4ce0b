"""Randomization inside an env: at startup, at resets and at intervals, with all that MuJoCo derives from the fields."""

import copy
from collections.abc import Mapping

import mujoco
import numpy as np
import pytest
import torch

from ksim_rl import mdp
from ksim_rl.envs import (
    ManagerBasedRlEnv,
    ManagerBasedRlEnvCfg,
    MjcfRobot,
    ObservationGroupCfg,
    ObservationTermCfg,
    SceneCfg,
)
from ksim_rl.envs.reset_to_default import ResetToDefault
from ksim_rl.envs.term import EventTerm
from ksim_rl.physics import SimCfg
from ksim_rl.scene.actuators import IdealPDActuator
from tests.mdp.randomization.randomize_bench import RUNNER

E = 4
CONSTANTS = ("body_subtreemass", "body_invweight0", "dof_invweight0", "actuator_acc0")
WRITTEN = ("body_mass", "body_inertia", "body_ipos", "dof_armature")


def runner_env(
    events: Mapping[str, EventTerm], *, actuators: tuple = (), decimation: int = 2
) -> ManagerBasedRlEnv:
    """An env of RUNNER with these events after its reset."""
    robot = MjcfRobot(source=RUNNER, actuators=actuators)
    terms = {"joint_pos": ObservationTermCfg(term=mdp.JointPos())}
    return ManagerBasedRlEnv(
        ManagerBasedRlEnvCfg(
            decimation=decimation,
            sim=SimCfg(njmax=60, nconmax=20),
            scene=SceneCfg(robots={"runner": robot}, terrain=None, num_envs=E),
            observations={"actor": ObservationGroupCfg(terms=terms)},
            actions={"hip": mdp.JointPositionAction(joints="left_hip", scale=0.5)},
            events={"reset": ResetToDefault(), **events},
            seed=3,
        )
    )


def fields(env: ManagerBasedRlEnv) -> dict[str, torch.Tensor]:
    """Copies of all fields and constants that differ between worlds."""
    state = env.world.state_dict()
    return {
        name.removeprefix("field/"): value
        for name, value in state.items()
        if name.startswith("field/")
    }


def assert_constants_follow(env: ManagerBasedRlEnv) -> None:
    """In each world they are what MuJoCo's C engine derives from that world's fields."""
    for row in range(E):
        model = copy.copy(env.world.mj_model)
        for name in WRITTEN:
            getattr(model, name)[:] = env.world.field(name)[row].numpy()
        mujoco.mj_setConst(model, mujoco.MjData(model))
        for name in CONSTANTS:
            actual, expected = env.world.field(name)[row], getattr(model, name)
            np.testing.assert_allclose(actual, expected, rtol=2e-5, atol=1e-7, err_msg=name)


@pytest.fixture(scope="module")
def env():
    """A new mass at each reset, beside a centre of mass from startup and an armature that changes on the way."""
    return runner_env(
        {
            "com": mdp.RandomizeBodyCom(bodies="trunk", ranges=(-0.05, 0.05), operation="add"),
            "mass": mdp.RandomizeBodyMass(
                bodies=("trunk", ".*_leg"), ranges=(0.5, 2.0), mode="reset"
            ),
            "armature": mdp.RandomizeJointArmature(
                ranges=(0.01, 0.1), mode="interval", interval_range_s=(0.008, 0.008)
            ),
        }
    )


def step(env: ManagerBasedRlEnv, root: object) -> object:
    action = torch.zeros(E, 1)
    return env.step_and_maybe_reset(root.set("action", action))[1]  # pyright: ignore


def test_fields_of_all_modes_make_their_constants_together(env):
    env.seed(3)
    assert_constants_follow(env)
    root = env.reset()
    assert_constants_follow(env)
    armature = fields(env)["dof_armature"]
    # The clocks run out every other step of 4 ms.
    for changes in (False, True, False, True):
        root = step(env, root)
        assert bool((fields(env)["dof_armature"] != armature).any()) == changes
        armature = fields(env)["dof_armature"]
        assert_constants_follow(env)


def test_a_partial_reset_changes_its_rows_only_and_no_startup_field(env):
    env.seed(3)
    env.reset()
    before = fields(env)
    env.reset(env_ids=[1, 2])
    after = fields(env)
    for name, values in before.items():
        assert torch.equal(after[name][[0, 3]], values[[0, 3]]), name
    assert (after["body_mass"][1:3, 1:4] != before["body_mass"][1:3, 1:4]).all()
    assert torch.equal(after["body_ipos"], before["body_ipos"])
    assert_constants_follow(env)


def test_seeds_reproduce_whatever_happened_before(env):
    env.seed(5)
    first = (env.reset(), fields(env))[1]
    root = env.reset()
    for _ in range(3):
        root = step(env, root)
    env.seed(5)
    again = (env.reset(), fields(env))[1]
    env.seed(6)
    other = (env.reset(), fields(env))[1]
    for name in ("body_mass", "body_inertia", "body_ipos"):
        assert torch.equal(first[name], again[name]), name
        assert not torch.equal(first[name], other[name]), name


def test_a_saved_env_goes_on_with_its_own_bodies(env):
    env.seed(7)
    env.reset()
    saved, held = env.state_dict(), fields(env)
    env.seed(8)
    env.reset()
    env.load_state_dict(saved)
    for name, values in fields(env).items():
        assert torch.equal(values, held[name]), name


def test_explicit_actuators_take_gains_and_limits_of_their_world():
    servo = IdealPDActuator(joints="left_hip", stiffness=20.0, damping=0.0, effort_limit=4.0)
    env = runner_env(
        {
            "gains": mdp.RandomizeActuatorGains(joints="left_hip", stiffness=(0.2, 2.0)),
            "limit": mdp.RandomizeEffortLimit(joints="left_hip", ranges=(0.1, 1.0)),
        },
        actuators=(servo,),
        decimation=1,
    )
    root = env.reset()
    env.step(root.set("action", torch.ones(E, 1)))
    stiffness, limit = (
        env.view.actuator_param(name)[:, 0] for name in ("stiffness", "effort_limit")
    )
    assert stiffness.std() > 1.0 and limit.std() > 0.3
    assert (stiffness >= 4.0).all() and (stiffness <= 40.0).all() and (limit <= 4.0).all()
    # The hip starts at its default pose, and the action asks for half a radian more.
    asked = torch.minimum(0.5 * stiffness, limit)
    actuator = env.world.mj_model.actuator("left_hip").id
    torch.testing.assert_close(
        env.world.actuator_force_EL[:, actuator], asked, rtol=1e-5, atol=1e-5
    )


def test_a_factor_on_the_limit_of_an_unlimited_motor_is_refused():
    servo = IdealPDActuator(joints="left_hip", stiffness=20.0, damping=0.0)
    with pytest.raises(ValueError, match="nothing limits the effort on joint 'left_hip'"):
        runner_env(
            {"limit": mdp.RandomizeEffortLimit(joints="left_hip", ranges=(0.1, 1.0))},
            actuators=(servo,),
        )
