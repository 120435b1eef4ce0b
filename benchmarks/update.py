"""Times one PPO update, beside the same update made of TorchRL's own parts.

    python -m benchmarks.update device=cuda num_envs=4096,16384
    python -m benchmarks.update device=cuda num_envs=4096 hidden_dims=1024,512,256,128

Networks of 512, 256 and 128 or of `hidden_dims`, rollouts of 24 steps of random env states of Go1's sizes (48
observations, 12 actions), 5 epochs of 4 minibatches. Ours is timed eager and captured in float32 (TF32 on CUDA), and
captured with `precision=bfloat16`, which takes the fused kernels where they fit: `update_ms`. The stock side is
TorchRL's `GAE`, `ClipPPOLoss`, `ReplayBuffer` and torch's Adam on the same data and networks, in the same order of env
states (our sampler in its buffer). The same capture is tried on it, and what stops it is written down.
`parameter_difference` is that between ours and the stock side after one update in full float32, relative to the way
that the parameters went. `stock_eager_over_update` is what all of ours saves together, bfloat16 included; on the CPU,
where nothing is captured and all is float32, `update_ms` is `ours_eager_ms`.

Figures go to benchmarks/results/update.json, as `<device>/<env states>/<figure>`, and for other widths as
`<device>/<env states>/<widths between x>/<figure>`.
"""

from __future__ import annotations

import copy
import sys
from collections.abc import Callable
from typing import Any, Literal

import torch
from rich.console import Console
from rich.table import Table
from tensordict import TensorDict
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from torch import Tensor, nn
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from benchmarks import command_line, report
from benchmarks.stopwatch import milliseconds
from ksim_rl.algorithms.ppo.fused import NotFused
from ksim_rl.algorithms.ppo.update import PPOUpdate
from ksim_rl.data import DatasetCfg, EpochSampler
from ksim_rl.device.capture import Captured
from ksim_rl.device.streams import checked_device
from ksim_rl.modules import ActorCfg, CriticCfg, make_actor, make_critic
from ksim_rl.objectives import PPOCfg

STEPS, OBS, ACTIONS, MINIBATCHES = 24, 48, 12, 4
HIDDEN_DIMS = (512, 256, 128)
# Of the dataset whose `update_ms` on a GPU stands in the results by that name alone.
TARGET_STATES = 98304
# The stock side has no schedule that follows the divergence without a host sync at each step.
CFG = PPOCfg(schedule="fixed")
WARMUP, REPEATS = 2, 10
CPU_REPEATS = 3

Networks = tuple[ProbabilisticTensorDictSequential, TensorDictModule]


def main() -> None:
    """Time all sides for each number of envs, print the figures, and write them."""
    defaults = {
        "device": "cuda" if torch.cuda.is_available() else "cpu",
        "num_envs": "",
        "hidden_dims": "",
    }
    given = command_line.options(sys.argv[1:], defaults)
    device = checked_device(given["device"])
    sizes = given["num_envs"] or ("4096,16384" if device.type == "cuda" else "64")
    default = ",".join(map(str, HIDDEN_DIMS))
    hidden_dims = tuple(command_line.whole_numbers("hidden_dims", given["hidden_dims"] or default))
    widths = "" if hidden_dims == HIDDEN_DIMS else "/" + "x".join(map(str, hidden_dims))
    figures, notes = {}, {}
    for num_envs in command_line.whole_numbers("num_envs", sizes):
        label = f"{report.device_label(device)}/{num_envs * STEPS}{widths}"
        found, note = compare(num_envs, device=device, hidden_dims=hidden_dims)
        figures |= {f"{label}/{name}": value for name, value in found.items()}
        notes |= {f"{label}/{name}": text for name, text in note.items()}
    target = f"{report.device_label(device)}/{TARGET_STATES}/update_ms"
    if device.type == "cuda" and target in figures:
        figures["update_ms"] = figures[target]
    table = Table("figure", "value")
    for name, value in [*figures.items(), *notes.items()]:
        table.add_row(name, value if isinstance(value, str) else f"{value:.4g}")
    Console(width=160).print(table)
    path = report.write(
        "update", figures=figures, device=device, module="benchmarks.update", notes=notes
    )
    print(f"written to {path}")


def compare(
    num_envs: int, *, device: torch.device, hidden_dims: tuple[int, ...] = HIDDEN_DIMS
) -> tuple[dict[str, float], dict[str, str]]:
    """Return the figures of one dataset's size, and why some are missing."""
    networks = make_networks(device, hidden_dims=hidden_dims)
    rollout_ET = make_rollout(networks[0], num_envs=num_envs, device=device)
    figures = {"parameter_difference": parameter_difference(networks, rollout_ET)}
    notes = {}
    torch.set_float32_matmul_precision("high")

    def ours(**options: Any) -> PPOUpdate:
        update = _ours(networks, num_envs=num_envs, device=device, **options)
        _warm_up(lambda: update(rollout_ET), device)
        return update

    update = ours()
    figures["ours_eager_ms"] = _time(update._update, device)
    stock = StockUpdate(networks, num_envs=num_envs)
    _warm_up(lambda: stock(rollout_ET), device)
    figures["stock_eager_ms"] = _time(lambda: stock(rollout_ET), device)
    if device.type == "cuda":
        figures["ours_captured_ms"] = _time(lambda: update(rollout_ET), device)
        fast = ours(precision="bfloat16")
        figures["update_ms"] = _time(lambda: fast(rollout_ET), device)
        notes["update"] = fast.fused.reason if isinstance(fast.fused, NotFused) else "fused kernels"
        # Last, because a capture that fails leaves its stream behind.
        notes["stock_captured_ms"] = why_not_captured(stock, rollout_ET, device=device)
    else:
        figures["update_ms"] = figures["ours_eager_ms"]
    figures["stock_eager_over_update"] = figures["stock_eager_ms"] / figures["update_ms"]
    return figures, notes


class StockUpdate:
    """One PPO update out of TorchRL's parts, with the options of `CFG`.

    Args:
        networks: actor and critic, which are copied.
        num_envs: E.
    """

    def __init__(self, networks: Networks, *, num_envs: int) -> None:
        self.actor, self.critic = copy.deepcopy(networks)
        self.advantage = GAE(
            gamma=CFG.gamma,
            lmbda=CFG.lmbda,
            value_network=self.critic,
            average_gae=True,
            time_dim=1,
        )
        self.loss = ClipPPOLoss(
            self.actor,
            self.critic,
            clip_epsilon=CFG.clip_epsilon,
            clip_value=CFG.clip_value,
            entropy_coeff=CFG.entropy_coeff,
            critic_coeff=CFG.critic_coeff,
            loss_critic_type="l2",
            normalize_advantage=False,
        )
        device = next(self.actor.parameters()).device
        self.optimizer = torch.optim.Adam(
            self.loss.parameters(), lr=CFG.learning_rate, capturable=device.type == "cuda"
        )
        size = num_envs * STEPS
        self.dataset = ReplayBuffer(
            storage=LazyTensorStorage(size, device=device),
            sampler=EpochSampler(),
            batch_size=size // MINIBATCHES,
        )

    def __call__(self, rollout_ET: TensorDict) -> None:
        """Make all gradient steps."""
        rollout_ET = rollout_ET.clone(False)
        with torch.no_grad():
            self.advantage(rollout_ET)
        self.dataset.extend(rollout_ET.reshape(-1).exclude("next"))
        for _ in range(CFG.num_epochs * MINIBATCHES):
            losses = self.loss(self.dataset.sample())
            total = losses["loss_objective"] + losses["loss_entropy"] + losses["loss_critic"]
            self.optimizer.zero_grad()
            total.backward()
            assert CFG.max_grad_norm is not None
            nn.utils.clip_grad_norm_(self.loss.parameters(), CFG.max_grad_norm)
            self.optimizer.step()


def parameter_difference(networks: Networks, rollout_ET: TensorDict) -> float:
    """Return how far one update of ours and one of the stock side end from each other.

    Relative to the way that the stock side's parameters went, both in full float32.
    """
    torch.set_float32_matmul_precision("highest")
    num_envs = rollout_ET.batch_size[0]
    update = _ours(networks, num_envs=num_envs, device=next(networks[0].parameters()).device)
    update(rollout_ET)
    stock = StockUpdate(networks, num_envs=num_envs)
    stock(rollout_ET)
    before, ours, theirs = map(
        _flat, (networks, (update.actor, update.critic), (stock.actor, stock.critic))
    )
    return float((ours - theirs).norm() / (theirs - before).norm())


def why_not_captured(stock: StockUpdate, rollout_ET: TensorDict, *, device: torch.device) -> str:
    """Try to capture the stock update in a graph; return its time, or what stopped it."""
    graph = Captured(lambda: stock(rollout_ET), device=device, warmup=WARMUP)
    try:
        for _ in range(WARMUP + 1):
            graph()
        return f"{_time(graph, device):.2f}"
    except Exception as error:
        return f"not captured: {str(error).splitlines()[0]}"


def make_networks(device: torch.device, *, hidden_dims: tuple[int, ...] = HIDDEN_DIMS) -> Networks:
    """Return actor and critic, the same for one seed."""
    torch.manual_seed(0)
    actor_cfg, critic_cfg = ActorCfg(hidden_dims=hidden_dims), CriticCfg(hidden_dims=hidden_dims)
    actor = make_actor(actor_cfg, obs_dim=OBS, action_dim=ACTIONS, device=device)
    return actor, make_critic(critic_cfg, obs_dim=OBS, device=device)


def make_rollout(
    actor: ProbabilisticTensorDictSequential, *, num_envs: int, device: torch.device, obs: int = OBS
) -> TensorDict:
    """Return random env states `["E","T"]` in time-major memory; 2 percent of them end an episode."""
    generator = torch.Generator(device).manual_seed(0)

    def draw(*shape: int) -> Tensor:
        return torch.randn(STEPS, num_envs, *shape, device=device, generator=generator)

    terminated, truncated = draw(1) > 2.33, draw(1) > 2.33
    critic, following = draw(obs), draw(obs)
    # A step begins with what followed the one before, but for the first step of an episode.
    critic[1:] = critic[1:].where((terminated | truncated)[:-1], following[:-1])
    rollout_TE = TensorDict(
        {
            "actor": draw(obs),
            "critic": critic,
            "next": {
                "critic": following,
                "reward": draw(1),
                "terminated": terminated,
                "truncated": truncated & ~terminated,
                "done": terminated | truncated,
            },
        },
        [STEPS, num_envs],
        device=device,
    )
    with torch.no_grad():
        return actor(rollout_TE).transpose(0, 1)


def _ours(
    networks: Networks,
    *,
    num_envs: int,
    device: torch.device,
    precision: Literal["float32", "bfloat16"] = "float32",
) -> PPOUpdate:
    actor, critic = copy.deepcopy(networks)
    cfg = PPOCfg(schedule="fixed", precision=precision)
    minibatch = num_envs * STEPS // MINIBATCHES
    data = DatasetCfg(num_env_states_per_minibatch=minibatch, num_minibatches=MINIBATCHES)
    return PPOUpdate(cfg, actor=actor, critic=critic, data=data, device=device)


def _warm_up(update: Callable[[], object], device: torch.device) -> None:
    """Call it as a run does at first: these calls compile, allocate and, where it is captured, record the graph."""
    for _ in range(WARMUP + 1 if device.type == "cuda" else 1):
        update()


def _time(work: Callable[[], object], device: torch.device) -> float:
    repeats = REPEATS if device.type == "cuda" else CPU_REPEATS
    return milliseconds(work, device=device, repeats=repeats)


def _flat(networks: Networks) -> Tensor:
    return torch.cat(
        [parameter.detach().flatten() for network in networks for parameter in network.parameters()]
    )


if __name__ == "__main__":
    command_line.run(main)
