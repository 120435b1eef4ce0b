"""The tensors of an env that its state dict holds in addition to its worlds."""

from collections.abc import Mapping

from jaxtyping import Shaped
from torch import Tensor

from ksim_rl.device.state_tree import State, tensors
from ksim_rl.envs.driver import EnvDriver
from ksim_rl.envs.managers.outcomes import CurriculumManager, EpisodeLog, RewardManager

ENV = "env."
WORLD = "world."


def buffers_to_save(
    driver: EnvDriver, rewards: RewardManager, curricula: CurriculumManager, log: EpisodeLog
) -> dict[str, Shaped[Tensor, "*?shape"]]:
    """Return the tensors that later steps depend on, by name: counters, shared values and buffers of terms."""
    counters = {
        "seed": driver.seed,
        "step_count": driver.step_count,
        "reset_count_E": driver.reset_count_E,
        "episode_step_E": driver.episode_step_E,
        "reward_weights_R": rewards.weights_R,
        "curriculum_levels_C": curricula.levels_C,
        "episode_log_N": log.totals_N,
    }
    shared = {f"shared/{name}": tensor for name, tensor in driver.shared_values.by_name().items()}
    return counters | shared | driver.buffers.by_name()


def joined(
    of_env: Mapping[str, Shaped[Tensor, "*?shape"]],
    of_world: Mapping[str, Shaped[Tensor, "*?shape"]],
) -> State:
    """Return the state dict of an env and its worlds; the env's tensors are copied."""
    state = {f"{WORLD}{name}": value for name, value in of_world.items()}
    for name, tensor in of_env.items():
        state[f"{ENV}{name}"] = tensor.clone()
    return state


def parts(
    state: State,
) -> tuple[dict[str, Shaped[Tensor, "*?shape"]], dict[str, Shaped[Tensor, "*?shape"]]]:
    """Return the env's entries of a state dict, and the entries of its worlds; see `joined`."""
    of_env = {}
    of_world = {}
    for name, value in tensors(state).items():
        if name.startswith(ENV):
            of_env[name.removeprefix(ENV)] = value
        elif name.startswith(WORLD):
            of_world[name.removeprefix(WORLD)] = value
    return of_env, of_world


def completed(
    given: Mapping[str, Shaped[Tensor, "*?shape"]], present: Mapping[str, Shaped[Tensor, "*?shape"]]
) -> dict[str, Shaped[Tensor, "*?shape"]]:
    """Return a value for each name of `present`: from `given`, or else the present one."""
    return {name: given.get(name, value) for name, value in present.items()}
