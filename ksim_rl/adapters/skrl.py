"""Shows an env as one that skrl has wrapped, so that skrl's agents and trainers run on it."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Shaped
from tensordict import NestedKey
from torch import Tensor
from torchrl.envs import EnvBase

from ksim_rl.adapters.stepper import Infos, Observations, Stepper, listed

try:
    from gymnasium import spaces
    from skrl.envs.wrappers.torch import Wrapper

    from ksim_rl.adapters.spaces import space_of
except ImportError as error:
    raise ImportError('skrl is not installed: pip install "ksim_rl[skrl]"') from error


class SkrlWrapper(Wrapper):
    """Steps an env for skrl, with tensors on its device; rows that ended come back in their next episode.

    Agents observe the leaves at `keys`, side by side [E, L]. Critics that see more read
    the leaves at `state_keys` through `state`; without any it is None. `infos["final_obs"]` has the observations of the
    states reached. The env keeps its own seed, and only the first `reset` resets it, as skrl's wrappers of vector envs
    do.
    """

    def __init__(
        self,
        env: EnvBase,
        *,
        keys: Sequence[NestedKey] | str = ("actor",),
        state_keys: Sequence[NestedKey] | str = (),
    ) -> None:
        super().__init__(env)
        # Each leaf once, also where actor and critic read it both.
        keys = listed(keys)
        state_keys = listed(state_keys)
        self._stepper = Stepper(env, list(dict.fromkeys((*keys, *state_keys))))
        names = {key: name for name, key in self._stepper.keys.items()}
        self._observed = [names[key] for key in keys]
        self._seen = [names[key] for key in state_keys]
        self._current: Observations = {}
        self._spaces = {
            name: space_of(env.full_observation_spec[key], batch_dims=self._stepper.batch_dims)
            for key, name in names.items()
        }
        self._action_space = space_of(
            self._stepper.action_spec, batch_dims=self._stepper.batch_dims
        )

    @property
    def device(self) -> torch.device:
        """Where observations and rewards are."""
        return self._stepper.device

    @property
    def num_envs(self) -> int:
        """E."""
        return self._stepper.num_envs

    @property
    def observation_space(self) -> spaces.Box:
        """The space of one row of the agents' observations."""
        return self._joined_space(self._observed)

    @property
    def state_space(self) -> spaces.Box | None:
        """The space of one row of `state`, if there is any."""
        if self._seen:
            return self._joined_space(self._seen)
        return None

    @property
    def action_space(self) -> spaces.Space:
        """The space of one row's action."""
        return self._action_space

    def reset(self) -> tuple[Float[Tensor, "E L"], Infos]:
        """Return the observations that the next actions answer to; the first call resets all envs."""
        # skrl resets before each training; its wrappers of vector envs go on instead.
        self._current = self._current or self._stepper.reset()
        return self._joined(self._current, self._observed), {}

    def step(
        self, actions: Shaped[Tensor, " E *leaf"]
    ) -> tuple[
        Float[Tensor, "E L"], Float[Tensor, "E 1"], Bool[Tensor, "E 1"], Bool[Tensor, "E 1"], Infos
    ]:
        """Step all envs."""
        step = self._stepper.step(self._stepper.as_action(actions))
        self._current = step.obs
        # The states reached, since `obs` of an ended row is of its next episode.
        infos: Infos = {"final_obs": self._joined(step.final_obs, self._observed)}
        flags = (step.reward_E, step.terminated_E, step.truncated_E)
        # skrl wants a column for each of them.
        reward_E1, terminated_E1, truncated_E1 = (flag.unsqueeze(-1) for flag in flags)
        return self._joined(step.obs, self._observed), reward_E1, terminated_E1, truncated_E1, infos

    def state(self) -> Float[Tensor, "E L"] | None:
        """Return the critics' inputs, of the same state as the last observations of `reset` or `step`."""
        if self._seen:
            return self._joined(self._current or self._stepper.reset(), self._seen)
        return None

    def render(self, *args: Any, **kwargs: Any) -> np.ndarray | None:
        """Return the picture of the envs that `cfg.viewer` shows, or None without a render mode."""
        return self._stepper.picture()

    def close(self) -> None:
        """Free the env's memory."""
        self._stepper.env.close()

    def _joined(self, leaves: Observations, names: list[str]) -> Tensor:
        # float32 for all: masks and integers become numbers.
        return torch.cat([leaves[name].flatten(1).float() for name in names], -1)

    def _joined_space(self, names: list[str]) -> spaces.Box:
        boxes = [self._spaces[name] for name in names]
        low, high = (
            np.concatenate([getattr(box, edge).ravel() for box in boxes])
            for edge in ("low", "high")
        )
        return spaces.Box(low.astype(np.float32), high.astype(np.float32), dtype=np.float32)
