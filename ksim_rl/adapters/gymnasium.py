"""Shows an env as Gymnasium's `VectorEnv`, with NumPy arrays or with tensors that stay on the device."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Shaped
from torch import Tensor
from torchrl.envs import EnvBase

from ksim_rl.adapters.spaces import space_of
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

    `obs` is a dict of arrays [E, L] by name, of the observations `keys`; see `Stepper`. Where an episode ended,
    `infos["final_obs"]` has its last observations and `infos["_final_obs"]` the mask, as Gymnasium's own vector envs do
    with `AutoresetMode.SAME_STEP`. Arrays are NumPy's, and `final_obs` is an object array with one dict per ended env
    (else None). With `tensors` they are tensors on the env's device without any host sync, and `final_obs` is a dict of
    tensors [E, L] for all rows. The env comes from `envs.make`, or is any env of batch size [E] with a continuous
    action.
    """

    def __init__(self, env: EnvBase, *, keys: Keys = None, tensors: bool = False) -> None:
        self.env = env
        self.tensors = tensors
        self._stepper = Stepper(env, keys)
        self.num_envs = self._stepper.num_envs
        self.render_mode = self._stepper.render_mode
        clock = part(env, EpisodeClock)
        # Tells wrappers that `obs` is of the new episode where one has ended.
        self.metadata = {
            "autoreset_mode": AutoresetMode.SAME_STEP,
            "render_modes": [mode for mode in (self.render_mode,) if mode],
            # Pictures per second in real time; 1 where the env has no clock.
            "render_fps": round(1.0 / clock.step_dt) if clock else 1,
        }
        dims = self._stepper.batch_dims
        spec = env.full_observation_spec
        self.single_observation_space = spaces.Dict(
            {name: space_of(spec[key], batch_dims=dims) for name, key in self._stepper.keys.items()}
        )
        self.single_action_space = space_of(self._stepper.action_spec, batch_dims=dims)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Reset all envs, whose draws follow from one seed; a list of one per env, as Gymnasium takes, makes one.

        There are no `options`. A list s, s + 1, s + 2, ... is the seed s, which means the same in Gymnasium.
        """
        if options:
            raise ValueError(f"options={options!r}: this env has no reset options; use seed=")
        # Gymnasium takes a seed per env; our env draws all rows from one.
        if not (seed is None or isinstance(seed, int)):
            seed = _one_seed(seed, self.num_envs)
        super().reset(seed=seed)
        return self._out(self._stepper.reset(seed)), {}

    def step(
        self, actions_E: Shaped[np.ndarray, " E *leaf"] | Shaped[Tensor, " E *leaf"]
    ) -> tuple[dict[str, Any], Any, Any, Any, dict[str, Any]]:
        """Step all envs."""
        step = self._stepper.step(self._stepper.as_action(actions_E))
        done_E = step.done_E
        infos: dict[str, Any] = {}
        # Without asking the device whether an episode ended, since that would wait for it.
        if self.tensors:
            infos = {"final_obs": step.final_obs, "_final_obs": done_E}
        # Only then are the last observations copied to the host.
        elif bool(done_E.any()):
            infos = _final_obs(to_numpy(step.final_obs), done_E.cpu().numpy())
        flags = (step.reward_E, step.terminated_E, step.truncated_E)
        if self.tensors:
            reward, terminated, truncated = flags
        else:
            reward, terminated, truncated = (value.cpu().numpy() for value in flags)
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


def _one_seed(seeds: Sequence[int | None], num_envs: int) -> int | None:
    if len(seeds) != num_envs:
        raise ValueError(f"seed={list(seeds)!r}: expected one per env, {num_envs}")
    if None in seeds:
        return None
    first = int(seeds[0] or 0)
    # s, s + 1, ... is what Gymnasium makes of a single seed s.
    if all(seed == first + row for row, seed in enumerate(seeds)):
        return first
    # Mixed into one seed; shifted to fit a signed integer.
    return int(np.random.SeedSequence([int(seed or 0) for seed in seeds]).generate_state(1)[0] >> 1)


def _final_obs(obs: dict[str, np.ndarray], done_E: np.ndarray) -> dict[str, Any]:
    """Return the last observations in Gymnasium's layout: an object per env, and who has one."""
    # Gymnasium's layout: None where no episode ended.
    final = np.full(done_E.shape, fill_value=None, dtype=object)
    for row in np.flatnonzero(done_E):
        final[row] = {name: value[row].copy() for name, value in obs.items()}
    return {"final_obs": final, "_final_obs": done_E}
