"""This module holds the bases of transforms that replace each value by a function of it alone, such as its clip."""

from abc import abstractmethod

from jaxtyping import Num
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec
from torchrl.envs.transforms import Transform

from ksim_rl.transforms.row_transform import Keys, as_keys, checked_out_keys
from ksim_rl.transforms.specs import replace_leaves


class _Map(Transform):
    @abstractmethod
    def new_spec(self, index: int, spec: TensorSpec) -> TensorSpec:
        """Return the spec of what becomes of the leaf of the in key with this index (for actions: was before)."""

    @abstractmethod
    def new_value(self, index: int, value: Num[Tensor, "*leaf"]) -> Num[Tensor, "*leaf"]:
        """Return what becomes of a value of that leaf."""


class _Outward(_Map):
    """Base for what the env emits: floating-point leaves, replaced on batches of samples as in an env."""

    def __init__(self, in_keys: Keys, out_keys: Keys | None) -> None:
        keys = as_keys(in_keys)
        super().__init__(keys, checked_out_keys(keys, out_keys))

    def _new_specs(self, specs: Composite) -> Composite:
        owner = type(self).__name__
        replace_leaves(specs, self.in_keys, self.out_keys, owner, self.new_spec, is_floating=True)
        return specs

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        for index, (key, out_key) in enumerate(zip(self.in_keys, self.out_keys, strict=True)):
            next_tensordict.set(out_key, self.new_value(index, next_tensordict.get(key)))
        return next_tensordict

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Do the same to a batch of samples."""
        return self._call(tensordict)


class ObservationMap(_Outward):
    """Base of those that replace observations, at resets too."""

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Replace the specs."""
        return self._new_specs(observation_spec)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._call(tensordict_reset)


class RewardMap(_Outward):
    """Base of those that replace rewards."""

    def transform_reward_spec(self, reward_spec: Composite) -> Composite:
        """Replace the specs."""
        return self._new_specs(reward_spec)


class ActionMap(_Map):
    """Base of those that replace the action on its way to the env; the tensordict keeps what the policy chose."""

    def __init__(self, in_keys_inv: Keys, out_keys_inv: Keys | None) -> None:
        keys = as_keys(in_keys_inv)
        super().__init__(in_keys_inv=keys, out_keys_inv=checked_out_keys(keys, out_keys_inv))

    def transform_action_spec(self, action_spec: Composite) -> Composite:
        """Replace the specs, and move them to where the policy writes."""
        owner = type(self).__name__
        replace_leaves(action_spec, self.in_keys_inv, self.out_keys_inv, owner, self.new_spec, moves=True)
        return action_spec

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        for index, (key, out_key) in enumerate(zip(self.in_keys_inv, self.out_keys_inv, strict=True)):
            tensordict.set(key, self.new_value(index, tensordict.get(out_key)))
        return tensordict

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Leave a batch of samples as it is: they hold the actions that the policy chose."""
        return tensordict
