"""A term that writes what is not its own is refused by name: at build, in `check_env`, and while a step is recorded."""

from dataclasses import dataclass
from typing import ClassVar

import mujoco
import numpy as np
import pytest
import torch
import warp as wp
from torch import Tensor

from ksim_rl import mdp
from ksim_rl.collectors import CollectorCfg, RolloutCollector
from ksim_rl.envs import EnvView, SceneCfg
from ksim_rl.envs.term import RewardTerm
from ksim_rl.mdp.constants import constant
from ksim_rl.scene.actuators import IdealPDActuator, set_actuators
from ksim_rl.testing import check_env
from tests.envs.impure_terms import TERMS, BadDraw, BadReward, env_with
from tests.envs.probe_env import PUCK_XML, Target, puck_env


@torch.jit.script
def subtract(x: Tensor) -> Tensor:
    x -= 0.5
    return x


@wp.kernel
def halve(x: wp.array2d[float]):
    i, j = wp.tid()  # pyright: ignore
    x[i, j] = x[i, j] * 0.5


def by_warp(view: EnvView) -> None:
    position = wp.from_torch(view.world.qpos_EL)
    wp.launch(halve, dim=position.shape, inputs=[position], device="cpu")


def by_operator(view: EnvView) -> None:
    error = view.joint_pos_EL
    error -= 0.5


def by_index(view: EnvView) -> None:
    view.joint_pos_EL[0] = 1.0


def by_mask(view: EnvView) -> None:
    position = view.joint_pos_EL
    position[position > 1e9] = 0.0


def by_numpy(view: EnvView) -> None:
    position = view.joint_pos_EL.numpy()
    np.multiply(position, 0.5, out=position)


# Most leave a puck at 0 where it is, as it is when an env is built.
WAYS = {
    "-=": by_operator,
    "clamp_": lambda view: view.joint_pos_EL.clamp_(-1.0, 1.0),
    "mul_": lambda view: view.joint_pos_EL.mul_(2.0),
    "out=": lambda view: torch.abs(view.joint_pos_EL, out=view.joint_pos_EL),
    "index": by_index,
    "mask": by_mask,
    "copy_": lambda view: view.joint_pos_EL.copy_(torch.zeros(view.num_envs, 1)),
    "a slice": lambda view: view.joint_pos_EL[:, 0].zero_(),
    "another shape": lambda view: view.joint_pos_EL.view(-1).zero_(),
    ".data": lambda view: view.joint_pos_EL.data.mul_(2.0),
    "detach": lambda view: view.joint_pos_EL.detach().mul_(2.0),
    "relu": lambda view: torch.nn.functional.relu(view.joint_pos_EL, inplace=True),
    "many at once": lambda view: torch._foreach_mul_([view.joint_pos_EL], 2.0),
    "TorchScript": lambda view: subtract(view.joint_pos_EL),
}
PAST_TORCH = {"numpy": by_numpy, "Warp": by_warp}


@pytest.mark.parametrize("way", WAYS)
def test_a_reward_that_moves_the_robot_is_refused_at_build_whatever_the_way(way):
    wanted = r"rewards\.bad: BadReward writes into view\.joint_pos_EL in place \(`\w+`\), which moves the robot: a rew"
    with pytest.raises(ValueError, match=wanted) as refusal:
        env_with("rewards", BadReward(deed=WAYS[way]))
    fix = "Write `error = view.joint_pos_EL - 0.5` instead of `error = view.joint_pos_EL; error -= 0.5`, or change "
    assert fix + "`view.joint_pos_EL.clone()`" in str(refusal.value)


@pytest.mark.parametrize("way", PAST_TORCH)
def test_a_write_past_torch_that_zeros_would_not_show_is_refused_at_build(way):
    with pytest.raises(
        ValueError, match=r"rewards\.bad: BadReward changes view\.world\.qpos_EL past torch"
    ):
        env_with("rewards", BadReward(deed=PAST_TORCH[way]))


@pytest.mark.parametrize("kind", TERMS)
def test_each_kind_of_term_is_refused(kind):
    with pytest.raises(
        ValueError, match=rf"{kind}\.bad: Bad\w+ writes into view\.joint_pos_EL in place"
    ):
        env_with(kind, TERMS[kind](deed=by_operator))


def test_the_draw_of_a_command_is_refused_too():
    with pytest.raises(
        ValueError, match=r"commands\.bad: BadDraw writes into view\.joint_pos_EL in place"
    ):
        env_with("commands", BadDraw(deed=by_operator))


@dataclass(frozen=True, kw_only=True)
class Peak(RewardTerm):
    """Keeps the greatest position, by every idiom that a term may use on what is its own."""

    def __call__(self, view: EnvView) -> Tensor:
        peak_E = view.buffer("peak_E")
        calls = view.shared("calls", 0.0)
        calls += 1.0
        position_E = view.joint_pos_EL[:, 0].clone()
        position_E.clamp_(min=0.0)
        torch.maximum(peak_E, position_E, out=peak_E)
        peak_E.numpy()[0] += 0.0
        view.cache["mine"] = peak_E * 2.0
        return view.cache["mine"] * calls


QUANTITIES = {
    r"view\.joint_pos_rel_EL": lambda view: view.joint_pos_rel_EL.mul_(2.0),
    r"view\.joints\(\['rail'\]\)\.pos_EL": lambda view: view.joints("rail").pos_EL.mul_(2.0),
    r"view\.bodies\(\['puck'\]\)\.pos_EN3": lambda view: view.bodies("puck").pos_EN3.mul_(2.0),
    r"view\.episode_time_E": lambda view: view.episode_time_E.mul_(2.0),
    r"view\.cache\['mine'\]": lambda view: view.cache["mine"].mul_(2.0),
    r"view\.command\('target'\)": lambda view: view.command("target").mul_(2.0),
    r"view\.action_EL": lambda view: view.action_EL.mul_(2.0),
    r"view\.last_action_EL": lambda view: view.last_action_EL.mul_(2.0),
    r"view\.episode_step_E": lambda view: view.episode_step_E.add_(1),
    r"view\.reward_weights\['position'\]": lambda view: view.reward_weights["position"].mul_(2.0),
    r"view\.episode_rewards\['position'\]": lambda view: view.episode_rewards["position"].zero_(),
    r"view\.terminated_E": lambda view: view.terminated_E.fill_(False),
    r"view\.level": lambda view: view.level.fill_(0.0),
    r"view\.default_joint_pos_EL": lambda view: view.default_joint_pos_EL.zero_(),
    r"view\.soft_joint_pos_limits_L2": lambda view: view.soft_joint_pos_limits_L2.zero_(),
    r"view\.world\.ctrl_EL": lambda view: view.world.ctrl_EL.zero_(),
    r"view\.world\.xpos_EL": lambda view: view.world.xpos_EL.zero_(),
    r"view\.entity\('puck'\)\.default_root_pos_L": lambda view: view.robot.default_root_pos_L.zero_(),
    r"the buffer 'rewards/peak\.peak_E'": lambda view: view.buffers.by_name()["rewards/peak.peak_E"].zero_(),
    r"the buffer 'commands/target\.target_E1'": lambda view: view.buffers.get("commands/target.target_E1", 1).zero_(),
    r"warp_model\.body_mass": lambda view: wp.to_torch(view.world.warp_model.body_mass).mul_(2.0),
    "a constant that all terms share": lambda view: constant((1.0, 2.0), view.device).mul_(2.0),
}  # fmt: skip


@pytest.mark.parametrize("quantity", QUANTITIES)
def test_no_term_changes_what_others_read(quantity):
    from tests.envs.probe_env import Position

    rewards = {"position": Position(), "peak": Peak(), "bad": BadReward(deed=QUANTITIES[quantity])}
    with pytest.raises(
        ValueError, match=rf"rewards\.bad: BadReward writes into {quantity} in place"
    ):
        env_with("rewards", None, rewards=rewards)


def test_a_quantity_that_a_term_is_the_first_to_read_is_not_its_own():
    def deed(view: EnvView) -> None:
        view.episode_time_E.numpy()[:] += 1.0

    with pytest.raises(
        ValueError, match=r"rewards\.bad: BadReward changes view\.episode_time_E past torch"
    ):
        env_with("rewards", BadReward(deed=deed))


def test_what_is_a_terms_own_it_may_write_as_it_likes():
    env = env_with("rewards", Peak(), episode_length_s=0.1)
    with env.watching_terms():
        root_E = env.reset()
        for _ in range(8):
            _, root_E = env.step_and_maybe_reset(env.rand_action(root_E))
    check_env(env, skip=("syncs", "memory", "c_engine"))


def test_a_reward_may_not_write_state_by_the_view_either():
    def deed(view: EnvView) -> None:
        view.joints().write_pos(
            torch.zeros(view.num_envs, dtype=torch.bool), torch.zeros(view.num_envs, 1)
        )

    with pytest.raises(
        ValueError, match=r"rewards\.bad: BadReward writes into .* a reward only reads"
    ):
        env_with("rewards", BadReward(deed=deed))


# -- terms that may write --------------------------------------------------------------------------------------------


def unmasked(view: EnvView) -> None:
    view.joints().write_pos(
        torch.ones(view.num_envs, dtype=torch.bool), torch.full((view.num_envs, 1), 0.5)
    )


def press_all(view: EnvView) -> None:
    view.world.xfrc_applied_EL[:, 1, 0] = 3.0


@pytest.mark.parametrize(("deed", "what"), [(unmasked, "qpos_EL"), (press_all, "xfrc_applied_EL")])
def test_an_event_that_ignores_its_mask_is_refused_at_build(deed, what):
    with pytest.raises(
        ValueError, match=rf"events\.bad: BadEvent changes view\.world\.{what} in rows outside"
    ):
        env_with("events", TERMS["events"](deed=deed))


def test_an_event_writes_positions_and_velocities_by_the_view_only():
    def deed(view: EnvView) -> None:
        view.world.qvel_EL[:, 0] *= 1.0

    with pytest.raises(
        ValueError,
        match=r"events\.bad: .*qvel_EL.*Write positions and velocities by `view\.write_qpos`",
    ):
        env_with("events", TERMS["events"](deed=deed))


@pytest.mark.parametrize("kind", ["events", "actions", "curriculum"])
def test_who_may_write_much_may_not_write_what_managers_keep(kind):
    def deed(view: EnvView) -> None:
        view.action_EL.mul_(2.0)

    with pytest.raises(
        ValueError, match=rf"{kind}\.bad: Bad\w+ writes into view\.action_EL in place"
    ):
        env_with(kind, TERMS[kind](deed=deed))


def test_a_curriculum_changes_nothing_where_no_episode_ended():
    def deed(view: EnvView) -> None:
        view.level.mul_(0.5)

    with pytest.raises(
        ValueError, match=r"curriculum\.bad: BadCurriculum changes view\.level in rows outside"
    ):
        env_with("curriculum", TERMS["curriculum"](deed=deed))


def test_a_command_draws_for_the_rows_of_its_mask():
    def deed(view: EnvView) -> None:
        view.buffer("target_E").add_(1.0)

    with pytest.raises(
        ValueError,
        match=r"commands\.bad: BadDraw changes the buffer .* in rows outside of its mask",
    ):
        env_with("commands", BadDraw(deed=deed))


@dataclass(frozen=True, kw_only=True)
class BadActuator(IdealPDActuator):
    """Computes its error in place."""

    def law(self, drive):
        def effort_EN(state, target):
            error_EN = state.pos_EN
            error_EN -= target.pos_EN
            return -error_EN

        return effort_EN


@dataclass(frozen=True, kw_only=True)
class BadMotor:
    """A puck with a motor whose law moves it."""

    actuators: tuple = (BadActuator(joints="rail", stiffness=1.0, damping=1.0),)

    def spec(self) -> mujoco.MjSpec:
        spec = mujoco.MjSpec.from_string(PUCK_XML)
        set_actuators(spec, self.actuators)
        return spec


def test_the_law_of_an_actuator_is_refused_too():
    scene = SceneCfg(robots={"puck": BadMotor()}, num_envs=2)
    with pytest.raises(
        ValueError,
        match=r"actuators\.0: BadActuator writes into .*qpos_EL.* the law of an actuator only",
    ):
        puck_env(scene=scene, actions={"push": mdp.JointPositionAction(joints="rail")})


@dataclass(frozen=True, kw_only=True)
class BadDrawing(Target):
    """Draws itself above the puck by moving the puck."""

    def draw_debug(self, view, visualizer, env_index):
        above = view.joint_pos_EL[env_index]
        above += 0.3


def test_whoever_draws_is_refused_too():
    env = puck_env(commands={"target": BadDrawing(resampling_time_range_s=None)})
    env.reset()
    with pytest.raises(
        ValueError, match=r"commands\.target: BadDrawing writes into view\.joint_pos_EL in place"
    ):
        env.update_visualizers(None)


# -- when ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class BadLater(RewardTerm):
    """Begins to move the puck on request."""

    is_bad: ClassVar[list[bool]] = []

    def __call__(self, view: EnvView) -> Tensor:
        if self.is_bad:
            by_operator(view)
        return torch.ones(view.num_envs)


@pytest.fixture
def later():
    BadLater.is_bad.clear()
    env = env_with("rewards", BadLater())
    BadLater.is_bad.append(True)
    yield env
    BadLater.is_bad.clear()


REFUSED = r"rewards\.bad: BadLater writes into view\.joint_pos_EL in place"


def test_check_env_finds_what_came_after_the_build(later):
    with pytest.raises(AssertionError, match=rf"\[terms\] {REFUSED}"):
        check_env(later, skip=("syncs", "memory", "c_engine"))


def test_a_step_is_not_compiled_with_it(later):
    policy = lambda td: td.set("action", torch.zeros(3, 1))  # noqa: E731
    collector = RolloutCollector(later, policy, rollout_length=2, cfg=CollectorCfg(compile=True))
    with pytest.raises(ValueError, match=REFUSED):
        collector.collect()


def test_a_write_past_torch_is_found_while_a_step_is_compiled(later, monkeypatch):
    # NumPy would not come so far: a recording refuses what reads the device on the host.
    monkeypatch.setattr("tests.envs.test_term_guard.by_operator", by_warp)
    policy = lambda td: td.set("action", torch.zeros(3, 1))  # noqa: E731
    collector = RolloutCollector(later, policy, rollout_length=2, cfg=CollectorCfg(compile=True))
    later.reset()
    with pytest.raises(
        ValueError, match=r"rewards\.bad: BadLater changes view\.world\.qpos_EL past torch"
    ):
        collector.collect()


def test_steps_that_are_watched_refuse_it(later):
    root_E = later.reset()
    with later.watching_terms(), pytest.raises(ValueError, match=REFUSED):
        later.rand_step(root_E)


def test_a_term_that_is_added_later_is_watched_when_it_first_runs():
    env = env_with("rewards", BadReward(deed=lambda view: None))
    env.observation_manager.terms["late"] = TERMS["observations"](deed=by_operator)
    with pytest.raises(
        ValueError, match=r"observations\.late: BadObservation writes into view\.joint_pos_EL"
    ):
        env.reset()


def test_a_step_of_an_env_that_was_built_is_not_watched(monkeypatch):
    env = env_with("rewards", Peak())

    def refuse(*given, **named):
        raise AssertionError("a step was watched")

    monkeypatch.setattr(type(env.driver.guard), "_watched", refuse)
    env.rollout(3)


def test_the_rehearsal_leaves_no_trace():
    env = env_with("rewards", Peak())
    assert (
        not env.world.qpos_EL.any() and not env.world.qvel_EL.any() and not env.world.ctrl_EL.any()
    )
    for name, buffer in env.view.buffers.by_name().items():
        assert not buffer.any(), name
    assert not env.non_finite_terms()
    assert not env.view.step_count and not env.view.reset_count_E.any()
