"""This module holds the bases of transforms that replace each value by a function of it alone, such as its clip."""

from abc import abstractmethod

from jaxtyping import Num, Shaped
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec
from torchrl.envs.transforms import Transform

from ksim_rl.transforms.row_transform import Keys, as_keys, checked_out_keys
from ksim_rl.transforms.specs import drop_leaf_spec, floating_spec, leaf_spec, set_leaf_spec


class _Outward(Transform):
    """Base for what the env emits: floating-point leaves, replaced on batches of samples as in an env."""

    def __init__(self, in_keys: Keys, out_keys: Keys | None) -> None:
        keys = as_keys(in_keys)
        super().__init__(keys, checked_out_keys(keys, out_keys))

    @abstractmethod
    def new_spec(self, index: int, spec: TensorSpec) -> TensorSpec:
        """Return the spec of what becomes of the leaf of the in key with this index."""

    @abstractmethod
    def new_value(self, index: int, value: Num[Tensor, "*leaf"]) -> Num[Tensor, "*leaf"]:
        """Return what becomes of a value of that leaf."""

    def _new_specs(self, specs: Composite) -> Composite:
        found = [floating_spec(specs, key, type(self).__name__) for key in self.in_keys]
        for index, (out_key, spec) in enumerate(zip(self.out_keys, found, strict=True)):
            set_leaf_spec(specs, out_key, self.new_spec(index, spec))
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


class ActionMap(Transform):
    """Base of those that replace the action on its way to the env; the tensordict keeps what the policy chose."""

    def __init__(self, in_keys_inv: Keys, out_keys_inv: Keys | None) -> None:
        keys = as_keys(in_keys_inv)
        super().__init__(in_keys_inv=keys, out_keys_inv=checked_out_keys(keys, out_keys_inv))

    @abstractmethod
    def new_spec(self, index: int, spec: TensorSpec) -> TensorSpec:
        """Return the spec of what the policy writes, from that of the action which the env reads."""

    @abstractmethod
    def new_value(self, index: int, value: Shaped[Tensor, "*leaf"]) -> Shaped[Tensor, "*leaf"]:
        """Return what the env reads, from what the policy wrote."""

    def transform_action_spec(self, action_spec: Composite) -> Composite:
        """Replace the specs, and move them to where the policy writes."""
        specs = [leaf_spec(action_spec, key, type(self).__name__) for key in self.in_keys_inv]
        for index, (key, out_key, spec) in enumerate(
            zip(self.in_keys_inv, self.out_keys_inv, specs, strict=True)
        ):
            replaced = self.new_spec(index, spec)
            if key != out_key:
                drop_leaf_spec(action_spec, key)
            set_leaf_spec(action_spec, out_key, replaced)
        return action_spec

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        for index, (key, out_key) in enumerate(zip(self.in_keys_inv, self.out_keys_inv, strict=True)):
            tensordict.set(key, self.new_value(index, tensordict.get(out_key)))
        return tensordict

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Leave a batch of samples as it is: they hold the actions that the policy chose."""
        return tensordict
