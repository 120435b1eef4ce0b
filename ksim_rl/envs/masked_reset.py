"""Resets by masks: `step_and_maybe_reset` never syncs, and partial resets keep the other rows."""

import functools
import random
import secrets
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Shaped
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Composite
from torchrl.envs import EnvBase

from ksim_rl import checks, dims
from ksim_rl.envs import upstream
from ksim_rl.transforms.upstream import base_of

upstream.let_none_keep_names()
_RESET = "_reset"
Tree = TypeVar("Tree", TensorDictBase, Composite)
_RESET_KEYWORDS = ("tensordict", "seed", "env_ids", "options", "set_state", "select_reset_only")


class _Seed:
    """A descriptor that makes `seed` a method of an env and of its class, too."""

    def __get__(self, env: EnvBase | None, _owner: type) -> Callable[..., int]:
        return functools.partial(_seed, env)


def _seed(env: EnvBase | None, seed: int = -1) -> int:
    if seed == -1:
        # -1 stands for a seed that is drawn here; the caller gets it back.
        seed = secrets.randbelow(2**31)
    if env is not None:
        env.set_seed(seed)
    else:
        random.seed(seed)
        # NumPy takes 32 bits only.
        np.random.seed(seed % 2**32)
        torch.manual_seed(seed)
    return seed


class MaskedReset(EnvBase):
    """Base of an env with batch size [E] whose `_reset` honours the mask `"_reset"` (bool, [E, 1]), all-False included.

    Write `class MyEnv(MaskedReset)` instead of `class MyEnv(EnvBase)`, with `_step`, `_reset` and `_set_seed` as
    TorchRL asks for. `_reset` must change the state of the masked rows only; its return values in the other rows are
    ignored, so it may return anything there. It gives:

    * `maybe_reset`: `_reset` runs at every step with `done` as its mask, so that nothing is read by the host.
      Trajectories equal TorchRL's own if the draws in `_reset` are keyed per row (see `ksim_rl.device.random`).
    * `reset(tensordict, seed=, env_ids=, options=)`: untouched rows come back with their last root values.
    * `seed(seed=-1)`: returns the seed used. It ends in `_set_seed`, so that is where an env stores it. On the class,
      which draws nothing itself, it seeds Python, NumPy and torch.
    * `rollout` labelled ("E", "T"), and the label "E" on all that `step` and `reset` return.

    An env with batch size [] and foreign simulators (Gym, batched processes) keep TorchRL's own reset: those cannot
    be asked to reset nothing.
    """

    # A reference, so that it costs nothing per step. Inside a captured graph it points to the graph's static output.
    last_root: TensorDictBase | None = None
    """The root values that the next action answers to; a caller that replays a graph sets it after a replay."""
    seed = _Seed()

    def _remember(self, root: TensorDictBase | None) -> None:
        # Past `nn.Module.__setattr__`, which takes longer than the rest of this.
        object.__setattr__(self, "last_root", root)

    @property
    def dim_names(self) -> list[str | None]:
        """Labels of the batch dims: "E" for the first."""
        if self.batch_size:
            return [dims.E, *[None] * (len(self.batch_size) - 1)]
        return []

    def _step_proc_data(self, next_tensordict_out: TensorDictBase) -> TensorDictBase:
        # The root that the next action answers to, unless `maybe_reset` replaces it.
        next_td = self._labelled(super()._step_proc_data(next_tensordict_out))
        self._remember(next_td)
        return next_td

    def step(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Step all rows by the action in `tensordict`, as TorchRL's envs do."""
        # Envs of other libraries take the action itself.
        if not isinstance(tensordict, TensorDictBase):
            raise ValueError(
                f"env.step({type(tensordict).__name__}): TorchRL's envs take the TensorDict of the last step or reset, "
                'with the action in it: env.step(td.set("action", action)), or env.step_and_maybe_reset; for '
                "obs, reward, ... = env.step(action) wrap the env in one of ksim_rl.adapters"
            )
        return super().step(tensordict)

    def maybe_reset(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Reset the rows that are done, without asking the host whether there are any."""
        # A foreign simulator: TorchRL's own way, which reads the mask on the host.
        if not self._masks_resets:
            return super().maybe_reset(tensordict)
        # A copy: an env may clear its own done buffer in place while transforms still read the mask.
        mask_E1 = tensordict.get("done").clone()
        reset_td = TensorDict(
            {_RESET: mask_E1}, batch_size=tensordict.batch_size, device=tensordict.device
        )
        root = self._merge(tensordict, self._fresh(reset_td), mask_E1)
        self._remember(root)
        return root

    def reset(
        self,
        tensordict: TensorDictBase | None = None,
        *,
        seed: int | None = None,
        env_ids: Sequence[int] | Shaped[Tensor, "*rows"] | None = None,
        options: dict[str, Any] | None = None,
        **kwargs: Any,
    ) -> TensorDictBase:
        """Reset all rows, or the rows `env_ids`, or the rows of the mask `tensordict["_reset"]` (bool, [E] or [E, 1]).

        Untouched rows keep their state and come back with their last root values, or with the values of `tensordict`,
        which is updated in place. `seed` is set first, as `env.seed(seed)` does. `env_ids` are checked on the host:
        inside a hot loop pass a mask. No `options` exist; `kwargs` are TorchRL's own `set_state` and
        `select_reset_only`.
        """
        # TorchRL would pass unknown keywords on in silence.
        for keyword in kwargs:
            if keyword not in _RESET_KEYWORDS:
                hint = checks.near(keyword, _RESET_KEYWORDS)
                raise TypeError(f"reset() got an unexpected keyword {keyword!r}: {hint}")
        if options:
            raise ValueError(
                f"options={options!r}: this env has no reset options; use seed= or env_ids="
            )
        if seed is not None:
            self.seed(seed)
        # From here on there are masks only.
        if env_ids is not None:
            tensordict = self._with_mask_of(tensordict, env_ids)
        if tensordict is None:
            mask_E1 = None
        else:
            mask_E1 = self._checked_mask(tensordict)
        # Before any reset runs, as the last root is replaced at the end.
        if tensordict is not None and mask_E1 is not None:
            self._complete_with_last_root(tensordict)
        if not self._masks_resets:
            root = self._labelled(super().reset(tensordict, **kwargs))
        else:
            root = self._masked_reset(tensordict, mask_E1, **kwargs)
        self._remember(root)
        return root

    def rollout(self, *args: Any, **kwargs: Any) -> TensorDictBase:
        """TorchRL's rollout, with its dims labelled ("E", "T")."""
        # TorchRL labels the time dim only, if any; "T" is last.
        rollout_ET = super().rollout(*args, **kwargs)
        if rollout_ET.batch_dims == len(self.batch_size) + 1:
            names = self.dim_names
        else:
            names = [None]
        rollout_ET.names = [*names, dims.T]
        return rollout_ET

    @functools.cached_property
    def _masks_resets(self) -> bool:
        """Whether resets go through masks; decided from properties that never change, so it costs a dict look-up."""
        return upstream.can_reset_nothing(self)

    def _masked_reset(
        self,
        tensordict: TensorDictBase | None,
        mask_E1: Bool[Tensor, "*batch 1"] | None,
        *,
        set_state: bool | None = None,
        select_reset_only: bool = False,
    ) -> TensorDictBase:
        # The part of TorchRL's `reset` that settles the keywords.
        set_state = upstream.resolved_set_state(self, tensordict, set_state, select_reset_only)
        if set_state is None:
            forwarded = {}
        else:
            forwarded = {"set_state": set_state}
        reset_td = tensordict
        if tensordict is not None:
            # `_reset` of an env gets its mask and its state, and nothing of the policy's output.
            if select_reset_only:
                keys = [_RESET]
            else:
                keys = [_RESET, *self.state_spec.keys(True, True)]
            reset_td = tensordict.select(*keys, strict=False)
            if mask_E1 is not None:
                reset_td.set(_RESET, mask_E1)
            # The mask is not part of the root that comes back.
            tensordict.pop(_RESET, None)
        fresh = self._fresh(reset_td, **forwarded)
        if tensordict is None:
            return self._labelled(fresh)
        # A reset of all rows: nothing old is kept.
        if mask_E1 is None:
            return self._labelled(tensordict.update(fresh.exclude(_RESET)))
        return self._merge(tensordict, fresh, mask_E1)

    def _fresh(self, reset_td: TensorDictBase | None, **kwargs: Any) -> TensorDictBase:
        fresh = self._reset(reset_td, **kwargs)  # pyright: ignore[reportArgumentType]
        upstream.complete_done(self, fresh)
        return fresh

    def _merge(
        self, root: TensorDictBase, fresh: TensorDictBase, mask_E1: Bool[Tensor, "*batch 1"]
    ) -> TensorDictBase:
        """Write the rows of `fresh` that the mask names into `root`, leaf by leaf, and return `root`."""
        batch_size = root.batch_size
        # Each shape of mask, and each `where` over a table, is made once for all leaves that need it.
        masks: dict[int, Tensor] = {}
        shared: dict[tuple[int, int], Tensor] = {}
        for key in fresh.keys(True, True):
            if key == _RESET:
                continue
            new = fresh.get(key)
            old = root.get(key, None)
            # A leaf that the root lacks is taken as it is.
            if old is not None and isinstance(old, Tensor):
                pair = _shared_rows(new, old)
                if pair is None:
                    new = torch.where(_mask_like(old, mask_E1, batch_size, masks), new, old)
                else:
                    at = id(pair[0]), id(pair[1])
                    if at not in shared:
                        mask = _mask_like(pair[1], mask_E1, batch_size, masks)
                        shared[at] = torch.where(mask, *pair)
                    # The merged table, seen through the same window as the leaf.
                    new = shared[at].as_strided(new.shape, new.stride(), new.storage_offset())
            root.set(key, new)
        return self._labelled(root)

    def _labelled(self, tree: Tree) -> Tree:
        if tree.ndim == len(self.batch_size) and tree.ndim:
            tree.names = self.dim_names
        return tree

    def _complete_with_last_root(self, tensordict: TensorDictBase) -> None:
        """Give a partial reset the root values that it was not given."""
        # The parts of a root: observations and flags of done.
        root_keys = [
            *self.full_observation_spec.keys(True, True),
            *self.full_done_spec.keys(True, True),
        ]
        missing = [key for key in root_keys if tensordict.get(key, None) is None]
        if missing and self.last_root is None:
            raise RuntimeError(
                "a partial reset needs the last root values of the other rows, and there are none yet: "
                "call reset() without env_ids and without '_reset' first"
            )
        for key in missing:
            value = self.last_root.get(key, None)  # pyright: ignore[reportOptionalMemberAccess]
            if value is not None:
                tensordict.set(key, value)

    def _checked_mask(self, tensordict: TensorDictBase) -> Tensor | None:
        """Return the mask in the shape of `done`, or None for a reset of all rows."""
        mask = tensordict.get(_RESET, None)
        if mask is None or self.reset_keys != [_RESET]:
            return None
        done_shape = self.full_done_spec["done"].shape
        if mask.dtype != torch.bool or mask.shape not in (self.batch_size, done_shape):
            raise ValueError(
                f"tensordict['_reset'] has shape {tuple(mask.shape)} and dtype {mask.dtype}: "
                f"expected {tuple(self.batch_size)} or {tuple(done_shape)} and torch.bool"
            )
        return mask.reshape(done_shape)

    def _with_mask_of(
        self, tensordict: TensorDictBase | None, env_ids: Sequence[int] | Shaped[Tensor, "*rows"]
    ) -> TensorDictBase:
        """Turn row numbers into the mask before any transform sees them."""
        if tensordict is not None and tensordict.get(_RESET, None) is not None:
            raise ValueError("env_ids= and tensordict['_reset'] were both given: pass one of them")
        mask_E = mask_from_env_ids(env_ids, self.batch_size, self.device)
        mask = mask_E.reshape(self.full_done_spec["done"].shape)
        if tensordict is None:
            return TensorDict({_RESET: mask}, batch_size=self.batch_size, device=self.device)
        return tensordict.set(_RESET, mask)


def mask_from_env_ids(
    env_ids: Sequence[int] | Shaped[Tensor, "*rows"],
    batch_size: torch.Size,
    device: torch.device | None,
) -> Bool[Tensor, " E"]:
    """Return the mask of the rows `env_ids`; a ValueError unless they are distinct integers in [0, E)."""
    if len(batch_size) != 1:
        raise ValueError(
            f"env_ids need one batch dim, and this env has batch_size {tuple(batch_size)}"
        )
    num_envs = batch_size[0]
    if isinstance(env_ids, Tensor) and (
        env_ids.dtype.is_floating_point or env_ids.dtype == torch.bool
    ):
        raise ValueError(
            f"env_ids has dtype {env_ids.dtype}: expected integers; a mask goes to tensordict['_reset']"
        )
    if isinstance(env_ids, Tensor):
        # Waits for the device, which the docstring of `reset` warns of.
        ids = env_ids.reshape(-1).tolist()
    else:
        ids = list(env_ids)
    # A list of booleans is a mask by mistake: as integers it would mean rows 0 and 1.
    if any(isinstance(row, bool) or not hasattr(row, "__index__") for row in ids):
        raise ValueError(f"env_ids={ids!r}: expected integers")
    ids = [row.__index__() for row in ids]
    outside = sorted({row for row in ids if not 0 <= row < num_envs})
    if outside:
        raise ValueError(f"env_ids holds {outside}: valid rows are 0 to {num_envs - 1}")
    if len(set(ids)) != len(ids):
        repeated = sorted({row for row in ids if ids.count(row) > 1})
        raise ValueError(f"env_ids names {repeated} more than once: give each row once")
    return torch.tensor([row in ids for row in range(num_envs)], device=device)


def _mask_like(
    leaf: Tensor,
    mask_E1: Bool[Tensor, "*batch 1"],
    batch_size: torch.Size,
    masks: dict[int, Tensor],
) -> Tensor:
    """Return the mask with as many dims as `leaf`; `masks` keeps them."""
    if leaf.ndim not in masks:
        masks[leaf.ndim] = mask_E1.view(*batch_size, *[1] * (leaf.ndim - len(batch_size)))
    return masks[leaf.ndim]


def _shared_rows(new: Tensor, old: Tensor) -> tuple[Tensor, Tensor] | None:
    """Return the tensors that two leaves are the same columns of, if there are such: one `where` serves all columns."""
    # Strides and storages of traced tensors are not to be relied on.
    if torch.compiler.is_compiling():
        return None
    new_base = base_of(new)
    old_base = base_of(old)
    if (
        new_base is None
        or old_base is None
        or new_base.ndim != 2
        or new_base.shape != old_base.shape
    ):
        return None
    # Both leaves must be the same columns of tables that are whole and of one shape.
    same_place = new.stride() == old.stride() and new.storage_offset() == old.storage_offset()
    whole = all(
        base.is_contiguous() and base.storage_offset() == 0 for base in (new_base, old_base)
    )
    columns = new.ndim == 2 and new.shape == old.shape and new.shape[0] == new_base.shape[0]
    if same_place and whole and columns and new.dtype == old.dtype:
        return (new_base, old_base)
    return None
