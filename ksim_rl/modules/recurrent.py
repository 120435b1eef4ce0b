"""Gives any network a recurrent state: it turns observations into features of the episode so far."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeVar

import torch
from jaxtyping import Bool, Float
from tensordict import TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictModuleBase,
    TensorDictSequential,
)
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor, nn
from torch.nn import functional
from torchrl.data import Composite, Unbounded
from torchrl.envs import EnvBase, InitTracker
from torchrl.envs.transforms import TensorDictPrimer, Transform
from torchrl.modules import SafeProbabilisticTensorDictSequential, recurrent_mode

from ksim_rl.checked import NUMBERS_PER_WEIGHT, Checked, Count
from ksim_rl.modules.actor import make_actor
from ksim_rl.modules.actor_cfg import ActorCfg
from ksim_rl.modules.critic import CriticCfg, make_critic
from ksim_rl.modules.mlp import Device
from ksim_rl.modules.network import ObservationKey, make_normalizer, side_by_side
from ksim_rl.modules.recurrent_cells import GRU, LSTM


class RecurrentStatePrimer(TensorDictPrimer):
    """TorchRL's primer, free of host syncs: each episode begins with zeros, each step goes on from the stored one."""

    def __init__(self, primers: Composite) -> None:
        super().__init__(primers, expand_specs=True)
        self.state_keys: list[NestedKey] = list(primers.keys(True, True))

    def _reset_func(
        self, tensordict: TensorDictBase | None, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        if tensordict is None:
            mask = None
        else:
            mask = tensordict.get(self.reset_key, None)
        # Each episode begins with zeros; rows that go on keep the state that the last step wrote.
        for key in self.state_keys:
            zero = self.primers[key].zero()  # pyright: ignore[reportOptionalSubscript]
            if tensordict is None:
                before = None
            else:
                before = tensordict.get(key, None)
            # A where keeps the states of the rows that go on; a mask of rows would be read on the host.
            if mask is not None and before is not None:
                zero = torch.where(mask.reshape(*zero.shape[:-2], 1, 1), zero, before)
            tensordict_reset.set(key, zero)
        return tensordict_reset


def recurrent_transforms(env: EnvBase, *primers: TensorDictPrimer) -> list[Transform]:
    """Return the transforms that carry recurrent states in an env: `is_init` where it has none yet, and the primers."""
    if "is_init" in env.observation_spec.keys():
        tracker = []
    else:
        tracker = [InitTracker()]
    return [*tracker, *primers]


# The parts of the state of each kind, and how many gates it has.
STATES = {"lstm": ("h", "c"), "gru": ("h",)}
_NUM_GATES = {"lstm": 4, "gru": 3}
STATE_KEY = "recurrent_state"
FEATURE_KEY = "recurrent_features"
RESET_KEY = "is_init"

AnyModule = TypeVar("AnyModule", bound=TensorDictModuleBase)
AnyCfg = TypeVar("AnyCfg", ActorCfg, CriticCfg)


@dataclass(frozen=True, kw_only=True)
class RecurrentCfg(Checked):
    """The recurrent layers before a network: N layers, whose state and features have H = `hidden_dim` numbers each."""

    kind: Literal["lstm", "gru"] = "lstm"
    hidden_dim: Count = 256
    num_layers: Count = 1

    def least_numbers(self, num_envs: int) -> Mapping[tuple[str, ...], float]:
        """Return what the layers need, with a state per env."""
        weights = _NUM_GATES[self.kind] * self.hidden_dim**2
        per_layer = NUMBERS_PER_WEIGHT * weights + num_envs * self.hidden_dim
        return {("hidden_dim", "num_layers"): self.num_layers * per_layer}


class RecurrentNetwork(nn.Module):
    """LSTM or GRU layers, time first; its parameters bear the names and shapes of `torch.nn.LSTM` and `torch.nn.GRU`.

    Weights are orthogonal gate by gate, biases zero but for the LSTM's forget gate, whose bias is one (Jozefowicz et
    al., "An empirical exploration of recurrent network architectures", 2015).
    """

    def __init__(
        self,
        cfg: RecurrentCfg,
        *,
        obs_dim: int,
        encoded_dim: int = 0,
        obs_normalization: bool = False,
        device: Device = None,
    ) -> None:
        super().__init__()
        self.cfg = cfg
        self.normalizer = make_normalizer(obs_normalization, obs_dim, encoded_dim, device)
        # Named as torch names them, so that weights of `torch.nn.LSTM` and `torch.nn.GRU` can be loaded.
        for layer in range(cfg.num_layers):
            input_dim = cfg.hidden_dim if layer else obs_dim
            for name, value in _layer_parameters(cfg, input_dim).items():
                self.register_parameter(f"{name}_l{layer}", nn.Parameter(value.to(device)))

    def forward(
        self,
        obs_TBL: Float[Tensor, "T B L"],
        state_BNH: tuple[Float[Tensor, "B N H"], ...],
        reset_TB1: Bool[Tensor, "T B 1"] | None = None,
    ) -> tuple[Float[Tensor, "T B H"], tuple[Float[Tensor, "T B N H"], ...]]:
        """Return the features, and the states after each step; `state_BNH`, h (and c), is that before the first.

        Where `reset_TB1` marks the begin of an episode, the step starts from zeros.
        """
        if self.normalizer is None:
            features_TBH = obs_TBL
        else:
            features_TBH = self.normalizer(obs_TBL)
        # Layer by layer over all steps, since each layer reads the features of the one below.
        states_N: list[tuple[Tensor, ...]] = []
        for layer in range(self.cfg.num_layers):
            state_BH = tuple(part_BNH[:, layer] for part_BNH in state_BNH)
            states_N.append(self._layer(layer, features_TBH, state_BH, reset_TB1))
            features_TBH = states_N[-1][0]
        if len(states_N) == 1:
            return features_TBH, tuple(part_TB.unsqueeze(-2) for part_TB in states_N[0])
        return features_TBH, tuple(
            torch.stack(parts_N, -2) for parts_N in zip(*states_N, strict=True)
        )

    def _layer(
        self,
        layer: int,
        features_TBH: Tensor,
        state_BH: tuple[Tensor, ...],
        reset_TB1: Tensor | None,
    ) -> tuple[Tensor, ...]:
        weight_ih, weight_hh, bias_ih, bias_hh = (
            self.get_parameter(f"{name}_l{layer}")
            for name in ("weight_ih", "weight_hh", "bias_ih", "bias_hh")
        )
        # The input projection of all steps is one product; only the recurrent part runs step by step.
        lstm = self.cfg.kind == "lstm"
        gates_TBG = functional.linear(
            features_TBH, weight_ih, bias_ih + bias_hh if lstm else bias_ih
        )
        # Under autocast only the projection is rounded: errors of a state add up over the steps.
        with torch.autocast(gates_TBG.device.type, enabled=False):
            gates_TBG = gates_TBG.to(weight_hh.dtype)
            if lstm:
                return LSTM.apply(gates_TBG, weight_hh, *state_BH, reset_TB1)
            return (GRU.apply(gates_TBG, weight_hh, bias_hh, *state_BH, reset_TB1),)


class RecurrentModule(TensorDictModule):
    """A `RecurrentNetwork` on TensorDicts, by TorchRL's conventions; a drop-in for its `LSTMModule` and `GRUModule`.

    Reads observations side by side [*batch, L], `is_init`, and the state under ("recurrent_state", name, "h") and, for
    an LSTM, "c", each [*batch, N, H]; writes the features [*batch, H] and, under "next", the state after the step. The
    name tells the states of several modules in one TensorDict apart.

    By default every element of the batch is one step. Under TorchRL's `set_recurrent_mode(True)`, where its and our
    losses run, the batch is [B, T]: sequences, and only the first step's state is read. At each step whose
    `is_init` is True the state is zero, whatever it was before.

    An env carries the state from step to step, and begins each episode with zeros, if it has the transforms of
    `recurrent_transforms`; or TorchRL's `InitTracker` and `make_tensordict_primer()`.
    """

    module: RecurrentNetwork

    def __init__(
        self,
        cfg: RecurrentCfg,
        *,
        obs_dim: int,
        in_keys: Sequence[ObservationKey],
        name: str,
        encoded_dim: int = 0,
        obs_normalization: bool = False,
        device: Device = None,
    ) -> None:
        network = RecurrentNetwork(
            cfg,
            obs_dim=obs_dim,
            encoded_dim=encoded_dim,
            obs_normalization=obs_normalization,
            device=device,
        )
        self.obs_keys = list(in_keys)
        self.state_keys = state_keys(cfg, name)
        self.feature_key = (FEATURE_KEY, name)
        super().__init__(
            network,
            in_keys=[*self.obs_keys, RESET_KEY, *self.state_keys],
            out_keys=[self.feature_key, *(("next", *key) for key in self.state_keys)],
        )
        self.cfg = cfg
        self.name = name

    def forward(self, tensordict: TensorDictBase, *args: Any, **kwargs: Any) -> TensorDictBase:
        """Write features and next state into `tensordict`, and return it.

        Raises ValueError where there is no state, or where a batch of sequences is not [B, T] with `is_init`.
        """
        obs = side_by_side([tensordict.get(key) for key in self.obs_keys])
        reset = tensordict.get(RESET_KEY, None)
        state = [tensordict.get(key, None) for key in self.state_keys]
        if any(part is None for part in state):
            raise ValueError(
                f"the data has no {self.state_keys}: give the env `recurrent_transforms`, which begin episodes with a "
                "state of zeros, before the first reset"
            )
        # Sequences where a loss learns, single steps where an env is acted in.
        if recurrent_mode():
            run = self._sequences
        else:
            run = self._steps
        outputs = run(obs, reset, state, tensordict.batch_size)
        for key, value in zip(self.out_keys, outputs, strict=True):
            tensordict.set(key, value)
        return tensordict

    def _steps(
        self, obs: Tensor, reset: Tensor | None, state: list[Tensor], batch_size: torch.Size
    ) -> tuple[Tensor, ...]:
        # One row per step: a sequence of length 1.
        # [1, B, L] with all batch dims flattened into B.
        obs_1B = obs.reshape(1, -1, obs.shape[-1])
        if reset is None:
            reset_1B1 = None
        else:
            reset_1B1 = reset.reshape(1, -1, 1)
        features_1B, states_1B = self.module(
            obs_1B, tuple(part.reshape(-1, *part.shape[-2:]) for part in state), reset_1B1
        )
        return tuple(
            part.reshape(*batch_size, *part.shape[2:]) for part in (features_1B, *states_1B)
        )

    def _sequences(
        self, obs: Tensor, reset: Tensor | None, state: list[Tensor], batch_size: torch.Size
    ) -> tuple[Tensor, ...]:
        if len(batch_size) != 2 or reset is None:
            raise ValueError(
                f"the batch has the dims {tuple(batch_size)} and {'no ' if reset is None else ''}{RESET_KEY!r}: in "
                f"recurrent mode {self.name!r} reads sequences [B, T] with {RESET_KEY!r}, which TorchRL's InitTracker "
                "writes"
            )
        # The network is time first; of the stored states only the first step's is read.
        features_TBH, states_TB = self.module(
            obs.transpose(0, 1), tuple(part[:, 0] for part in state), reset.transpose(0, 1)
        )
        return tuple(part.transpose(0, 1) for part in (features_TBH, *states_TB))

    def make_tensordict_primer(self) -> RecurrentStatePrimer:
        """Return the transform with which an env carries the state; TorchRL's `get_primers_from_module` asks for it."""
        return RecurrentStatePrimer(state_spec(self.cfg, self.name))


def make_recurrent_actor(
    cfg: RecurrentCfg, actor: ActorCfg, *, obs_dim: int, encoded_dim: int = 0, **options: Any
) -> ProbabilisticTensorDictSequential:
    """Build a policy behind a recurrent module, which normalizes the policy's observations; see `make_actor`."""
    recurrent = _recurrent_of(cfg, actor, "actor", obs_dim, encoded_dim, options.get("device"))
    return behind(
        recurrent, make_actor(_reading(actor, recurrent), obs_dim=cfg.hidden_dim, **options)
    )


def make_recurrent_critic(
    cfg: RecurrentCfg, critic: CriticCfg, *, obs_dim: int, encoded_dim: int = 0, **options: Any
) -> TensorDictModule:
    """Build a critic behind its own recurrent module; as `make_recurrent_actor`."""
    recurrent = _recurrent_of(cfg, critic, "critic", obs_dim, encoded_dim, options.get("device"))
    network = make_critic(_reading(critic, recurrent), obs_dim=cfg.hidden_dim, **options)
    return behind(recurrent, network)


def behind(first: TensorDictModuleBase, network: AnyModule) -> AnyModule:
    """Return an actor, a critic or a trunk that reads what the first module writes, such as a `feature_key`."""
    if isinstance(network, ProbabilisticTensorDictSequential):
        return SafeProbabilisticTensorDictSequential(first, *network.module)  # type: ignore[return-value, arg-type]
    return TensorDictSequential(first, network)  # type: ignore[return-value]


def recurrent_modules(*networks: nn.Module) -> list[Any]:
    """Return the recurrent TensorDict modules inside networks, each once: ours, TorchRL's, or any other."""
    # Any module that reads a key and writes it under "next" carries a state.
    found = [module for network in networks for module in network.modules() if carried_keys(module)]
    # A sequence of modules carries the states of those that it holds.
    holders = {
        module
        for module in found
        if any(carried_keys(m) for m in module.modules() if m is not module)
    }
    return [module for module in dict.fromkeys(found) if module not in holders]


def carried_keys(module: nn.Module) -> list[NestedKey]:
    """Return the keys of a module's state: those that it reads, and under "next" writes for the step that follows."""
    if not isinstance(module, TensorDictModuleBase):
        return []
    written = {unravel_key(key) for key in module.out_keys}
    return [unravel_key(key) for key in module.in_keys if unravel_key(("next", key)) in written]


def state_keys(cfg: RecurrentCfg, name: str) -> list[tuple[str, str, str]]:
    """Return where the state lies in a TensorDict."""
    return [(STATE_KEY, name, part) for part in STATES[cfg.kind]]


def state_spec(cfg: RecurrentCfg, name: str) -> Composite:
    """Return the spec of the state of one env."""
    shape = torch.Size((cfg.num_layers, cfg.hidden_dim))
    parts = {part: Unbounded(shape) for part in STATES[cfg.kind]}
    return Composite({STATE_KEY: Composite({name: Composite(parts)})})


def _recurrent_of(
    cfg: RecurrentCfg,
    network: AnyCfg,
    name: str,
    obs_dim: int,
    encoded_dim: int,
    device: Device,
) -> RecurrentModule:
    """Return the recurrent module that stands before a network, and takes over its observations and normalizer."""
    return RecurrentModule(
        cfg,
        obs_dim=obs_dim,
        in_keys=network.in_keys,
        name=name,
        encoded_dim=encoded_dim,
        obs_normalization=network.obs_normalization,
        device=device,
    )


def _reading(network: AnyCfg, recurrent: RecurrentModule) -> AnyCfg:
    """Return the config of a network that reads the features of a recurrent module."""
    return replace(network, in_keys=(recurrent.feature_key,), obs_normalization=False)


def _layer_parameters(cfg: RecurrentCfg, input_dim: int) -> dict[str, Tensor]:
    """Draw the parameters of one layer, on the CPU, so that one seed gives the same network on every device."""
    gates = _NUM_GATES[cfg.kind]
    hidden = cfg.hidden_dim
    bias_hh = torch.zeros(gates, hidden)
    if cfg.kind == "lstm":
        # The forget gate is the second of torch's four: input, forget, cell, output.
        bias_hh[1] = 1.0
    return {
        "weight_ih": torch.cat(
            [nn.init.orthogonal_(torch.empty(hidden, input_dim)) for _ in range(gates)]
        ),
        "weight_hh": torch.cat(
            [nn.init.orthogonal_(torch.empty(hidden, hidden)) for _ in range(gates)]
        ),
        "bias_ih": torch.zeros(gates * hidden),
        "bias_hh": bias_hh.flatten(),
    }
