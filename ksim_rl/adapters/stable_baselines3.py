"""Shows an env as stable-baselines3's `VecEnv`, so that its algorithms train on it."""

from typing import Any

import numpy as np
from jaxtyping import Shaped
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn
from torch import Tensor
from torchrl.envs import EnvBase

from ksim_rl.adapters.stepper import Keys, Observations, Stepper, to_numpy
from ksim_rl.checks import check_in_range

try:
    from gymnasium import spaces
    from stable_baselines3.common.vec_env import VecEnv

    from ksim_rl.adapters.spaces import finite, space_of
except ImportError as error:
    raise ImportError(
        'stable-baselines3 is not installed: pip install "ksim_rl[stable_baselines3]"'
    ) from error


# Attributes that each row would have if it were a Gymnasium env.
_OF_ROWS = ("render_mode", "observation_space", "action_space")


class StableBaselines3VecEnv(VecEnv):
    """Steps an env of batch size [E] with a continuous action for stable-baselines3, with NumPy arrays.

    With one observation of `keys` (see `Stepper`) the space is a `Box` ("MlpPolicy"), with several a `Dict`
    ("MultiInputPolicy"). Where an episode ended, `infos[row]` has `"terminal_observation"` and `"TimeLimit.truncated"`.
    `action_limit` bounds actions without bounds in the env's spec, since stable-baselines3 wants finite ones.
    """

    def __init__(self, env: EnvBase, *, keys: Keys = None, action_limit: float = 1.0) -> None:
        check_in_range("action_limit", action_limit, low=0.0, low_open=True)
        self.env = env
        self._stepper = Stepper(env, keys)
        self.render_mode = self._stepper.render_mode
        dims = self._stepper.batch_dims
        spec = env.full_observation_spec
        boxes = {
            name: space_of(spec[key], batch_dims=dims) for name, key in self._stepper.keys.items()
        }
        # "MlpPolicy" takes a plain array, "MultiInputPolicy" a dict.
        if len(boxes) == 1:
            self._single = next(iter(boxes))
        else:
            self._single = None
        # Infinite bounds cannot be rescaled, which some of its algorithms do.
        action = finite(space_of(self._stepper.action_spec, batch_dims=dims), action_limit)
        super().__init__(
            num_envs=self._stepper.num_envs,
            observation_space=spaces.Dict(dict(boxes))
            if self._single is None
            else boxes[self._single],
            action_space=action,
        )
        self._action: Tensor | None = None

    def reset(self) -> np.ndarray | dict[str, np.ndarray]:
        """Reset all envs, with the seed that `seed` was given, if any."""
        # The base class keeps a seed per row; our env has one for all rows.
        obs = self._stepper.reset(self._seeds[0])
        self._reset_seeds()
        self._reset_options()
        return self._out(obs)

    # Two calls, as subprocess envs need; here the step is done in the second one.
    def step_async(self, actions_E: Shaped[np.ndarray, " E *leaf"]) -> None:
        """Take the actions of the next `step_wait`."""
        self._action = self._stepper.as_action(actions_E)

    def step_wait(self) -> VecEnvStepReturn:
        """Step all envs."""
        if self._action is None:
            raise RuntimeError("step_wait without actions: call step_async first")
        step = self._stepper.step(self._action)
        self._action = None
        done_E = step.done_E.cpu().numpy()
        terminated_E = step.terminated_E.cpu().numpy()
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        # The copy to the host is made only where an episode ended.
        if done_E.any():
            final = to_numpy(step.final_obs)
            for row in np.flatnonzero(done_E):
                last = {name: value[row] for name, value in final.items()}
                infos[row] = {
                    "terminal_observation": last if self._single is None else last[self._single],
                    # stable-baselines3 bootstraps the value where this is true.
                    "TimeLimit.truncated": bool(not terminated_E[row]),
                }
        return self._out(step.obs), step.reward_E.cpu().numpy(), done_E, infos

    def close(self) -> None:
        """Free the env's memory."""
        self.env.close()

    def get_images(self) -> list[np.ndarray | None]:
        """Return the picture of the envs that `cfg.viewer` shows."""
        return [self._stepper.picture()]

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return an attribute of the env, or one that stable-baselines3 asks for, once per index: all are one env."""
        value = getattr(self if attr_name in _OF_ROWS else self.env, attr_name)
        return [value for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Refuse: all rows are one env, whose attributes are its config."""
        raise NotImplementedError(
            f"set_attr({attr_name!r}): the rows are one env; change its config and build it"
        )

    def env_method(
        self,
        method_name: str,
        *method_args: Any,
        indices: VecEnvIndices = None,
        **method_kwargs: Any,
    ) -> list[Any]:
        """Call a method of the env once, and return its result once per index."""
        result = getattr(self.env, method_name)(*method_args, **method_kwargs)
        return [result for _ in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: type, indices: VecEnvIndices = None) -> list[bool]:
        """Return False for each index: there are no Gymnasium wrappers inside."""
        return [False for _ in self._get_indices(indices)]

    def _out(self, obs: Observations) -> np.ndarray | dict[str, np.ndarray]:
        arrays = to_numpy(obs)
        if self._single is None:
            return arrays
        return arrays[self._single]
