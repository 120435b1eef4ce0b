"""Describes left-right mirror images, and shows episodes and samples in them."""

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float32, Int64, Shaped
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec

from ksim_rl import checks
from ksim_rl.device import random
from ksim_rl.transforms.checked_keys import Keys
from ksim_rl.transforms.row_transform import KeyedTransform
from ksim_rl.transforms.specs import Device, bounded, bounds, path_of

Bounds = tuple[Tensor, Tensor]


@dataclass(frozen=True, kw_only=True)
class MirrorMap:
    """The mirror image of a vector: `mirrored[i] = signs[i] * vector[source[i]]`; signs that are not given are 1.

    Maps whose image of the image is not the vector itself are refused.
    """

    source: tuple[int, ...]
    signs: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "source", tuple(self.source))
        object.__setattr__(
            self, "signs", tuple(float(s) for s in self.signs) or (1.0,) * len(self.source)
        )
        # A permutation: each column comes from exactly one other.
        if sorted(self.source) != list(range(len(self.source))):
            raise ValueError(
                f"source={self.source}: expected each of 0 to {len(self.source) - 1} once"
            )
        if len(self.signs) != len(self.source):
            raise ValueError(
                f"signs has {len(self.signs)} numbers for the {len(self.source)} of source"
            )
        for index, (source, sign) in enumerate(zip(self.source, self.signs, strict=True)):
            checks.check_choice(f"signs[{index}]", sign, (1.0, -1.0))
            # Twice in the mirror is the vector itself.
            if self.source[source] != index or self.signs[source] != sign:
                raise ValueError(
                    f"columns {index} and {source} are no mirror images of each other: "
                    f"source {source} and {self.source[source]}, signs {sign} and {self.signs[source]}"
                )

    @property
    def size(self) -> int:
        """Number of columns."""
        return len(self.source)

    def __call__(self, vector: Shaped[Tensor, "*batch L"]) -> Shaped[Tensor, "*batch L"]:
        """Return the mirror image of vectors [..., L]."""
        return image(vector, *self.tensors(vector.device))

    def tensors(self, device: Device) -> tuple[Int64[Tensor, " L"] | None, Float32[Tensor, " L"]]:
        """Return source (int64; None if no column moves) and signs (float32), [L]."""
        return _tensors(self, device)


def image(
    vector: Shaped[Tensor, "*batch L"],
    source_L: Int64[Tensor, " L"] | None,
    signs_L: Float32[Tensor, " L"],
) -> Shaped[Tensor, "*batch L"]:
    """Return the mirror image of vectors [..., L]; a `source_L` of None leaves the columns in place."""
    if source_L is None:
        columns = vector
    else:
        columns = vector.index_select(-1, source_L)
    return columns * signs_L.to(vector.dtype)


@functools.lru_cache(maxsize=256)
def _tensors(mirror: MirrorMap, device: Device) -> tuple[Tensor | None, Tensor]:
    # Without a move the image is one product: a gather would copy the vector first.
    moves = mirror.source != tuple(range(mirror.size))
    if moves:
        source_L = torch.tensor(mirror.source, device=device)
    else:
        source_L = None
    return source_L, torch.tensor(mirror.signs, device=device)


def concatenate(maps: Sequence[MirrorMap]) -> MirrorMap:
    """Return the map of the vectors of `maps` one after another."""
    source: list[int] = []
    signs: list[float] = []
    for mirror in maps:
        # Columns of a map count from the start of its own part.
        start = len(source)
        source += [start + column for column in mirror.source]
        signs += mirror.signs
    return MirrorMap(source=tuple(source), signs=tuple(signs))


POLAR = MirrorMap(source=(0, 1, 2), signs=(1, -1, 1))
"""Position, linear velocity, acceleration, force, projected gravity (x forward, y left, z up)."""
AXIAL = MirrorMap(source=(0, 1, 2), signs=(-1, 1, -1))
"""Angular velocity, torque (x forward, y left, z up)."""
PLANAR_VELOCITY = MirrorMap(source=(0, 1, 2), signs=(1, -1, -1))
"""The velocity command (vx, vy, wz)."""
QUATERNION = MirrorMap(source=(0, 1, 2, 3), signs=(1, -1, 1, -1))
"""Orientation (w, x, y, z)."""


class Mirror(KeyedTransform):
    """Episodes in a left-right mirror: the policy sees mirrored observations, and the env gets its mirrored actions.

    For a robot that is its own mirror image these are episodes of the same task, so a policy that learns from them
    becomes symmetric. Whether an episode is mirrored is drawn per env at its reset. On a batch of samples, where it
    mirrors everything, use `mirrored`. `maps` are by key of in_keys and in_keys_inv (see `mirror_joints`,
    `mirror_by_name`, `mirror_group`); in_keys_inv of [] mirrors no actions.

    Example:
        >>> mirror = Mirror(["imu"], maps={"imu": AXIAL, "action": MirrorMap(source=(1, 0))}, probability=0.5)
    """

    purposes = ("reset/mirrored",)

    mirrored_E: Tensor

    def __init__(
        self,
        in_keys: Keys,
        out_keys: Keys | None = None,
        in_keys_inv: Keys = "action",
        out_keys_inv: Keys | None = None,
        *,
        maps: Mapping[NestedKey, MirrorMap],
        probability: float = 0.5,
        seed: int | None = None,
        stream: str | None = None,
    ) -> None:
        super().__init__(in_keys, out_keys, in_keys_inv, out_keys_inv, seed=seed, stream=stream)
        keys = self.in_keys
        keys_inv = self.in_keys_inv
        if set(maps) != {*keys, *keys_inv}:
            raise ValueError(f"maps has the keys {list(maps)}: expected {keys} and {keys_inv}")
        checks.check_in_range("probability", probability, low=0.0, high=1.0)
        self._register_rows("mirrored_E")
        self.maps = dict(maps)
        self.probability = probability
        # Buffers rather than the maps' own tensors: compiled code would make the latter again in each step.
        for index, key in enumerate([*keys, *keys_inv]):
            for name, tensor in zip(("source", "signs"), self.maps[key].tensors(None), strict=True):
                held = None if tensor is None else tensor.clone()
                self.register_buffer(f"{name}_{index}", held, persistent=False)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        self._replace_leaves(observation_spec, self._widened)
        self._size_rows(observation_spec)
        # One flag per env, which observations and actions share: an episode is mirrored as a whole.
        self._size_buffer("mirrored_E", torch.bool)
        return observation_spec

    def _widened(self, index: int, spec: TensorSpec) -> TensorSpec:
        plain = bounds(spec)
        other = self._image(self.in_keys[index], bounds(spec), self.batch_dims[index])
        # The policy sees either, so that the bounds have to hold both.
        low = torch.minimum(plain[0], other[0])
        high = torch.maximum(plain[1], other[1])
        return bounded(low, high, dtype=spec.dtype, device=spec.device)

    def transform_action_spec(self, action_spec: Composite) -> Composite:
        self._replace_leaves(action_spec, self._narrowed, is_inverse=True)
        return action_spec

    def _narrowed(self, index: int, spec: TensorSpec) -> TensorSpec:
        key = self.in_keys_inv[index]
        plain = bounds(spec)
        other = self._image(key, bounds(spec), self.batch_dims_inv[index])
        # An action has to be allowed as it is and in the mirror.
        low = torch.maximum(plain[0], other[0])
        high = torch.minimum(plain[1], other[1])
        if bool((low > high).any()):
            raise ValueError(
                f"Mirror: the bounds of the action {key!r} and of its mirror image have nothing in common"
            )
        return bounded(low, high, dtype=spec.dtype, device=spec.device)

    def _image(self, key: NestedKey, ends: Bounds, batch_dims: int) -> Bounds:
        leaf = ends[0].shape[batch_dims:]
        if leaf[-1:] != (self.maps[key].size,):
            raise ValueError(
                f"the map of {key!r} has {self.maps[key].size} columns for shape {tuple(leaf)}"
            )
        images = [self.maps[key](end) for end in ends]
        # A sign of -1 turns low and high around.
        return torch.minimum(*images), torch.maximum(*images)

    def _begin(self, tensordict_reset: TensorDictBase, mask_E: Tensor) -> TensorDictBase:
        # Drawn for all rows, taken where an episode begins: no size depends on the mask.
        drawn_E = random.uniform(self._reset_keys("reset/mirrored"), 1)[:, 0] < self.probability
        self.mirrored_E.copy_(torch.where(mask_E, drawn_E, self.mirrored_E))
        return self._call(tensordict_reset)

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        self._sized()
        for index, (key, out_key) in enumerate(zip(self.in_keys, self.out_keys, strict=True)):
            seen = self._seen(index, next_tensordict.get(key), next_tensordict.batch_size)
            next_tensordict.set(out_key, seen)
        return next_tensordict

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        self._sized()
        pairs = zip(self.in_keys_inv, self.out_keys_inv, strict=True)
        # Buffers of actions are numbered after the observations.
        for index, (key, out_key) in enumerate(pairs, start=len(self.in_keys)):
            tensordict.set(key, self._seen(index, tensordict.get(out_key), tensordict.batch_size))
        return tensordict

    def _seen(self, index: int, value: Tensor, batch_size: torch.Size) -> Tensor:
        # One flag per env, broadcast over the dims of the leaf.
        mirrored_E = self.mirrored_E.reshape(*batch_size, *[1] * (value.ndim - len(batch_size)))
        source_L = getattr(self, f"source_{index}")
        signs_L = getattr(self, f"signs_{index}")
        return torch.where(mirrored_E, image(value, source_L, signs_L), value)


def mirrored(tensordict: TensorDictBase, maps: Mapping[NestedKey, MirrorMap]) -> TensorDictBase:
    """Return the mirror image of a batch of samples, of any batch size, for data augmentation.

    The keys of `maps` are mirrored, also under "next"; all other leaves stay, which is right for rewards and flags.

    Example:
        >>> augmented_B = torch.cat((batch_B, mirrored(batch_B, maps)))
    """
    reflected = tensordict.clone(recurse=False)
    for key, mirror in maps.items():
        path = path_of(key)
        # Observations after the step are mirrored like those before it.
        places = [
            place for place in (path, ("next", *path)) if tensordict.get(place, None) is not None
        ]
        if not places:
            raise KeyError(f"maps: the batch has no {key!r}")
        for place in places:
            reflected.set(place, mirror(tensordict.get(place)))
    return reflected
