"""The base of transforms that remember the last values of signals, and histories of observations."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.data import Bounded, Composite, TensorSpec, Unbounded
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.transforms import Compose, Transform

from ksim_rl.checked import Checked, Count
from ksim_rl.transforms import ring, stock
from ksim_rl.transforms.checked_keys import Keys
from ksim_rl.transforms.columns import side_by_side
from ksim_rl.transforms.row_transform import RowTransform
from ksim_rl.transforms.specs import bounded, bounds, check_no_picture


class RingTransform(RowTransform):
    """Base of transforms that pass signals through rings of slots (see `ring`), observations unless overridden."""

    num_slots = 1
    """Values that a ring holds per env."""
    num_frames = 1
    """Values that come out of it at each step."""
    stride = 0
    """Env steps from one of these to the next."""
    _is_joined = False
    _num_rings = 0

    age_E: Tensor

    def _register_rings(self) -> None:
        self._register_rows("age_E", *self._per_key("ring"))
        # The bytes of all frames of an observation, where several are in one ring.
        self.register_buffer("part_bytes", None, persistent=False)

    def _begin(self, tensordict_reset: TensorDictBase, mask_E: Tensor) -> TensorDictBase:
        return self._pass(tensordict_reset, mask_E)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        self._sized()
        self._advance()
        return self._pass(next_tensordict, None)

    def _advance(self) -> None:
        """Prepare for the env step to come."""

    def _size_rings(
        self, specs: Composite, leaves: Sequence[TensorSpec], *, joins: bool = True
    ) -> None:
        """Make one ring [E, M, ...] per signal, or with `joins` one for all signals where they are of one dtype."""
        self._size_rows(specs)
        self._size_buffer("age_E", torch.int64)
        shapes = [leaf.shape[specs.ndim :] for leaf in leaves]
        dtypes = [leaf.dtype for leaf in leaves]
        # One ring is one launch, whatever the number of signals.
        self._is_joined = joins and len(shapes) > 1 and len(set(dtypes)) == 1
        if self._is_joined:
            sizes = [shape.numel() for shape in shapes]
            # With one frame the order in memory is the order of the signals, and no parts are needed.
            if self.num_frames > 1:
                part_bytes = torch.tensor(
                    [size * dtypes[0].itemsize for size in sizes], dtype=torch.int32
                )
                self._buffers["part_bytes"] = part_bytes.to(self._row_device)
            shapes = [torch.Size([sum(sizes)])]
            dtypes = dtypes[:1]
        self._num_rings = len(shapes)
        for index, (shape, dtype) in enumerate(zip(shapes, dtypes, strict=True)):
            self._size_buffer(f"ring_{index}", dtype, (self.num_slots, *shape))

    def _pass(self, tensordict: TensorDictBase, mask_E: Tensor | None) -> TensorDictBase:
        """Send the values through the rings, and write the results; a mask says which rows begin with them."""
        values = [tensordict.get(key) for key in self.in_keys]
        if self._is_joined:
            joined_EL = self._through(0, side_by_side(values, self.num_rows), mask_E)
            # Each signal's frames lie together, so that splitting makes views.
            sizes = [self.num_frames * value.numel() // self.num_rows for value in values]
            found = joined_EL.split(sizes, dim=1)
        else:
            found = [self._through(index, value, mask_E) for index, value in enumerate(values)]
        for index, out_key in enumerate(self.out_keys):
            tensordict.set(
                out_key, self._shaped(index, found[index], values[index], tensordict.batch_size)
            )
        return tensordict

    def _through(self, index: int, value: Tensor, mask_E: Tensor | None) -> Tensor:
        """Write this step's value [E, ...] and return the frames due, [E, N * L]; masked rows begin with it."""
        buffers: dict[str, Any] = self._buffers
        ring_EM = buffers[f"ring_{index}"]
        age_E = buffers["age_E"]
        # Envs with nested batch dims are flattened to one row per env.
        if value.ndim == ring_EM.ndim - 1:
            value_E = value
        else:
            value_E = value.reshape(-1, *ring_EM.shape[2:])
        begins = mask_E is not None
        if begins:
            draws = self._draws(index)
        else:
            draws = ring.NO_DRAWS
        # All rings share one age, which only the last launch of a step counts on.
        layout = (
            self.num_frames,
            self.stride,
            buffers["part_bytes"],
            begins or index == self._num_rings - 1,
        )
        return ring.turn(ring_EM, age_E, value_E, buffers.get("lag_E"), mask_E, *layout, *draws)

    def _draws(self, index: int) -> tuple[Any, ...]:
        """Return the last arguments of `ring.turn` for rows that begin, which draw their lags in this ring or not."""
        return ring.NO_DRAWS

    def _shaped(
        self, index: int, found_EL: Tensor, value: Tensor, batch_size: torch.Size
    ) -> Tensor:
        """Return the frames in the shape that the env emits."""
        if found_EL.shape == value.shape:
            return found_EL
        return found_EL.reshape(value.shape)


@dataclass(frozen=True, kw_only=True)
class HistoryCfg(Checked):
    """The last `length` frames, oldest first."""

    length: Count
    stride: Count = 1
    """Env steps from one frame to the next."""
    flat: bool = True
    """True puts frame after frame into one vector [E, N * L]; False stacks them to [E, N, ...]."""

    @property
    def num_slots(self) -> int:
        """Frames that are kept: from the newest back to the oldest, with those between."""
        return (self.length - 1) * self.stride + 1

    def least_numbers(self, num_envs: int) -> Mapping[tuple[str, ...], float]:
        """Return the numbers of the frames that are kept."""
        return {("length", "stride"): num_envs * self.num_slots}


class ObservationHistory(RingTransform):
    """The last frames of observations (see `HistoryCfg`); frames from before a reset are the reset observation.

    Example:
        >>> history = ObservationHistory(["joint_pos"], ["joint_pos_history"], length=10)
    """

    def __init__(
        self,
        in_keys: Keys,
        out_keys: Keys | None = None,
        *,
        length: int,
        stride: int = 1,
        flat: bool = True,
    ) -> None:
        cfg = HistoryCfg(length=length, stride=stride, flat=flat)
        super().__init__(in_keys, out_keys)
        self._register_rings()
        self.num_frames = self.length = length
        self.stride = stride
        self.flat = flat
        self.num_slots = cfg.num_slots

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        leaves = self._replace_leaves(observation_spec, self._repeated)
        self._size_rings(observation_spec, leaves)
        return observation_spec

    def _repeated(self, index: int, spec: TensorSpec) -> TensorSpec:
        batch_dims = self.batch_dims[index]
        batch = spec.shape[:batch_dims]
        leaf = spec.shape[batch_dims:]
        # A frame dim behind the batch dims of the observation.
        stacked = spec.unsqueeze(batch_dims).expand(*batch, self.num_frames, *leaf)
        if not self.flat:
            return stacked.clone()
        check_no_picture(self.in_keys[index], spec, batch_dims, "stack its frames by flat=False")
        shape = torch.Size([*batch, self.num_frames * leaf.numel()])
        if not isinstance(spec, Bounded) or not spec.dtype.is_floating_point:
            return Unbounded(shape, dtype=spec.dtype, device=spec.device)
        low, high = (end.reshape(shape) for end in bounds(stacked))
        return bounded(low, high, dtype=spec.dtype, device=spec.device)

    def _shaped(
        self, index: int, found_EL: Tensor, value: Tensor, batch_size: torch.Size
    ) -> Tensor:
        outer = len(batch_size)
        inner = self.batch_dims[index]
        if self.flat and outer == inner == 1:
            return found_EL
        # Frames as a dim behind the batch, then moved behind the dims of a nested batch.
        stacked = found_EL.reshape(*batch_size, self.num_frames, *value.shape[outer:])
        if inner > outer:  # each frame of the env has one of each agent, say
            stacked = stacked.movedim(outer, inner)
        if self.flat:
            return stacked.flatten(inner)
        return stacked


def stacked_frames(env: EnvBase) -> dict[NestedKey, tuple[int, ...]]:
    """Return the ages of the frames that each observation [E, N, ...] stacks, each the newest of an earlier step.

    An age is how many env steps ago that was, such as (8, 4, 0). Those observations are the results of an
    `ObservationHistory` with `flat=False` that nothing changes after it. A transform of a user's own behind it may
    change anything, and one that steps the env itself leaves frames out, so nothing is said then.
    """
    assert env.output_spec is not None  # making the specs is what counts the dims
    found: dict[NestedKey, tuple[int, ...]] = {}
    for transform in _from_inside(env):
        if not _is_known(transform):
            found.clear()
        for key in transform.out_keys or ():
            found.pop(unravel_key(key), None)
        if not isinstance(transform, ObservationHistory) or transform.flat:
            continue
        oldest = (transform.length - 1) * transform.stride
        ages = tuple(range(oldest, -1, -transform.stride))
        for key, batch_dims in zip(transform.out_keys, transform.batch_dims, strict=True):
            # The frames of several agents stand behind the dim of agents.
            if batch_dims == 1:
                found[unravel_key(key)] = ages
    return found


def _is_known(transform: Transform) -> bool:
    """Return whether a transform writes its out keys alone, and makes one step of the env inside of it at a time."""
    kind = type(transform)
    package = kind.__module__.partition(".")[0]
    if package == stock.PACKAGE:
        return kind is Compose or kind.__name__ in stock.DATA
    return package == "ksim_rl"


def _from_inside(env: EnvBase) -> list[Transform]:
    """Return the transforms of an env in the order in which they are applied."""
    transforms: list[Transform] = []
    inner: Any = env
    while isinstance(inner, TransformedEnv):
        own = [module for module in inner.transform.modules() if isinstance(module, Transform)]
        transforms = [*own, *transforms]
        inner = inner.base_env
    return transforms
