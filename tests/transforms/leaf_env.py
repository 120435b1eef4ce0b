"""An env with leaves of any shape and dtype, whose values tell how old they are."""

from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, TensorSpec, Unbounded
from torchrl.envs import EnvBase

AGENTS = 2


class LeafEnv(EnvBase):
    """Each row counts its steps, and ends after 3, 4, 3, 4 ... of them.

    The observation under `key`, and under "again", is count + 100 * (number of the element), bool: whether that is
    even. With `agents`, observation, action and reward lie in "agents", a TensorDict of batch size [*batch, 2]. The
    reward is the sum of the action that arrives.
    """

    def __init__(
        self,
        batch: Sequence[int] = (),
        leaf: Sequence[int] = (3,),
        dtype: torch.dtype = torch.float32,
        *,
        nested: bool = False,
        agents: bool = False,
        action_leaf: Sequence[int] = (2,),
        action_dtype: torch.dtype = torch.float32,
    ) -> None:
        super().__init__(batch_size=torch.Size(batch))
        self.leaf, self.dtype_of_leaf = torch.Size(leaf), dtype
        self.inner = torch.Size([AGENTS] if agents else [])
        self.key: NestedKey = ("agents", "x") if agents else ("obs", "deep", "x") if nested else "x"
        self.action_name: NestedKey = ("agents", "action") if agents else "action"
        self.reward_name: NestedKey = ("agents", "reward") if agents else "reward"
        self.num_rows = self.batch_size.numel()
        self.register_buffer("count_E", torch.zeros(self.num_rows, dtype=torch.int64))
        self.register_buffer("length_E", 3 + torch.arange(self.num_rows) % 2)
        shape = torch.Size([*batch, *self.inner, *leaf])
        if dtype.is_floating_point:
            observation: TensorSpec = Bounded(-1e4, 1e4, shape, dtype=dtype)
        else:
            observation = (
                Binary(shape=shape, dtype=dtype)
                if dtype == torch.bool
                else Unbounded(shape, dtype=dtype)
            )
        self.observation_spec = self._composite(self.key, observation)
        self.observation_spec["again"] = observation.clone()
        action = Bounded(-1, 1, torch.Size([*batch, *self.inner, *action_leaf]), dtype=action_dtype)
        self.full_action_spec = self._composite(self.action_name, action)
        reward = Unbounded(torch.Size([*batch, *self.inner, 1]))
        self.full_reward_spec = self._composite(self.reward_name, reward)
        done = Binary(1, dtype=torch.bool, shape=torch.Size([*batch, 1]))
        self.full_done_spec = Composite(done=done, terminated=done.clone(), shape=self.batch_size)

    def _composite(self, key: NestedKey, spec: TensorSpec) -> Composite:
        if isinstance(key, str):
            return Composite({key: spec}, shape=self.batch_size)
        inner = Composite({key[-1]: spec}, shape=torch.Size([*self.batch_size, *self.inner]))
        for name in reversed(key[1:-1]):
            inner = Composite({name: inner}, shape=self.batch_size)
        return Composite({key[0]: inner}, shape=self.batch_size)

    def value(self, count_E: Tensor) -> Tensor:
        """Return the observation after so many steps, [E, *agents, *leaf]."""
        shape = torch.Size([*self.inner, *self.leaf])
        number = 100 * torch.arange(shape.numel()).reshape(shape)
        value = count_E.reshape(-1, *[1] * len(shape)) + number
        return value % 2 == 0 if self.dtype_of_leaf == torch.bool else value.to(self.dtype_of_leaf)

    def _observed(self) -> TensorDict:
        shape = torch.Size([*self.batch_size, *self.inner, *self.leaf])
        td = TensorDict({}, batch_size=self.batch_size)
        value = self.value(self.count_E).reshape(shape)
        return self._put(td, self.key, value).set("again", value.clone())

    def _put(self, td: TensorDict, key: NestedKey, value: Tensor) -> TensorDict:
        if self.inner and "agents" not in td.keys():
            td["agents"] = TensorDict({}, batch_size=[*self.batch_size, *self.inner])
        return td.set(key, value)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.count_E.add_(1)
        self.received = tensordict.get(self.action_name).clone()
        expected = self.full_action_spec[self.action_name]
        if self.received.shape != expected.shape or self.received.dtype != expected.dtype:
            raise RuntimeError(
                f"the action arrives as {self.received.dtype} {tuple(self.received.shape)}"
            )
        ended = (self.count_E >= self.length_E).reshape(*self.batch_size, 1)
        td = self._observed().set("done", ended).set("terminated", ended.clone())
        width = len(self.batch_size) + len(self.inner)
        reward = (
            self.received.float().reshape(*self.received.shape[:width], -1).sum(-1, keepdim=True)
        )
        return self._put(td, self.reward_name, reward)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: object) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        self.count_E.masked_fill_(torch.tensor(True) if mask is None else mask.reshape(-1), 0)
        flag = torch.zeros(*self.batch_size, 1, dtype=torch.bool)
        return self._observed().set("done", flag).set("terminated", flag.clone())

    def _set_seed(self, seed: int | None) -> None:
        pass
