"""Restores parts of a checkpoint, and explains in one line what does not fit."""

from pathlib import Path

import torch
from torchrl.envs import EnvBase

from ksim_rl.device.state_tree import State, tensor
from ksim_rl.trainers.algorithm import Update

# Networks of an update's state.
ACTOR = "actor"
CRITIC = "critic"
# What belongs to a critic, and starts from scratch with it: its slow copy, and the temperature of SAC.
WITH_CRITIC = (CRITIC, "target_critic", "log_alpha")


def load_env_state(env: EnvBase, state: State) -> None:
    """Continue an env where its state was taken.

    Raises:
        ValueError: if the state is of another env, with what differs.
    """
    try:
        env.load_state_dict(state)
    except (RuntimeError, ValueError) as error:
        # torch raises a RuntimeError for names and shapes, in several lines.
        reason = " ".join(str(error).split()).rstrip(".")
        raise ValueError(
            f"the checkpoint is of another env, or of one that an earlier ksim_rl built: {reason}. Its networks "
            "may still fit: ksim-rl train checkpoint=RUN"
        ) from error


def load_networks(update: Update, state: State, path: Path) -> str:
    """Start from the networks and normalizers of a checkpoint; optimizers and counts stay new.

    A policy that was cloned or distilled has no critic: this run's then starts from scratch. Returns a line that says
    so.

    Raises:
        ValueError: if the networks are others, with the path of the checkpoint.
    """
    note = ""
    own = update.state_dict()
    if ACTOR in state and CRITIC in own and CRITIC not in state:
        fresh = {name: own[name] for name in WITH_CRITIC if name in own}
        state = {**state, **fresh}
        note = f"{path} has a policy and no critic: the critic starts from scratch"
        if "target_critic" in own:
            note += "; with data.policy_starts it learns for a while before the policy does"
    try:
        update.load_weights(state)
    except KeyError as error:
        raise ValueError(f"{path}: of another algorithm: it has no network {error}") from error
    # Another number or size of layers.
    except ValueError as error:
        raise ValueError(
            f"{path}: its networks are others: {error}; choose objective and modules as the "
            "config.yaml of its run has them"
        ) from error
    return note


def random_state(device: torch.device) -> State:
    """Return the states of torch's generators that a run on a device draws from."""
    states = {"cpu": torch.get_rng_state()}
    if device.type == "cuda":
        states["cuda"] = torch.cuda.get_rng_state(device)
    return states


def load_random_state(states: State, device: torch.device) -> None:
    """Put the states of torch's generators back."""
    torch.set_rng_state(tensor(states, "cpu"))
    # A run that moves to another kind of device keeps that one's present state.
    if device.type == "cuda" and "cuda" in states:
        torch.cuda.set_rng_state(tensor(states, "cuda"), device)
