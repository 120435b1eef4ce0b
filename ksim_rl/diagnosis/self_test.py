"""Tries the needs of every run on each device: physics as in MuJoCo's C engine, graphs, and an update."""

from collections.abc import Callable
from importlib.resources import files

import mujoco
import numpy as np
import torch
from tensordict import TensorDict
from torchrl.data import Unbounded

from ksim_rl.device.capture import Captured, live_launches
from ksim_rl.modules import ActorCfg, CriticCfg, make_actor, make_critic
from ksim_rl.objectives import PPOCfg, StepGuard, make_loss, make_optimizer, ppo_step
from ksim_rl.physics import World

# A few envs are enough: the kernels are the same for thousands.
NUM_ENVS = 4
NUM_STEPS = 50
# float32 against float64 over half a second of a pole that swings.
MOST_DIFFERENCE = 1e-4


def try_device(device: torch.device) -> list[tuple[str, str | None]]:
    """Return the names of the trials on a device, each with its fault, or None."""
    # The smallest robot of the package: it compiles soonest.
    mj_model = mujoco.MjModel.from_xml_string(
        files("ksim_rl.scene.robots").joinpath("cartpole.xml").read_text()
    )
    trials: dict[str, Callable[[], str | None]] = {
        "physics as in C": lambda: _physics(mj_model, device),
        "graphs as eager": lambda: _graphs(mj_model, device),
        "an update": lambda: _update(device),
    }
    done = []
    for name, trial in trials.items():
        try:
            wrong = trial()
        # Whatever a broken installation raises is what the report is for.
        except Exception as error:
            wrong = f"{type(error).__name__}: {' '.join(str(error).split())}"
        done.append((name, wrong))
    return done


# MuJoCo's C engine in float64 is the reference.
def _physics(mj_model: mujoco.MjModel, device: torch.device) -> str | None:
    world = _pushed(mj_model, device)
    data = mujoco.MjData(mj_model)
    data.ctrl[:] = 0.5
    for _ in range(NUM_STEPS):
        world.step(1)
        mujoco.mj_step(mj_model, data)
    difference = float(np.abs(world.qpos_EL.cpu().numpy() - data.qpos).max())
    world.close()
    if difference < MOST_DIFFERENCE:
        return None
    return f"after {NUM_STEPS} steps positions differ by {difference:.2g} from the C engine's"


def _graphs(mj_model: mujoco.MjModel, device: torch.device) -> str | None:
    # Two worlds of the same state: one is stepped by a graph, one kernel by kernel.
    graphed, live = (_pushed(mj_model, device) for _ in range(2))
    total = torch.zeros((), device=device)

    def step() -> None:
        graphed.step(1)
        total.add_(graphed.qpos_EL.sum())

    # On a GPU a failed capture is the fault that is looked for; the CPU goes on without.
    captured = Captured(step, device=device, require_graphs=device.type == "cuda")
    expected = torch.zeros_like(total)
    # The first calls warm up and record, the later ones replay.
    for _ in range(5):
        captured()
        with live_launches():
            live.step(1)
        expected.add_(live.qpos_EL.sum())
    difference = float((total - expected).abs())
    graphed.close()
    live.close()
    if difference < 1e-6:
        return None
    return f"what a graph computes differs by {difference:.2g}"


def _update(device: torch.device) -> str | None:
    # Seeded on the CPU, so that all devices get the same numbers.
    generator = torch.Generator().manual_seed(0)

    def draw(size: int) -> torch.Tensor:
        return torch.randn(64, size, generator=generator).to(device)

    cfg = PPOCfg()
    spec = Unbounded(torch.Size([2]), device=device)
    actor = make_actor(
        ActorCfg(hidden_dims=(16,)), obs_dim=3, action_dim=2, action_spec=spec, device=device
    )
    critic = make_critic(CriticCfg(hidden_dims=(16,)), obs_dim=3, device=device)
    minibatch_B = actor(
        # As a rollout would hold it: observations, action and its log-probability, without gradients.
        TensorDict({"actor": draw(3), "critic": draw(3)}, batch_size=[64], device=device)
    ).detach()
    minibatch_B.update({"advantage": draw(1), "value_target": draw(1), "state_value": draw(1)})
    before = [parameter.clone() for parameter in actor.parameters()]
    optimizer = make_optimizer(cfg, actor, critic)
    guard = StepGuard(device=device)
    ppo_step(make_loss(cfg, actor, critic), optimizer, minibatch_B, cfg=cfg, guard=guard)
    # Parameters have to move, and the guard has to see finite gradients.
    moved = any(
        not torch.equal(old, new) for old, new in zip(before, actor.parameters(), strict=True)
    )
    if moved and not int(guard.skipped):
        return None
    return "a gradient step changed nothing"


def _pushed(mj_model: mujoco.MjModel, device: torch.device) -> World:
    world = World(mj_model, num_envs=NUM_ENVS, device=device)
    world.ctrl_EL.fill_(0.5)
    return world
