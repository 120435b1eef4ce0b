"""Makes an env whose worlds have room for all contacts and constraint rows that a rehearsal finds.

A model's probe sees poses of the model only. Resets, commands and actions of an env may need more room, which the
first steps with random actions show. This runs before anything is captured, since a world cannot grow later.
"""

import dataclasses
import math
from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor
from torchrl.envs import EnvBase

from ksim_rl.envs.contract import part
from ksim_rl.envs.manager_based_rl_env import ManagerBasedRlEnv
from ksim_rl.physics import OverflowReport

# Long enough for a robot to fall and lie, and so many env steps at most.
SECONDS = 1.0
MOST_STEPS = 50
# Contacts that found no place had no rows: only then are those seen.
MOST_BUILDS = 5


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Room:
    """The room of worlds, and the reason why MuJoCo Warp's own solver solves their constraints, if it does."""

    njmax: int
    nconmax: int
    one_kernel_unavailable: str | None


def with_room(make: Callable[[], EnvBase], *, note: Callable[[str], None]) -> EnvBase:
    """Return an env that `make` builds, built once more where its worlds lost contacts or rows in a rehearsal.

    The new one has the needed room, with a margin, and so has each later world of the same model in this process.
    `note` reports it in one line. A number of rows or contacts that the env's `sim` gives stays as it is; then `note`
    reports the rows that were lost. An env that is no `ManagerBasedRlEnv`, or whose room is certain, is not
    rehearsed.
    """
    env = make()
    base = part(env, ManagerBasedRlEnv)
    if base is None or base.world.room_is_certain:
        return env
    first = _room_of(base)
    report = rehearse_room(base)
    # A contact that is lost also hides its constraint rows, so more may be needed in the next round.
    for _ in range(MOST_BUILDS - 1):
        if not base.world.remember_needs(report):
            break
        # Before the next build, so that two envs are never in memory together.
        env.close(raise_if_closed=False)
        env = make()
        base = part(env, ManagerBasedRlEnv)
        assert base is not None, "it makes the same kind of env"
        report = rehearse_room(base)
    last = _room_of(base)
    if last != first:
        note(_grown(first, last))
    for message in report.messages:
        note(f"warning: random actions lost contacts or constraints in a rehearsal: {message}")
    return env


def _room_of(env: ManagerBasedRlEnv) -> _Room:
    world = env.world
    return _Room(
        njmax=world.njmax,
        nconmax=world.nconmax,
        one_kernel_unavailable=world.one_kernel_unavailable,
    )


def _grown(first: _Room, last: _Room) -> str:
    numbers = {
        "task.sim.njmax": (first.njmax, last.njmax),
        "task.sim.nconmax": (first.nconmax, last.nconmax),
    }
    grown = [f"{name} {old} -> {new}" for name, (old, new) in numbers.items() if new != old]
    text = f"room for contacts and constraint rows has grown after a rehearsal: {', '.join(grown)}"
    if last.one_kernel_unavailable and not first.one_kernel_unavailable:
        text += f"; MuJoCo Warp's own solver solves constraints now, because {last.one_kernel_unavailable}"
    return text


def rehearse_room(env: ManagerBasedRlEnv) -> OverflowReport:
    """Reset all envs, take random actions for a second, and put everything back; return the report of needed room."""
    steps = min(MOST_STEPS, math.ceil(SECONDS / env.step_dt))
    # Everything below is undone from this state.
    saved = env.state_dict()
    # Clears what was counted before.
    env.world.overflow_report()
    # An own generator on the CPU: the same actions on each machine, and the run's draws are not touched.
    generator = torch.Generator().manual_seed(0)
    if env.device.type == "cuda":
        devices = [env.device]
    else:
        devices = []
    # A term of the user's may draw from torch's own generators.
    with torch.no_grad(), torch.random.fork_rng(devices=devices):
        state = env.reset()
        for _ in range(steps):
            state["action"] = _random_actions(env, generator)
            _, state = env.step_and_maybe_reset(state)
    report = env.world.overflow_report()
    env.load_state_dict(saved)
    # Non-finite numbers of the rehearsal are of no state that anybody sees.
    env.driver.non_finite.start()
    env.world.forget_failures()
    return report


def _random_actions(env: ManagerBasedRlEnv, generator: torch.Generator) -> Float[Tensor, "E L"]:
    """Draw actions: anywhere within their bounds, else as a new policy draws them, of mean 0 and deviation 1."""
    shape_EL = (env.num_envs, env.action_manager.size)
    bounds_L2 = env.action_manager.bounds_L2
    if bounds_L2 is None:
        return torch.randn(shape_EL, generator=generator).to(env.device)
    # Drawn on the host, then moved: the same numbers on each device.
    share_EL = torch.rand(shape_EL, generator=generator).to(env.device)
    low_L, high_L = bounds_L2.unbind(-1)
    return torch.lerp(low_L, high_L, share_EL)
