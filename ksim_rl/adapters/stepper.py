"""Drives an env by actions alone, for all adapters: it resets itself, and a step is one graph on CUDA."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np
import torch
from jaxtyping import Bool, Float32, Shaped
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import OneHot
from torchrl.envs import EnvBase
from torchrl.envs.utils import step_mdp

from ksim_rl.checks import check_choice, near
from ksim_rl.device.capture import Captured
from ksim_rl.envs.contract import Pictures, part
from ksim_rl.envs.masked_reset import MaskedReset
from ksim_rl.envs.recorded_python import FollowedGraph
from ksim_rl.envs.signal_keys import signal_keys

Keys = Mapping[str, NestedKey] | Sequence[NestedKey] | str | None
Autoreset = Literal["same_step", "next_step", "disabled"]
AUTORESETS: tuple[Autoreset, ...] = ("same_step", "next_step", "disabled")
Observations = dict[str, Shaped[Tensor, "E *?leaf"]]
"""Observations by name, each with its own leaf dims (most often one, L)."""
Shown: TypeAlias = (
    Shaped[np.ndarray, "*?leaf"]
    | Shaped[Tensor, "*?leaf"]
    | dict[str, Shaped[np.ndarray, "*?leaf"]]
    | dict[str, Shaped[Tensor, "*?leaf"]]
)
"""One array of observations, or a dict of them by name; NumPy's, or torch's on the env's device."""
Infos: TypeAlias = dict[str, Shown]
"""Further facts of a step, beside its observations, rewards and ends: each library has its own."""


@dataclass(frozen=True)
class Step:
    """One env step of E envs.

    `obs` is what a policy acts on next: where envs reset in the same step, of the new episode in rows that ended.
    `final_obs` has the observations of the states reached.
    """

    obs: Observations
    final_obs: Observations
    reward_E: Float32[Tensor, " E"]
    terminated_E: Bool[Tensor, " E"]
    truncated_E: Bool[Tensor, " E"]

    @property
    def done_E(self) -> Bool[Tensor, " E"]:
        """The rows that ended, in either way."""
        return self.terminated_E | self.truncated_E


def to_numpy(obs: Observations) -> dict[str, np.ndarray]:
    """Copy observations to the host."""
    return {name: value.cpu().numpy() for name, value in obs.items()}


class Stepper:
    """Drives an env of batch size [E], or [] as one row, and returns copies, which later steps do not change.

    It returns the observations at `keys`, by the name to return them under, as a list of keys, or as one name. None is
    every leaf that is not nested (`"actor"`, `"critic"`), or all leaves where there is no such.

    `autoreset` says when rows that ended are reset: in the "same_step"; in the "next_step", whose action and reward do
    not count for them; or by the caller, with `reset_rows` ("disabled").
    """

    def __init__(
        self, env: EnvBase, keys: Keys = None, *, autoreset: Autoreset = "same_step"
    ) -> None:
        check_choice("autoreset", autoreset, AUTORESETS)
        self.autoreset = autoreset
        if len(env.batch_size) > 1:
            raise ValueError(
                f"env.batch_size={tuple(env.batch_size)}: expected one dim, [E], or none"
            )
        self.env = env
        self.batch_dims = env.batch_dims
        self._signals = signal_keys(env)
        self.device = env.device or torch.device("cpu")
        self.keys = _named(env, keys)
        # 1 for an env without a batch.
        self.num_envs = env.batch_size.numel()
        # Other libraries know one reward per row only.
        if env.full_reward_spec[self._signals.reward].shape.numel() != self.num_envs:
            raise ValueError(
                f"{self._signals.reward!r} has several numbers per row: adapters take one reward each"
            )
        self.pictures = part(env, Pictures)
        if self.pictures:
            self.render_mode = self.pictures.render_mode
        else:
            self.render_mode = None
        # Rows that the next step resets, where it does so.
        self._ended_E = torch.zeros(self.num_envs, dtype=torch.bool, device=self.device)
        self._root: TensorDictBase | None = None
        self._out: dict[str, TensorDictBase] = {}
        self.action_spec = env.full_action_spec[env.action_key]
        # The buffer that the recorded step reads: actions are copied into it.
        self._action = self.action_spec.zero()
        # Recorded where the device can, and replayed at each step.
        self._run = Captured(self._step, device=self.device)
        self._followed = FollowedGraph(env, self._run)
        self._steps = 0

    @property
    def root(self) -> TensorDictBase:
        """The root of the next step; the env is reset if it has not been."""
        if self._root is None:
            self.reset()
        assert self._root is not None
        return self._root

    @torch.no_grad()
    def reset(self, seed: int | None = None) -> Observations:
        """Reset all envs and return their observations."""
        # Python that changed since the recording is noticed before it is used.
        self._followed.follow()
        if isinstance(self.env, MaskedReset):
            root_E = self.env.reset(seed=seed)
        else:
            if seed is not None:
                self.env.set_seed(seed)
            root_E = self.env.reset()
        self._ended_E.zero_()
        # In place after the first time, as the graph reads these very tensors.
        if self._root is None:
            self._root = root_E.clone()
        else:
            self._root.update_(root_E)
        return self.read(self._root)

    @torch.no_grad()
    def reset_rows(self, mask_E: Bool[Tensor, " E"]) -> Observations:
        """Reset the rows of a mask, and return the observations of all."""
        self._followed.follow()
        root = self.root
        mask_E = mask_E.to(self.device)
        begun = self._reset_where(root.clone(), mask_E)
        root.update_(begun.select(*root.keys(True, True)))
        self._ended_E.masked_fill_(mask_E, 0)
        return self.read(root)

    def as_action(self, values: Any) -> Shaped[Tensor, "*batch"]:
        """Return a foreign policy's choices for E rows as an action of the env: numbers, or the index of a choice."""
        # NumPy arrays and tensors alike.
        action = torch.as_tensor(values, device=self.device)
        # Other libraries choose by an index, our envs by one-hot rows.
        if isinstance(self.action_spec, OneHot):
            action = torch.nn.functional.one_hot(
                action.long().reshape(-1), self.action_spec.space.n
            )
        # [E] and [E, 1] hold the same numbers where an action has one column.
        if (
            action.shape != self._action.shape
            and action.numel() == self._action.numel() == self.num_envs
        ):
            action = action.reshape(self._action.shape)
        return (action if self.batch_dims or action.shape == self._action.shape else action[0]).to(
            self._action.dtype
        )

    @torch.no_grad()
    def step(self, action: Shaped[Tensor, "*batch"]) -> Step:
        """Step all envs, by an action of the env's own shape and dtype."""
        wanted = self._action
        if action.shape != wanted.shape or action.dtype != wanted.dtype:
            raise ValueError(
                f"action is {action.dtype} of shape {tuple(action.shape)}: "
                f"expected {wanted.dtype} of shape {tuple(wanted.shape)}"
            )
        # Resets the env where the caller has not.
        root = self.root
        self._action.copy_(action)
        # Looking takes a share of a step. So a change is noticed after at most as many steps as there were before it.
        if self._steps.bit_count() == 1:
            self._followed.follow()
        self._steps += 1
        self._run()
        next_E = self._out["next"]
        # In place: the next replay reads from the same memory.
        root.update_(self._out["root"])
        if isinstance(self.env, MaskedReset):
            # The env's own reference points into the graph's memory, which the next replay overwrites.
            self.env.last_root = root
        keys = self._signals
        # Copies, since the next replay overwrites its outputs.
        reward_E, done_E, terminated_E = (next_E.get(key).flatten().clone() for key in keys[:3])
        # An env without truncation has only ends of the other kind.
        if keys.truncated is None:
            cut_E = done_E & ~terminated_E
        else:
            cut_E = next_E.get(keys.truncated).flatten().clone()
        step = Step(self.read(root), self.read(next_E), reward_E.float(), terminated_E, cut_E)
        if self.autoreset != "next_step":
            return step
        # Rows that were reset in this step have only begun.
        fresh_E = self._ended_E.clone()
        self._ended_E.copy_(step.done_E & ~fresh_E)
        return Step(
            step.obs,
            step.final_obs,
            step.reward_E.masked_fill(fresh_E, 0.0),
            step.terminated_E & ~fresh_E,
            step.truncated_E & ~fresh_E,
        )

    def read(self, tensordict: TensorDictBase) -> Observations:
        """Return copies of the observations by name."""
        leaves = {name: tensordict.get(key).clone() for name, key in self.keys.items()}
        if self.batch_dims:
            return leaves
        return {name: leaf.unsqueeze(0) for name, leaf in leaves.items()}

    def picture(self) -> np.ndarray | None:
        """Return a picture of the envs that `cfg.viewer` shows, or None without a render mode."""
        if self.pictures:
            return self.pictures.render()
        return None

    def _step(self) -> None:
        assert self._root is not None
        # A shallow copy: the env writes new entries, but the root's stay where they are.
        td = self._root.copy().set(self.env.action_key, self._action)
        with self._followed.calling():
            if self.autoreset == "same_step":
                env_state_E, root_E = self.env.step_and_maybe_reset(td)
            else:
                env_state_E = self.env.step(td)
                root_E = step_mdp(env_state_E, keep_other=True)
                # Rows that ended one step ago took a step that the caller does not see.
                if self.autoreset == "next_step":
                    root_E = self._reset_where(root_E, self._ended_E)
        # Outputs of a replay stay where they were recorded.
        self._out = {
            "next": env_state_E.get("next"),
            "root": root_E.select(*self._root.keys(True, True)),
        }

    def _reset_where(self, root_E: TensorDictBase, mask_E: Bool[Tensor, " E"]) -> TensorDictBase:
        """Reset the rows of a mask, by the flags that `maybe_reset` reads."""
        signals = self._signals
        for key in (signals.done, signals.terminated, signals.truncated):
            if key is not None:
                flag = root_E.get(key)
                root_E.set(
                    key,
                    mask_E.view(flag.shape) if key != signals.truncated else torch.zeros_like(flag),
                )
        return self.env.maybe_reset(root_E)


def _named(env: EnvBase, keys: Keys) -> dict[str, NestedKey]:
    spec = env.full_observation_spec
    present = list(spec.keys(True, True))
    if keys is None:
        # Nested leaves are the clean terms of groups; policies read the groups.
        flat = [key for key in present if isinstance(key, str)]
        keys = flat or present
    if isinstance(keys, Mapping):
        named = dict(keys)
    else:
        named = {_flat(key): key for key in listed(keys)}
    for key in named.values():
        if key not in present:
            raise ValueError(
                f"keys: the env has no observation {key!r}: {near(_flat(key), map(_flat, present))}"
            )
    return named


def listed(keys: Sequence[NestedKey] | str) -> list[NestedKey]:
    """Return keys as a list; a text is one key, and no sequence of letters."""
    return [keys] if isinstance(keys, str) else list(keys)


def _flat(key: NestedKey) -> str:
    if isinstance(key, str):
        return key
    return ".".join(map(str, key))
