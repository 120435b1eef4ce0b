"""This module shows episodes and samples in a left-right mirror."""

from collections.abc import Mapping

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite

from ksim_rl import checks
from ksim_rl.device import random
from ksim_rl.transforms.keyed_transform import KeyedTransform
from ksim_rl.transforms.mirror.mirror_map import MirrorMap, image
from ksim_rl.transforms.row_transform import Keys, as_keys, checked_out_keys
from ksim_rl.transforms.specs import (
    Device,
    bounded,
    bounds,
    drop_leaf_spec,
    leaf_spec,
    set_leaf_spec,
)

Bounds = tuple[Tensor, Tensor]


class Mirror(KeyedTransform):
    """Episodes in a left-right mirror: the policy sees mirrored observations, and the env gets its mirrored actions.

    For a robot that is its own mirror image these are episodes of the same task, so a policy that learns from them
    becomes symmetric. Whether an episode is mirrored is drawn per env at its reset. On a batch of samples, where it
    mirrors everything, use `mirrored`.

    Args:
        in_keys: observations [E, L]; nested keys as tuples.
        out_keys: where the mirrored ones go. Default: in place.
        in_keys_inv: the actions that the env reads; [] mirrors none.
        out_keys_inv: where the policy writes them. Default: the same keys.
        maps: by key of in_keys and in_keys_inv; see `mirror_joints`, `mirror_by_name`, `mirror_group`.
        probability: share of episodes that are mirrored.
        seed, stream: see `KeyedTransform`.

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
        seed: int = 0,
        stream: str | None = None,
    ) -> None:
        keys, keys_inv = as_keys(in_keys), as_keys(in_keys_inv)
        if set(maps) != {*keys, *keys_inv}:
            raise ValueError(f"maps has the keys {list(maps)}: expected those of {keys} and {keys_inv}")
        checks.check_in_range("probability", probability, low=0.0, high=1.0)
        super().__init__(
            keys,
            checked_out_keys(keys, out_keys),
            keys_inv,
            checked_out_keys(keys_inv, out_keys_inv),
            row_buffers=["mirrored_E"],
            seed=seed,
            stream=stream,
        )
        self.maps, self.probability = dict(maps), probability
        # Buffers rather than the maps' own tensors: compiled code would make those anew in each step.
        for index, key in enumerate([*keys, *keys_inv]):
            for name, tensor in zip(("source", "signs"), self.maps[key].tensors(None), strict=True):
                held = None if tensor is None else tensor.clone()
                self.register_buffer(f"{name}_{index}", held, persistent=False)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Widen the bounds to those of both images."""
        specs = [leaf_spec(observation_spec, key, type(self).__name__) for key in self.in_keys]
        for key, out_key, spec in zip(self.in_keys, self.out_keys, specs, strict=True):
            plain, other = bounds(spec), self._image(key, bounds(spec))
            low, high = torch.minimum(plain[0], other[0]), torch.maximum(plain[1], other[1])
            set_leaf_spec(observation_spec, out_key, bounded(low, high, dtype=spec.dtype, device=spec.device))
        self._size(observation_spec.shape, observation_spec.device)
        return observation_spec

    def transform_action_spec(self, action_spec: Composite) -> Composite:
        """Narrow the bounds to those that both images have in common."""
        specs = [leaf_spec(action_spec, key, type(self).__name__) for key in self.in_keys_inv]
        for key, out_key, spec in zip(self.in_keys_inv, self.out_keys_inv, specs, strict=True):
            plain, other = bounds(spec), self._image(key, bounds(spec))
            low, high = torch.maximum(plain[0], other[0]), torch.minimum(plain[1], other[1])
            if bool((low > high).any()):
                raise ValueError(
                    f"Mirror: the bounds of the action {key!r} and of its mirror image have nothing in common"
                )
            if key != out_key:
                drop_leaf_spec(action_spec, key)
            set_leaf_spec(action_spec, out_key, bounded(low, high, dtype=spec.dtype, device=spec.device))
        return action_spec

    def _image(self, key: NestedKey, ends: Bounds) -> Bounds:
        if ends[0].shape[-1:] != (self.maps[key].size,):
            raise ValueError(
                f"the map of {key!r} has {self.maps[key].size} columns for shape {tuple(ends[0].shape)}"
            )
        images = [self.maps[key](end) for end in ends]
        return torch.minimum(*images), torch.maximum(*images)

    def _size(self, batch: torch.Size, device: Device) -> None:
        self._size_rows(batch.numel(), device)
        self._size_buffer("mirrored_E", (self.num_rows,), torch.bool, device)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        if self._buffers["mirrored_E"] is None or not self.num_rows:
            self._size(tensordict_reset.batch_size, tensordict_reset.device)
        mask_E = self._reset_rows(tensordict, tensordict_reset)
        drawn_E = random.uniform(self._reset_keys("reset/mirrored"), 1)[:, 0] < self.probability
        self.mirrored_E.copy_(torch.where(mask_E, drawn_E, self.mirrored_E))
        return self._call(tensordict_reset)

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        for index, (key, out_key) in enumerate(zip(self.in_keys, self.out_keys, strict=True)):
            next_tensordict.set(out_key, self._seen(index, next_tensordict.get(key)))
        return next_tensordict

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        if self._buffers["mirrored_E"] is None:
            raise RuntimeError(
                "Mirror has state per env: use it in an env, and `mirrored` on a batch of samples"
            )
        pairs = zip(self.in_keys_inv, self.out_keys_inv, strict=True)
        for index, (key, out_key) in enumerate(pairs, start=len(self.in_keys)):
            tensordict.set(key, self._seen(index, tensordict.get(out_key)))
        return tensordict

    def _seen(self, index: int, value: Tensor) -> Tensor:
        mirrored_E = self.mirrored_E.reshape(*value.shape[: value.ndim - 1], 1)
        source_L, signs_L = getattr(self, f"source_{index}"), getattr(self, f"signs_{index}")
        return torch.where(mirrored_E, image(value, source_L, signs_L), value)


def mirrored(tensordict: TensorDictBase, maps: Mapping[NestedKey, MirrorMap]) -> TensorDictBase:
    """Return the mirror image of a batch of samples, of any batch size, for data augmentation.

    The keys of `maps` are mirrored, also under "next"; all other leaves stay, which is right for rewards and flags.

    Example:
        >>> augmented_B = torch.cat((batch_B, mirrored(batch_B, maps)))

    Raises:
        KeyError: if the batch has none of the keys of an entry.
    """
    reflected = tensordict.clone(recurse=False)
    for key, mirror in maps.items():
        path = key if isinstance(key, tuple) else (key,)
        places = [place for place in (path, ("next", *path)) if tensordict.get(place, None) is not None]
        if not places:
            raise KeyError(f"maps: the batch has no {key!r}")
        for place in places:
            reflected.set(place, mirror(tensordict.get(place)))
    return reflected
