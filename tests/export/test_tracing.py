"""Traced terms give what the env itself gives, for each task; what no robot can know is refused by name."""

from dataclasses import dataclass, replace
from typing import cast

import pytest
import torch
from jaxtyping import Float
from tensordict import TensorDictBase
from torch import Tensor

from ksim_rl import envs
from ksim_rl.envs import ManagerBasedRlEnv, ObservationGroupCfg, ObservationTermCfg
from ksim_rl.envs.contract import part
from ksim_rl.envs.term import ObservationTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.export import NotDescribedError
from ksim_rl.export.standalone.network import Network
from ksim_rl.export.traced_task import TracedTask, greatest_difference, trace_task
from ksim_rl.export.tracing import Traced, trace
from ksim_rl.scene.scene import warp_alone
from tests.absent_models import skipped_without_models


def built(task: str, *, num_envs: int = 3, **changes) -> ManagerBasedRlEnv:
    """Return the env of a task, with other fields; on MuJoCo's C engine if that has its sensors."""
    cfg = envs.make_cfg(task, [f"task.scene.num_envs={num_envs}"])
    sim = replace(cfg.sim, engine="warp" if warp_alone(cfg.scene) else "c")
    cfg = replace(cfg, sim=sim, curriculum={}, seed=0, **changes)
    found = part(envs.build(cfg), ManagerBasedRlEnv)
    assert found is not None
    return found


def observing(
    term: ObservationTerm, task: str = "cartpole_balance", *, num_envs: int = 1
) -> ManagerBasedRlEnv:
    """Return an env whose policy reads one term alone."""
    group = ObservationGroupCfg(terms={"own": ObservationTermCfg(term=term)})
    return built(task, num_envs=num_envs, observations={"actor": group, "critic": group})


@torch.no_grad()
def differences(env: ManagerBasedRlEnv, traced: Traced, names, *, steps: int = 12) -> list[float]:
    """Return by how much the traced observations differ from the env's in each step, in which episodes end, too."""
    found = []
    current = env.reset()
    states = [state.example for state in traced.states]
    for step in range(steps):
        given = [one.measurement.read(env.view) for one in traced.inputs]
        values_EL, *states = traced.module(*given, *states)
        wanted_EL = torch.cat([current["obs", name] for name in names], -1)
        found.append(float((values_EL - wanted_EL).abs().max()))
        # One env is reset, and forgets; the others go on.
        begins_E = torch.arange(env.num_envs) == step % 4
        stepped = env.step(env.rand_action(current))
        following = cast("TensorDictBase", stepped["next"])
        current = env.maybe_reset(following.set("done", begins_E[:, None]))
        states = [torch.where(begins_E.view(-1, *[1] * (s.ndim - 1)), 0, s) for s in states]
    return found


def watch_rewards(env: ManagerBasedRlEnv, task: TracedTask) -> list[float]:
    """Compare the traced rewards with the env's own in each step to come; the list grows by the differences."""
    assert task.scores is not None
    traced = task.scores
    found: list[float] = []
    add = env.reward_manager.step
    weights = torch.stack([env.view.reward_weights[name] for name in task.scored["rewards"]])
    if env.cfg.scale_rewards_by_dt:
        weights = weights * env.step_dt
    first = len(task.scored["terminations"])
    own = env.reward_manager.names
    columns = [own.index(name) for name in task.scored["rewards"]]
    states = [state.example for state in traced.states]

    def step(finite_E: Tensor) -> Tensor:
        given = [one.measurement.read(env.view) for one in traced.inputs]
        # What terms keep begins with zeros in each episode.
        begins_E = env.view.episode_step_E == 1
        states[:] = [torch.where(begins_E.view(-1, *[1] * (s.ndim - 1)), 0, s) for s in states]
        with torch.no_grad():
            values_EL, *states[:] = traced.module(*given, *states)
        before_ER = env.reward_manager.episode_sums_ER.clone()
        reward_E = add(finite_E)
        wanted_ER = (env.reward_manager.episode_sums_ER - before_ER)[:, columns]
        found_ER = values_EL[:, first : first + len(weights)] * weights
        found.append(float((found_ER - wanted_ER).abs().max()))
        return reward_E

    env.reward_manager.step = step  # type: ignore[method-assign]
    return found


# One of each kind of robot, ground and suite; the others run in full tests.
QUICK = ("cartpole_balance", "arm_reach", "quadruped_velocity_flat", "walker_walk")
NAMES = [
    name if name in QUICK else pytest.param(name, marks=pytest.mark.full) for name in envs.names()
]


@pytest.mark.parametrize("task", NAMES)
def test_the_observations_and_rewards_of_a_task_are_traced(task):
    with skipped_without_models():
        env = built(task)
    # The time of a motion at which an episode began is not known outside.
    if "_track" in task:
        with pytest.raises(
            NotDescribedError,
            match=r"terms\.(reference|phase): Motion\w+ reads the buffer 'motion/",
        ):
            trace_task(env, ["actor"], lambda _: None)
        return
    # Nor what a camera shows; the Panda's pictures have a group of their own.
    if "rgb" in env.cfg.observations["actor"].terms:
        with pytest.raises(NotDescribedError, match=r"terms\.rgb: .*which an export has not"):
            trace_task(env, ["actor"], lambda _: None)
        return
    said: list[str] = []
    traced = trace_task(env, ["actor"], said.append)
    # The box of an episode has a size of its own, which no robot measures.
    of_sizes = [line for line in said if "reads view.field('geom_size')" in line]
    assert bool(of_sizes) == (task == "g1_carry_box")
    assert said == of_sizes, "all other terms by which our own tasks are rated are traced, too"
    names = list(env.cfg.observations["actor"].terms)
    of_rewards = watch_rewards(env, traced)
    assert max(differences(env, traced.obs, names)) < 1e-5
    assert len(of_rewards) == 12 and max(of_rewards) < 1e-4
    env.close()


def test_the_quick_ones_are_tasks():
    assert set(QUICK) <= set(envs.names())


# -- a term of a plug-in -----------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Smoothed(ObservationTerm):
    """Joints through a network and a filter, which counts its steps; nothing about exports."""

    gain: float = 0.3

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        joints = view.joints(".*")
        weights = torch.linspace(-1.0, 1.0, 2 * len(joints), device=view.device).view(2, -1)
        seen_EL = torch.tanh(joints.encoder_pos_EL @ weights.T) + joints.vel_EL[:, :1]
        kept_EL = view.buffer("kept_EL", 2)
        count_E = view.buffer("count_E", dtype=torch.int64)
        # In place, and through a window: both go into the next step.
        kept_EL.lerp_(seen_EL, self.gain)
        kept_EL[:, 0] += 0.01
        count_E.add_(1)
        return torch.cat((kept_EL.sin(), count_E[:, None].to(torch.float32)), dim=-1)


def test_a_term_of_a_plug_in_is_written_without_a_line(tmp_path):
    traced = trace(observing(Smoothed()), [("observations/own", Smoothed())], output="obs")
    assert traced.input_names == [
        *("encoder_bias", "joint_pos", "joint_vel"),
        *("observations_own_kept_EL_in", "observations_own_count_E_in"),
    ]
    traced.write(tmp_path / "obs.onnx")
    env = observing(Smoothed(), num_envs=3)
    assert greatest_difference(traced, env, tmp_path / "obs.onnx", ["own"]) < 1e-5
    # What a file of another term gives is seen, by the term's name.
    other = observing(Smoothed(gain=0.4), num_envs=2)
    with pytest.raises(NotDescribedError, match=r"term 'own' differs by .* at step 0 .*obs.onnx"):
        greatest_difference(traced, other, tmp_path / "obs.onnx", ["own"])


def test_tracing_changes_nothing_of_the_env():
    def run(traces: bool) -> Tensor:
        env = observing(Smoothed(), num_envs=2)
        current = env.reset()
        for _ in range(3):
            if traces:
                trace(env, [("observations/own", Smoothed())], output="obs")
            current = env.step_and_maybe_reset(current.set("action", torch.full((2, 1), 0.1)))[1]
        return current["obs", "own"]

    torch.testing.assert_close(run(True), run(False), rtol=0.0, atol=0.0)


def test_a_network_refuses_what_it_cannot_hold(tmp_path):
    onnx = pytest.importorskip("onnx")
    value = onnx.helper.make_tensor_value_info("x", onnx.TensorProto.FLOAT, [1, 10**9])
    node = onnx.helper.make_node("Identity", ["x"], ["obs"])
    out = onnx.helper.make_tensor_value_info("obs", onnx.TensorProto.FLOAT, [1, 10**9])
    graph = onnx.helper.make_graph([node], "huge", [value], [out])
    model = onnx.helper.make_model(
        graph, opset_imports=[onnx.helper.make_opsetid("", 18)], ir_version=9
    )
    onnx.save(model, tmp_path / "obs.onnx")
    with pytest.raises(
        ValueError, match=r"size of x is 1000000000: expected a whole number of 0 to 67108864"
    ):
        Network(tmp_path / "obs.onnx", [], "obs")


# -- what no robot can know --------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Drawn(ObservationTerm):
    """A number that is drawn."""

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        return view.uniform(1)


@dataclass(frozen=True, kw_only=True)
class Counted(ObservationTerm):
    """How many steps the env has made, in all episodes."""

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        return view.joint_pos_EL * view.step_count


@dataclass(frozen=True, kw_only=True)
class Gravity(ObservationTerm):
    """A field of the model that worlds may have drawn."""

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        return view.field("gravity").clone()


@dataclass(frozen=True, kw_only=True)
class Stolen(ObservationTerm):
    """Whether the episode ends by a time-out."""

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        return view.truncated_E[:, None].to(torch.float32)


@dataclass(frozen=True, kw_only=True)
class Remembering(ObservationTerm):
    """It keeps what changes beyond an episode."""

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        return view.buffer("count_E1", 1, keep=True).add_(1.0).clone()


@dataclass(frozen=True, kw_only=True)
class OnHost(ObservationTerm):
    """It reads the device on the host."""

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        return view.joint_pos_EL * float(view.joint_pos_EL[0, 0])


REFUSED = {
    Drawn: "draws random numbers",
    Counted: "reads view.step_count, which goes on beyond an episode",
    Gravity: r"reads view.field\('gravity'\), a field of the model that differs between worlds",
    Stolen: "reads view.truncated_E",
    Remembering: "beyond an episode or for all envs together",
    OnHost: "reads the device on the host",
}


@pytest.mark.parametrize("kind", REFUSED, ids=lambda kind: kind.__name__)
def test_a_term_that_no_robot_can_compute_is_refused_by_name(kind):
    env = observing(kind())
    with pytest.raises(NotDescribedError, match=f"{kind.__name__} .*{REFUSED[kind]}"):
        trace_task(env, ["actor"], lambda _: None)
