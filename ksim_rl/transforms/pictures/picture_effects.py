"""Changes pictures at random, as real cameras do."""

from collections.abc import Mapping

import torch
from jaxtyping import Float, Shaped
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec

from ksim_rl.checked import Range, check_value
from ksim_rl.checks import naming
from ksim_rl.device import random
from ksim_rl.transforms.checked_keys import Keys
from ksim_rl.transforms.pictures.effects import PictureEffect, top_of
from ksim_rl.transforms.pictures.layout import Layout, check_layout, framed, unframed
from ksim_rl.transforms.row_transform import KeyedTransform, Switched
from ksim_rl.transforms.specs import bounded, bounds

_MOMENTS = ("step", "reset", "episode", "forward")


class PictureEffects(Switched, KeyedTransform):
    """Pictures after `effects`, in their order: shift, crop, light, blur, noise, and the faults of depth cameras.

    Pictures are [H, W], [H, W, C] or stacked [N, H, W, C], uint8 or floats, in the order of `layout`; bytes stay bytes.
    All keys of one transform are changed alike, as pictures of one camera are. Each effect draws by its name, once per
    env step or per episode. `env.eval()` turns them off and `env.train()` on again, `enable_` does the same for one
    transform; crops are then of the middle. Batches of samples get new draws for each sample. Effects of light take
    floats of samples as within [0, 1], since no spec tells.

    Example:
        >>> effects = PictureEffects("rgb", effects={"shift": RandomShift(), "light": Brightness(each="episode")})
    """

    def __init__(
        self,
        in_keys: Keys,
        out_keys: Keys | None = None,
        *,
        effects: Mapping[str, PictureEffect],
        layout: Layout = "HWC",
        enabled: bool = True,
        seed: int | None = None,
        stream: str | None = None,
    ) -> None:
        super().__init__(in_keys, out_keys, seed=seed, stream=stream)
        if not effects:
            raise ValueError("effects={}: expected at least one")
        check_value("effects", effects, Mapping[str, PictureEffect])
        check_value("layout", layout, Layout)
        self.effects = dict(effects)
        self.layout: Layout = layout
        self._name_streams(f"{name}/{moment}" for name in effects for moment in _MOMENTS)
        self._register_switch(enabled)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        self._replace_leaves(observation_spec, self._changed)
        self._size_rows(observation_spec)
        return observation_spec

    def _changed(self, index: int, spec: TensorSpec) -> TensorSpec:
        batch_dims = self.batch_dims[index]
        low, high = bounds(spec)
        ends = float(low.min()), float(high.max())
        # One picture of the spec, without memory.
        picture = torch.empty(spec.shape[batch_dims:], dtype=spec.dtype, device="meta")
        leaf, ends = self._followed(self.in_keys[index], picture, ends)
        whole = torch.Size([*spec.shape[:batch_dims], *leaf])
        low, high = (torch.full(whole, end, device=spec.device) for end in ends)
        return bounded(low, high, dtype=spec.dtype, device=spec.device)

    def _followed(
        self, key: NestedKey, picture: Shaped[Tensor, "*leaf"], ends: Range
    ) -> tuple[torch.Size, Range]:
        """Return the shape and the ends of a picture after all effects; refuse one that they are not for."""
        if picture.dtype != torch.uint8:
            self._check_floating(key, picture.dtype)
        with naming(f"{type(self).__name__}: {key!r}"):
            check_layout(picture.shape, self.layout)
            shape = tuple(framed(picture[None], self.layout).shape[1:])
            for name, effect in self.effects.items():
                with naming(f"effects.{name}"):
                    _check_kind(effect, picture.dtype, ends)
                    shape = effect.new_shape(shape)
                ends = effect.new_ends(ends, top_of(picture))
        changed = torch.empty(1, *shape, device="meta")
        return unframed(changed, picture.ndim, self.layout).shape[1:], ends

    def _begin(self, tensordict_reset: TensorDictBase, mask_E: Tensor) -> TensorDictBase:
        return self._emit(tensordict_reset, "reset", self.reset_count_E)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        self._sized()
        self.step_count.add_(1)
        return self._emit(next_tensordict, "step", self.step_count)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Change a batch of samples, each by draws of its own."""
        self._check_samples(tensordict, is_floating=False)
        for key in self.in_keys:
            value = tensordict.get(key)
            leaf = value.shape[_batch_dims(tensordict, key) :]
            picture = torch.empty(leaf, dtype=value.dtype, device="meta")
            self._followed(key, picture, (0.0, top_of(value)))
        self._take_seed()
        self.step_count.add_(1)
        return self._emit(tensordict, "forward", self.step_count)

    def _emit(self, tensordict: TensorDictBase, moment: str, counter: Tensor) -> TensorDictBase:
        num_rows = tensordict.batch_size.numel()
        for index, key in enumerate(self.in_keys):
            value = tensordict.get(key)
            batch_dims = _batch_dims(tensordict, key)
            batch = value.shape[:batch_dims]
            leaf = value.shape[batch_dims:]
            framed_BNHWC = framed(value.reshape(-1, *leaf), self.layout)
            # Pictures of several agents of an env are frames of it.
            pictures_ENHWC = framed_BNHWC.reshape(num_rows, -1, *framed_BNHWC.shape[2:])
            changed_ENHWC = self._through(pictures_ENHWC, moment, counter)
            changed_BNHWC = changed_ENHWC.reshape(*framed_BNHWC.shape[:2], *changed_ENHWC.shape[2:])
            changed = unframed(changed_BNHWC, len(leaf), self.layout)
            tensordict.set(self.out_keys[index], changed.reshape(*batch, *changed.shape[1:]))
        return tensordict

    def _through(
        self, pictures_ENHWC: Shaped[Tensor, "E N H W C"], moment: str, counter: Tensor
    ) -> Shaped[Tensor, "E N h w C"]:
        """Return the pictures after all effects."""
        enabled = self._buffers["enabled"]
        assert enabled is not None
        for name, effect in self.effects.items():
            shape = pictures_ENHWC.shape[1:]
            draws_EK = self._draws(
                name, effect.num_draws(shape), len(pictures_ENHWC), moment, counter
            )
            # The middle of what may be drawn is the middle of the picture for a crop, which has no other form.
            middle = 0.0 if effect.is_normal else 0.5
            draws_EK = torch.where(enabled, draws_EK, middle)
            changed_ENHWC = effect(pictures_ENHWC, draws_EK)
            _check_result(name, effect, pictures_ENHWC, changed_ENHWC)
            if changed_ENHWC.shape == pictures_ENHWC.shape:
                changed_ENHWC = torch.where(enabled, changed_ENHWC, pictures_ENHWC)
            pictures_ENHWC = changed_ENHWC
        return pictures_ENHWC

    def _draws(
        self, name: str, num_draws: int, num_rows: int, moment: str, counter: Tensor
    ) -> Float[Tensor, "E K"]:
        """Draw the numbers of one effect."""
        effect = self.effects[name]
        # No kernel is launched for none.
        if num_draws == 0:
            return torch.empty(num_rows, 0, device=counter.device)
        # A count of resets stays through an episode, and so do its draws.
        if effect.each == "episode" and moment != "forward":
            moment = "episode"
            counter = self.reset_count_E
        stream = self._stream_ids[f"{name}/{moment}"]
        keys = random.row_keys(self.seed_value, stream, counter, num_rows)
        if effect.is_normal:
            return random.normal(keys, num_draws)
        return random.uniform(keys, num_draws)


def _batch_dims(tensordict: TensorDictBase, key: NestedKey) -> int:
    """Return the batch dims of the TensorDict in which a key lies: a nested one may have one of agents."""
    if isinstance(key, str):
        return tensordict.ndim
    return tensordict.get(key[:-1]).ndim


def _check_result(
    name: str,
    effect: PictureEffect,
    pictures_ENHWC: Shaped[Tensor, "E N H W C"],
    changed_ENHWC: Shaped[Tensor, "*any"],
) -> None:
    """Refuse results that are not what the spec says: bytes would become floats, say."""
    dtype = pictures_ENHWC.dtype
    shape = [len(pictures_ENHWC), *effect.new_shape(pictures_ENHWC.shape[1:])]
    if changed_ENHWC.dtype != dtype or list(changed_ENHWC.shape) != shape:
        raise ValueError(
            f"effects.{name}: {type(effect).__name__} gives {changed_ENHWC.dtype} {list(changed_ENHWC.shape)}: "
            f"expected {dtype} {shape}"
        )


def _check_kind(effect: PictureEffect, dtype: torch.dtype, ends: Range) -> None:
    """Refuse an effect on pictures that it is not for."""
    if effect.kind == "depth" and dtype == torch.uint8:
        raise ValueError(
            f"{type(effect).__name__} is for distances in m, and bytes are amounts of light"
        )
    is_light = dtype == torch.uint8 or 0.0 <= ends[0] <= ends[1] <= 1.0
    if effect.kind == "light" and not is_light:
        raise ValueError(
            f"{type(effect).__name__} is for amounts of light, uint8 or floats whose spec is within [0, 1]; "
            f"these may be from {ends[0]} to {ends[1]}"
        )
