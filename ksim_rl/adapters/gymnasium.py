"""Shows an env as Gymnasium's `VectorEnv` or `Env`, with NumPy arrays or with tensors that stay on the device."""

from collections.abc import Sequence
from typing import Any, TypeAlias, TypeVar

import numpy as np
import torch
from jaxtyping import Shaped
from torch import Tensor
from torchrl.envs import EnvBase

from ksim_rl import envs
from ksim_rl.adapters.spaces import finite, space_of
from ksim_rl.adapters.stepper import (
    Autoreset,
    Infos,
    Keys,
    Observations,
    Shown,
    Stepper,
    to_numpy,
)
from ksim_rl.checks import check_in_range
from ksim_rl.envs.contract import EpisodeClock, part

try:
    import gymnasium
    from gymnasium import spaces
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space
except ImportError as error:
    raise ImportError('gymnasium is not installed: pip install "ksim_rl[gymnasium]"') from error

from ksim_rl.adapters.gymnasium_ids import register

MODES: dict[AutoresetMode, Autoreset] = {
    AutoresetMode.SAME_STEP: "same_step",
    AutoresetMode.NEXT_STEP: "next_step",
    AutoresetMode.DISABLED: "disabled",
}

Array = TypeVar("Array", np.ndarray, Tensor)
Signal: TypeAlias = Shaped[np.ndarray, " E"] | Shaped[Tensor, " E"]
"""A reward or a flag of each env."""


class GymnasiumVectorEnv(VectorEnv):
    """Steps an env for Gymnasium: `(obs, reward [E], terminated [E], truncated [E], infos)`.

    `obs` is an array [E, L] of the one observation of `keys`, whose space is a `Box`, or a dict of them by name; see
    `Stepper`. `autoreset_mode` is Gymnasium's. With SAME_STEP, where an episode ended, `infos["final_obs"]` has its
    last observations and `infos["_final_obs"]` the mask, as Gymnasium's own vector envs do. With NEXT_STEP the step
    after an episode's end gives the first observation of the next one and reward 0, whatever its action. With DISABLED
    envs go on until `reset(options={"reset_mask": mask_E})` resets some.

    Arrays are NumPy's, and `final_obs` is an object array with one entry per ended env (else None). With `tensors` they
    are tensors on the env's device without any host sync, and `final_obs` is of all rows. The env comes from
    `envs.make`, or is any env of batch size [E] with a continuous action.
    """

    def __init__(
        self,
        env: EnvBase,
        *,
        keys: Keys = None,
        tensors: bool = False,
        autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
    ) -> None:
        self.env = env
        self.tensors = tensors
        mode = _mode(autoreset_mode)
        self._stepper = Stepper(env, keys, autoreset=MODES[mode])
        self._names = _Names(self._stepper)
        self.num_envs = self._stepper.num_envs
        self.render_mode = self._stepper.render_mode
        # Tells wrappers which episode `obs` belongs to where one has ended.
        self.metadata = {"autoreset_mode": mode, **_rendering(self._stepper)}
        self.single_observation_space = self._names.space
        self.single_action_space = space_of(
            self._stepper.action_spec, batch_dims=self._stepper.batch_dims
        )
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Shown, Infos]:
        """Reset all envs, whose draws follow from one seed; a list of one per env, as Gymnasium takes, makes one.

        The one option is "reset_mask", bool [E], for the rows to reset where `autoreset_mode` is DISABLED; the draws of
        the others go on, so that it takes no seed. A list s, s + 1, s + 2, ... is the seed s, which means the same in
        Gymnasium.
        """
        if (
            options
            and "reset_mask" in options
            and self.metadata["autoreset_mode"] == AutoresetMode.DISABLED
        ):
            return self._reset_rows(seed, dict(options)), {}
        if options:
            raise ValueError(
                f"options={options!r}: this env has no reset options but reset_mask, with autoreset_mode=DISABLED"
            )
        # Gymnasium takes a seed per env; our env draws all rows from one.
        if not (seed is None or isinstance(seed, int)):
            seed = _one_seed(seed, self.num_envs)
        super().reset(seed=seed)
        return self._out(self._stepper.reset(seed)), {}

    def step(
        self, actions_E: Shaped[np.ndarray, " E *leaf"] | Shaped[Tensor, " E *leaf"]
    ) -> tuple[Shown, Signal, Signal, Signal, Infos]:
        """Step all envs."""
        step = self._stepper.step(self._stepper.as_action(actions_E))
        done_E = step.done_E
        infos: Infos = {}
        # In the other modes `obs` itself is the last of its episode.
        if self.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP:
            # Without asking the device whether an episode ended, since that would wait for it.
            if self.tensors:
                infos = {"final_obs": self._names.out(step.final_obs), "_final_obs": done_E}
            # Only then are the last observations copied to the host.
            elif bool(done_E.any()):
                infos = self._final_obs(to_numpy(step.final_obs), done_E.cpu().numpy())
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

    def _out(self, obs: Observations) -> Shown:
        if self.tensors:
            return self._names.out(obs)
        return self._names.out(to_numpy(obs))

    def _reset_rows(self, seed: Any, options: dict[str, Any]) -> Shown:
        mask = torch.as_tensor(options.pop("reset_mask"))
        if seed is not None or options:
            raise ValueError(
                f"seed={seed!r}, options {sorted(options)}: a reset of some rows takes reset_mask alone"
            )
        if mask.dtype != torch.bool or mask.shape != (self.num_envs,):
            raise ValueError(
                f"reset_mask of {mask.dtype} {tuple(mask.shape)}: expected bool ({self.num_envs},)"
            )
        return self._out(self._stepper.reset_rows(mask))

    def _final_obs(self, obs: dict[str, np.ndarray], done_E: np.ndarray) -> Infos:
        """Return the last observations in Gymnasium's layout: an object per env, and who has one."""
        # Gymnasium's layout: None where no episode ended.
        final = np.full(done_E.shape, fill_value=None, dtype=object)
        for row in np.flatnonzero(done_E):
            last = {name: value[row].copy() for name, value in obs.items()}
            final[row] = self._names.out(last)
        return {"final_obs": final, "_final_obs": done_E}


class GymnasiumEnv(gymnasium.Env):
    """One env for Gymnasium: `(obs, reward, terminated, truncated, info)`, with arrays [L]; the caller resets it.

    `obs` is an array for one observation of `keys`, else a dict; see `Stepper`. The env has one row: `envs.make(name,
    num_envs=1)`. `action_limit` bounds actions without bounds in the env's spec, since others want finite ones.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"]}

    def __init__(self, env: EnvBase, *, keys: Keys = None, action_limit: float = 1.0) -> None:
        check_in_range("action_limit", action_limit, low=0.0, low_open=True)
        self.env = env
        self._stepper = Stepper(env, keys, autoreset="disabled")
        if self._stepper.num_envs != 1:
            raise ValueError(
                f"env.batch_size={tuple(env.batch_size)}: a single env has one row; use num_envs=1, or "
                "GymnasiumVectorEnv"
            )
        self._names = _Names(self._stepper)
        self.render_mode = self._stepper.render_mode
        self.metadata = {
            **type(self).metadata,
            "render_fps": _rendering(self._stepper)["render_fps"],
        }
        self.observation_space = self._names.space
        space = space_of(self._stepper.action_spec, batch_dims=self._stepper.batch_dims)
        self.action_space = finite(space, action_limit)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Shown, Infos]:
        """Begin an episode, whose draws follow from the seed; there are no options."""
        if options:
            raise ValueError(f"options={options!r}: this env has no reset options; use seed=")
        super().reset(seed=seed)
        # Without a seed the draws go on, as in an episode's end.
        if seed is None:
            obs = self._stepper.reset_rows(torch.ones(1, dtype=torch.bool))
        else:
            obs = self._stepper.reset(seed)
        return self._first(obs), {}

    def step(self, action: Any) -> tuple[Shown, float, bool, bool, Infos]:
        """Step the env."""
        step = self._stepper.step(self._stepper.as_action(np.asarray(action)[None]))
        flags = bool(step.terminated_E[0]), bool(step.truncated_E[0])
        return self._first(step.obs), float(step.reward_E[0]), *flags, {}

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """Return a picture, or None without a render mode."""
        return self._stepper.picture()

    def close(self) -> None:
        """Free the env's memory."""
        if not self.env.is_closed:
            self.env.close()

    def _first(self, obs: Observations) -> Shown:
        return self._names.out({name: value[0] for name, value in to_numpy(obs).items()})


class _Names:
    """Knows whether observations are one array or a dict of them."""

    def __init__(self, stepper: Stepper) -> None:
        spec = stepper.env.full_observation_spec
        boxes = {
            name: space_of(spec[key], batch_dims=stepper.batch_dims)
            for name, key in stepper.keys.items()
        }
        self._single = next(iter(boxes)) if len(boxes) == 1 else None
        self.space = spaces.Dict(boxes) if self._single is None else boxes[self._single]

    def out(self, obs: dict[str, Array]) -> Array | dict[str, Array]:
        """Return the one observation, or all by name."""
        return obs if self._single is None else obs[self._single]


def _rendering(stepper: Stepper) -> dict[str, list[str] | int]:
    clock = part(stepper.env, EpisodeClock)
    return {
        "render_modes": [mode for mode in (stepper.render_mode,) if mode],
        # Pictures per second in real time; 1 where the env has no clock.
        "render_fps": round(1.0 / clock.step_dt) if clock else 1,
    }


def _mode(given: AutoresetMode | str) -> AutoresetMode:
    """Return Gymnasium's mode of this name, such as "NEXT_STEP"."""
    for mode in MODES:
        if given in (mode, mode.name, mode.value):
            return mode
    names = ", ".join(mode.name for mode in MODES)
    raise ValueError(f"autoreset_mode={given!r}: expected one of {names}")


def make_task(
    task: str, *, keys: Keys = ("actor",), action_limit: float = 1.0, **options: Any
) -> GymnasiumEnv:
    """Build a registered task as one env; `options` are of `envs.make`: device, seed, overrides, render_mode."""
    return GymnasiumEnv(
        envs.make(task, num_envs=1, **options), keys=keys, action_limit=action_limit
    )


def make_tasks(
    task: str,
    *,
    num_envs: int = 1,
    keys: Keys = ("actor",),
    tensors: bool = False,
    autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
    **options: Any,
) -> GymnasiumVectorEnv:
    """Build a registered task as a vector env; `options` are of `envs.make`: device, seed, overrides, render_mode."""
    env = envs.make(task, num_envs=num_envs, **options)
    return GymnasiumVectorEnv(env, keys=keys, tensors=tensors, autoreset_mode=autoreset_mode)


def _one_seed(seeds: Sequence[int | None], num_envs: int) -> int | None:
    if len(seeds) != num_envs:
        raise ValueError(f"seed={list(seeds)!r}: expected one per env, {num_envs}")
    if None in seeds:
        return None
    first = int(seeds[0] or 0)
    # Gymnasium turns a single seed s into s, s + 1, ...
    if all(seed == first + row for row, seed in enumerate(seeds)):
        return first
    # Mixed into one seed; shifted to fit a signed integer.
    sequence = np.random.SeedSequence([int(seed or 0) for seed in seeds])
    mixed = sequence.generate_state(1)[0]
    return int(mixed >> 1)


# Importing this module is all that `gymnasium.make("ksim_rl.adapters.gymnasium:ksim_rl/walker_walk-v0")` does first.
register()
