"""Numbers that are not finite, actions that do not fit, contacts that do not fit, and the same seed twice."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any
from unittest import mock

import torch
from tensordict import TensorDict

from benchmarks.faults import children
from benchmarks.faults.row import AT_LEAST, AT_MOST, EXACTLY, Figures, Row
from benchmarks.faults.saving import same_bits
from ksim_rl import conf
from ksim_rl.device.state_tree import number
from ksim_rl.objectives import NonFiniteStepsError
from ksim_rl.trainers import checkpoint
from ksim_rl.trainers.build import build


def nan_worlds(folder: Path, *, envs: int) -> Figures:
    """Break the state of some worlds by NaN and infinities, and step them beside twins that are whole."""
    from tests.envs.probe_env import puck_env

    env, twin = (puck_env(num_envs=envs, limit=None) for _ in range(2))
    broken_E = torch.arange(envs) % 3 == 0
    root_E, twin_root_E = env.reset(), twin.reset()
    bad = torch.tensor([torch.nan, torch.inf, -torch.inf])
    env.world.qvel_EL[broken_E, 0] = bad[torch.arange(int(broken_E.sum())) % 3]
    push = torch.zeros(envs, 1)
    first_E, root_E = env.step_and_maybe_reset(root_E.set("action", push))
    twin_E, twin_root_E = twin.step_and_maybe_reset(twin_root_E.set("action", push))
    ended = int(first_E["next", "terminated"][broken_E].sum())
    counted = float(env.episode_log()["termination/non_finite"])
    others = _differ(first_E[~broken_E], twin_E[~broken_E])
    non_finite = count_non_finite(first_E)
    for _ in range(5):
        env_state_E, root_E = env.step_and_maybe_reset(root_E.set("action", push))
        twin_state_E, twin_root_E = twin.step_and_maybe_reset(twin_root_E.set("action", push))
        others += _differ(env_state_E[~broken_E], twin_state_E[~broken_E])
        non_finite += count_non_finite(env_state_E)
    return {
        "broken": int(broken_E.sum()),
        "not_ended_within_one_step": int(broken_E.sum()) - ended,
        "not_counted": int(broken_E.sum()) - counted,
        "others_that_differ": others,
        "non_finite_in_the_dataset": non_finite,
    }


def nan_actions(folder: Path) -> Figures:
    """Give some envs actions that are not finite, and all of them actions of other shapes and dtypes."""
    from tests.envs.probe_env import puck_env

    env = puck_env(num_envs=6, limit=None)
    root_E = env.reset()
    wrong = (
        torch.zeros(6),
        torch.zeros(6, 2),
        torch.zeros(6, 1, 1),
        torch.zeros(6, 1, dtype=torch.float64),
    )
    refused = 0
    before_EL = env.world.qpos_EL.clone()
    for action in wrong:
        try:
            env.step(TensorDict({"action": action}, batch_size=[6]))
        except (ValueError, RuntimeError) as error:
            refused += "(6, 1)" in str(error) and torch.equal(env.world.qpos_EL, before_EL)
    action_EA = torch.zeros(6, 1)
    action_EA[[1, 4]] = torch.tensor([[torch.nan], [torch.inf]])
    env_state_E, _ = env.step_and_maybe_reset(root_E.set("action", action_EA))
    ended = env_state_E["next", "terminated"][:, 0].tolist()
    # What the policy did is the dataset's "action"; the rest is what the env made of it.
    made = env_state_E["next"]
    return {
        "wrong": len(wrong),
        "refused_before_physics": refused,
        "only_those_end": ended == [False, True, False, False, True, False],
        "non_finite_in_next": count_non_finite(made),
    }


def nan_terms(folder: Path) -> Figures:
    """Let a reward, a metric, a command and observations give NaN and infinities once, in one env."""
    from tests.envs.probe_env import puck_env, push
    from tests.envs.test_non_finite_terms import FAULTS

    cases = named = explained = early = 0
    for make in FAULTS.values():
        for value in (torch.nan, torch.inf, -torch.inf):
            env = puck_env(num_envs=4, limit=None, **make(env=2, step=3, value=value))
            env_state_E: Any = {"next": env.reset()}
            for _ in range(2):
                env_state_E = push(env, env_state_E["next"])
            early += len(env.non_finite_terms())
            for _ in range(2):
                env_state_E = push(env, env_state_E["next"])
            lines = env.non_finite_terms()
            cases += 1
            named += len(lines) == 1 and "'odd'" in lines[0] and "env 2 at its step 3" in lines[0]
            explained += any(line in env.explain(width=200) for line in lines)
    return {
        "cases": cases,
        "named_with_env_and_step": named,
        "explained": explained,
        "named_too_early": early,
    }


def non_finite_loss(folder: Path) -> Figures:
    """Make every loss NaN by a critic that is, and train on."""
    trainer = build(
        conf.compose([*children.SMALLEST, "logger=none", "objective.max_skipped_steps=4"])
    )
    trainer.iterate()
    with torch.no_grad():
        update: Any = trainer.update
        next(update.critic.parameters()).fill_(torch.nan)
    before = [parameter.clone() for parameter in trainer.update.actor.parameters()]
    iterations = named = 0
    try:
        while iterations < 50:
            iterations += 1
            trainer.iterate()
    except NonFiniteStepsError as error:
        named = "in a row" in str(error)
    after = list(trainer.update.actor.parameters())
    changed = sum(not torch.equal(a, b) for a, b in zip(before, after, strict=True))
    return {
        "steps_taken_on_it": changed,
        "iterations_until_the_stop": iterations,
        "named_stop": named,
    }


def overflow(folder: Path) -> Figures:
    """Give fallen quadrupeds too little room for their contacts and constraints."""
    from ksim_rl.physics import SimCfg
    from tests.physics.test_overflow import fallen

    cases = seen = 0
    for room, field in (
        (SimCfg(njmax=10, nconmax=40), "sim.njmax >= "),
        (SimCfg(njmax=80, nconmax=1), "sim.nconmax >= "),
    ):
        world = fallen(room)
        world.step(2)
        # A reset clears what the physics itself remembers.
        world.reset(torch.ones(4, dtype=torch.bool))
        world.step(1)
        text = " ".join(world.overflow_report().messages)
        cases += 1
        seen += field in text and any(
            f"{words} {n}" in text for words, n in (("has", 10), ("now", 1))
        )
    return {"cases": cases, "seen_with_needed_and_present": seen}


def same_seed(folder: Path, *, iterations: int) -> Figures:
    """Train twice from one seed in processes of their own, and compare every tensor of the last checkpoints."""
    runs = [folder / "one", folder / "other"]
    for run in runs:

        def work(run=run) -> int:
            # Anew, not the parent's.
            trainer = build(conf.compose([*children.SMALLEST, "logger=none"]))
            for _ in range(iterations):
                trainer.iterate()
            checkpoint.save(run, trainer.state_dict(), iteration=trainer.iteration, config={})
            return 0

        children.start(work).wait()
    one, other = (checkpoint.load_latest(run).state for run in runs)
    return {"iterations": number(one, "iteration"), "differ": same_bits(one, other)}


# Layers and minibatches that torch spreads over threads.
LARGE = (
    "num_envs=256",
    "data.num_env_states_per_minibatch=1024",
    "data.num_minibatches=2",
    "modules.actor.hidden_dims=[256,256]",
    "modules.critic.hidden_dims=[256,256]",
    "logger=none",
    "trainer.eval_episodes=0",
)


def threads(folder: Path, *, iterations: int) -> Figures:
    """Train from one seed where torch and the machine have one, two and four threads, and compare every tensor."""
    states: list[Any] = []
    for count in (1, 2, 4):
        torch.set_num_threads(count)
        with mock.patch.object(os, "cpu_count", lambda count=count: count + 1):
            trainer = build(conf.compose([*children.SMALLEST, *LARGE, "trainer.num_threads=null"]))
            for _ in range(iterations):
                trainer.iterate()
        states.append(trainer.state_dict())
    torch.set_num_threads(1)
    return {
        "iterations": iterations,
        "differ": sum(same_bits(states[0], other) for other in states[1:]),
    }


def count_non_finite(tensordict: Any) -> int:
    """Return how many numbers of a TensorDict are not finite."""
    return sum(
        int((~leaf.isfinite()).sum())
        for leaf in tensordict.values(True, True)
        if leaf.is_floating_point()
    )


def _differ(one: Any, other: Any) -> int:
    return sum(not torch.equal(one.get(key), other.get(key)) for key in one.keys(True, True))


ROWS = {
    "nan_worlds": Row(
        fault="NaN and infinities in the physics of a third of the worlds",
        must="these end within one step, counted; the others are bit-identical to those beside whole ones; nothing "
        "non-finite enters the dataset",
        limits={
            "broken": (AT_LEAST, 4),
            **dict.fromkeys(
                (
                    "not_ended_within_one_step",
                    "not_counted",
                    "others_that_differ",
                    "non_finite_in_the_dataset",
                ),
                (EXACTLY, 0),
            ),
        },
        measure=nan_worlds,
        amounts={"envs": 12},
        files=("ksim_rl/physics/world.py", "ksim_rl/envs/manager_based_rl_env.py"),
    ),
    "nan_actions": Row(
        fault="actions that are not finite, or of another shape or dtype",
        must="wrong ones refused before physics with the shape that is expected; non-finite ones end their env only",
        limits={
            "wrong": (EXACTLY, 4),
            "refused_before_physics": (EXACTLY, 4),
            "only_those_end": (EXACTLY, 1),
            "non_finite_in_next": (EXACTLY, 0),
        },
        measure=nan_actions,
        files=("ksim_rl/envs/managers/action_manager.py", "ksim_rl/envs/manager_based_rl_env.py"),
    ),
    "nan_terms": Row(
        fault="a reward, metric, command or observation gives NaN or infinity once in one env",
        must="named with its env and step, and in `explain()`; nothing is named before",
        limits={
            "cases": (EXACTLY, 15),
            "named_with_env_and_step": (EXACTLY, 15),
            "explained": (EXACTLY, 15),
            "named_too_early": (EXACTLY, 0),
        },
        measure=nan_terms,
        files=("ksim_rl/envs/non_finite.py",),
    ),
    "non_finite_loss": Row(
        fault="every loss is NaN",
        must="no step of the optimizer on it; a named error after `max_skipped_steps` in a row",
        limits={
            "steps_taken_on_it": (EXACTLY, 0),
            "iterations_until_the_stop": (AT_MOST, 5),
            "named_stop": (EXACTLY, 1),
        },
        measure=non_finite_loss,
        files=("ksim_rl/objectives/gradient_step.py", "ksim_rl/algorithms/gradient_steps.py"),
    ),
    "overflow": Row(
        fault="more contacts and constraint rows than there is room for",
        must="seen in the rollout, also after a reset; the message has the present and the needed capacity",
        limits={"cases": (EXACTLY, 2), "seen_with_needed_and_present": (EXACTLY, 2)},
        measure=overflow,
        files=("ksim_rl/physics/world.py",),
    ),
    "same_seed": Row(
        fault="the same seed twice, in two processes",
        must="all tensors of the last checkpoints identical",
        limits={"iterations": (AT_LEAST, "iterations"), "differ": (EXACTLY, 0)},
        measure=same_seed,
        amounts={"iterations": 200},
        short={"iterations": 3},
        files=("ksim_rl/device/random.py", "ksim_rl/trainers/build.py"),
    ),
    "threads": Row(
        fault="the same seed where torch and the machine have 1, 2 and 4 threads",
        must="all tensors identical",
        limits={"iterations": (AT_LEAST, "iterations"), "differ": (EXACTLY, 0)},
        measure=threads,
        amounts={"iterations": 5},
        short={"iterations": 2},
        files=("ksim_rl/trainers/build.py",),
    ),
}
