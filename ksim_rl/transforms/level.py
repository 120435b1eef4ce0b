"""This module lets the strength of transforms follow a difficulty in [0, 1]."""

from collections.abc import Iterable
from typing import Self

import torch
from jaxtyping import Float32, Shaped
from torch import Tensor
from torchrl.envs.transforms import Transform


class FollowsLevel(Transform):
    """Mixin of transforms that a curriculum can drive: the buffer `level`, float32 [], 1 until somebody changes it."""

    level: Tensor

    def _register_level(self, *, is_used: bool) -> None:
        self.register_buffer("level", torch.ones(()), persistent=is_used)

    def follow_level_(self, level: Shaped[Tensor, "*any"] | float) -> Self:
        """Follow a level: a number is copied; a tensor is read anew at every step, wherever it is changed in place.

        Raises:
            ValueError: if a tensor is not float32 of shape [], or a number is outside [0, 1].
        """
        if isinstance(level, Tensor):
            if level.shape != () or level.dtype != torch.float32:
                raise ValueError(
                    f"level has shape {tuple(level.shape)} and dtype {level.dtype}: expected () and torch.float32"
                )
            self._buffers["level"] = level
        elif 0.0 <= level <= 1.0:
            self.level.fill_(level)
        else:
            raise ValueError(f"level={level!r}: expected a number in [0, 1]")
        return self


def follow_level(transforms: Iterable[Transform], level: Float32[Tensor, ""] | float) -> None:
    """Let all transforms that can follow the level do so."""
    for transform in transforms:
        for module in transform.modules():
            if isinstance(module, FollowsLevel):
                module.follow_level_(level)
