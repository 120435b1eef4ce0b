"""Moves the pictures of minibatches at random, so that networks do not learn by heart where each pixel is."""

from collections.abc import Mapping, Sequence

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey, unravel_key

from ksim_rl import ranks
from ksim_rl.checks import naming
from ksim_rl.transforms import RandomShift
from ksim_rl.transforms.pictures.layout import Layout, framed, unframed
from ksim_rl.transforms.specs import spell


class ShiftedPictures:
    """Moves each picture of a minibatch by up to `pixels` in each direction; edges are repeated.

    The frames of a stack move together, and the observation that follows an env state by draws of its own, as in DrQ-v2
    (Yarats et al., arXiv 2107.09645). `layouts` has the pictures by key, and a minibatch has `minibatch` rows. Draws
    are of torch's default generator, as the minibatch's are. Makes no host sync. A ValueError says where networks
    read no picture.
    """

    def __init__(self, layouts: Mapping[NestedKey, Layout], *, pixels: int, minibatch: int) -> None:
        if not layouts:
            raise ValueError(
                f"random_shift={pixels}: no network reads a picture through an encoder, so there is nothing to move; "
                "leave it at 0"
            )
        self._effect = RandomShift(pixels=pixels)
        self._minibatch = minibatch
        self._layouts: dict[NestedKey, Layout] = {}
        for key, layout in layouts.items():
            self._layouts[key] = layout
            self._layouts[unravel_key(("next", key))] = layout

    def check_shape(self, key: NestedKey, shape: Sequence[int]) -> None:
        """Refuse pictures of a shape that are smaller than what they are moved by."""
        picture = torch.empty(1, *shape, device="meta")
        with naming(f"random_shift: {spell(key)!r}"):
            self._effect.new_shape(framed(picture, self._layouts[key]).shape[1:])

    def shift_(self, minibatch_B: TensorDictBase) -> None:
        """Replace the pictures of one or several minibatches by moved ones."""
        for key, layout in self._layouts.items():
            pictures = minibatch_B.get(key)
            self.check_shape(key, pictures.shape[1:])
            # By rows of a minibatch, of which each rank has a part as a shard of one process has.
            count = pictures.shape[0] // self._minibatch
            draws_MB2 = ranks.rand((count, self._minibatch, 2), dim=1, device=pictures.device)
            draws_B2 = draws_MB2.flatten(0, 1)
            moved = self._effect(framed(pictures, layout), draws_B2)
            minibatch_B.set(key, unframed(moved, pictures.ndim - 1, layout))
