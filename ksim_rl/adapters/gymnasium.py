"""This module shows an env as Gymnasium's `VectorEnv`, with NumPy arrays or with tensors that stay on the device."""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torchrl.envs import EnvBase

from ksim_rl.adapters.spaces import box
from ksim_rl.adapters.stepper import Keys, Observations, Stepper, to_numpy
from ksim_rl.envs.contract import EpisodeClock, part

try:
    from gymnasium import spaces
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space
except ImportError as error:
    raise ImportError('gymnasium is not installed: pip install "ksim_rl[gymnasium]"') from error


class GymnasiumVectorEnv(VectorEnv):
    """Steps an env for Gymnasium: `(obs, reward [E], terminated [E], truncated [E], infos)`, reset in the same step.

    `obs` is a dict of arrays [E, L] by name. Where an episode ended, `infos["final_obs"]` has its last observations
    and `infos["_final_obs"]` the mask, as Gymnasium's own vector envs do with `AutoresetMode.SAME_STEP`.

    Args:
        env: what `envs.make` returns, or any env of batch size [E] with a continuous action.
        keys: the observations to give; see `Stepper`.
        tensors: False gives NumPy arrays, and `final_obs` is an object array with one dict per ended env (else None).
            True gives tensors on the env's device without any host sync, and `final_obs` is a dict of tensors [E, L]
            for all rows.
    """

    def __init__(self, env: EnvBase, *, keys: Keys = None, tensors: bool = False) -> None:
        self.env, self.tensors = env, tensors
        self._stepper = Stepper(env, keys)
        self.num_envs, self.render_mode = self._stepper.num_envs, self._stepper.render_mode
        clock = part(env, EpisodeClock)
        self.metadata = {
            "autoreset_mode": AutoresetMode.SAME_STEP,
            "render_modes": [mode for mode in (self.render_mode,) if mode],
            "render_fps": round(1.0 / clock.step_dt) if clock else 1,
        }
        self.single_observation_space = spaces.Dict(
            {name: box(env.full_observation_spec[key]) for name, key in self._stepper.keys.items()}
        )
        self.single_action_space = box(env.full_action_spec[env.action_key])
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Reset all envs.

        Raises:
            ValueError: on options, of which there are none.
        """
        if options:
            raise ValueError(f"options={options!r}: this env has no reset options; use seed=")
        super().reset(seed=seed)
        return self._out(self._stepper.reset(seed)), {}

    def step(
        self, action_EL: Float[np.ndarray, "E L"] | Float[Tensor, "E L"]
    ) -> tuple[dict[str, Any], Any, Any, Any, dict[str, Any]]:
        """Step all envs."""
        device = self._stepper.device
        step = self._stepper.step(torch.as_tensor(action_EL, dtype=torch.float32, device=device))
        done_E = step.done_E
        infos: dict[str, Any] = {}
        if self.tensors:
            infos = {"final_obs": step.final_obs, "_final_obs": done_E}
        elif bool(done_E.any()):
            infos = _final_obs(to_numpy(step.final_obs), done_E.cpu().numpy())
        flags = (step.reward_E, step.terminated_E, step.truncated_E)
        reward, terminated, truncated = flags if self.tensors else (value.cpu().numpy() for value in flags)
        return self._out(step.obs), reward, terminated, truncated, infos

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Return the picture of the envs that `cfg.viewer` shows, in a tuple, or None without a render mode."""
        picture = self._stepper.picture()
        return None if picture is None else (picture,)

    def close_extras(self, **kwargs: Any) -> None:
        """Free the env's memory."""
        self.env.close()

    def _out(self, obs: Observations) -> dict[str, Any]:
        return obs if self.tensors else to_numpy(obs)


def _final_obs(obs: dict[str, np.ndarray], done_E: np.ndarray) -> dict[str, Any]:
    """Return the last observations in Gymnasium's layout: an object per env, and who has one."""
    final = np.full(done_E.shape, fill_value=None, dtype=object)
    for row in np.flatnonzero(done_E):
        final[row] = {name: value[row].copy() for name, value in obs.items()}
    return {"final_obs": final, "_final_obs": done_E}
