"""Encoders make features of pictures; they stand in front of any network, which then reads features as numbers."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, Int64, Shaped
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor, nn
from torchrl.data import TensorSpec
from torchrl.modules import ConvNet

from ksim_rl.checked import NUMBERS_PER_WEIGHT, Checked, Count, Range
from ksim_rl.checks import check_choice
from ksim_rl.device.state_tree import DESCRIPTION
from ksim_rl.modules.mlp import ACTIVATIONS, Device
from ksim_rl.modules.picture_blocks import BlockConvolution, PictureBlocks
from ksim_rl.transforms.pictures.layout import Layout, check_layout, framed
from ksim_rl.transforms.specs import spell


@dataclass(frozen=True, kw_only=True)
class EncoderCfg(Checked):
    """Makes features of the pictures of one observation: here by TorchRL's `ConvNet`, one layer per number of channels.

    A subclass with a `build` of its own makes any encoder, and configs name it by `_target_`.

    Attributes:
        channels: of the outputs of each convolution.
        kernel_sizes, strides: of each convolution, pixels.
        activation: after each convolution.
        spatial_softmax: where each channel is brightest, instead of all its pixels; see `SpatialSoftmax`.
        value_range: the values that become 0 and 1; None takes [0, 255] for uint8, and floats as they are.
        layout: of one picture; "CHW" is what TorchRL's `ToTensorImage` gives.
    """

    channels: tuple[Count, ...] = (32, 64, 64)
    kernel_sizes: tuple[Count, ...] = (8, 4, 3)
    strides: tuple[Count, ...] = (4, 2, 1)
    activation: str = "relu"
    spatial_softmax: bool = False
    value_range: Range | None = None
    layout: Layout = "HWC"

    def _check_fields(self) -> None:
        super()._check_fields()
        check_choice("activation", self.activation, ACTIVATIONS)
        if not self.channels:
            raise ValueError("channels=(): expected at least one convolution")
        for name in ("channels", "kernel_sizes", "strides"):
            numbers = tuple(getattr(self, name))
            # The class is frozen; a config file gives a list.
            object.__setattr__(self, name, numbers)
            if len(numbers) != len(self.channels):
                raise ValueError(
                    f"{name}={numbers}: expected {len(self.channels)} numbers, one for each of channels={self.channels}"
                )
        if self.value_range is not None and self.value_range[0] == self.value_range[1]:
            raise ValueError(f"value_range={self.value_range}: expected low < high")

    def least_numbers(self, num_envs: int) -> Mapping[tuple[str, ...], float]:
        """Return what the convolutions need, of pictures with one channel."""
        below = (1, *self.channels[:-1])
        weights = 0
        for inputs, outputs, size in zip(below, self.channels, self.kernel_sizes, strict=True):
            weights += inputs * outputs * size**2
        return {("channels", "kernel_sizes"): NUMBERS_PER_WEIGHT * weights}

    def build(self, spec: TensorSpec, *, device: Device = None) -> nn.Module:
        """Return the module that maps pictures [B, *shape] as the env gives them to features [B, F].

        `spec` has the shape and the dtype of one picture, or of N stacked ones: [H, W], [H, W, C] or [N, H, W, C]. N
        stacked distances [N, H, W] are read as channels, with the layout "CHW".
        """
        if spec.dtype not in (torch.uint8, torch.float16, torch.float32):
            raise ValueError(
                f"it reads pictures of {spec.dtype}, and only uint8, float16 or float32 is an amount of light or a "
                "distance: map ids to colours first, or name an encoder of your own by _target_"
            )
        check_layout(spec.shape, self.layout)
        low, high = self._ends(spec.dtype)
        blocks = PictureBlocks(
            self.layout, low=low, kernel_size=self.kernel_sizes[0], stride=self.strides[0]
        )
        # Counted on the meta device, which allocates nothing.
        framed_BNHWC = framed(torch.empty(1, *spec.shape, device="meta"), self.layout)
        num_channels = framed_BNHWC.shape[1] * framed_BNHWC.shape[-1]
        # Drawn on the CPU, so that one seed gives the same network on every device.
        convolutions = ConvNet(
            in_features=num_channels,
            num_cells=list(self.channels),
            kernel_sizes=list(self.kernel_sizes),
            strides=list(self.strides),
            activation_class=ACTIVATIONS[self.activation],
            aggregator_class=SpatialSoftmax if self.spatial_softmax else nn.Flatten,
            aggregator_kwargs={},
        )
        plain = convolutions[0]
        assert isinstance(plain, nn.Conv2d)
        convolutions[0] = BlockConvolution(plain, scale=1.0 / (high - low))
        return nn.Sequential(blocks, convolutions).to(device)

    def _ends(self, dtype: torch.dtype) -> tuple[float, float]:
        """Return the values that become 0 and 1."""
        if self.value_range is not None:
            return self.value_range
        if dtype == torch.uint8:
            return 0.0, 255.0
        return 0.0, 1.0


class SpatialSoftmax(nn.Module):
    """Where each of C channels is brightest: the mean place x, y in [-1, 1], weighted by the softmax of its pixels.

    Maps [B, C, H, W] to [B, 2 C], all x first; x runs to the right and y downwards. Levine et al., "End-to-end training
    of deep visuomotor policies", JMLR 2016.
    """

    def forward(self, channels_BCHW: Float[Tensor, "B C H W"]) -> Float[Tensor, "B F"]:
        """Return the places."""
        height, width = channels_BCHW.shape[-2:]
        # Half precision would round the places to some pixels.
        channels_BCHW = channels_BCHW.float()
        device = channels_BCHW.device
        weights_BCHW = channels_BCHW.flatten(-2).softmax(-1).unflatten(-1, (height, width))
        x_W = torch.linspace(-1.0, 1.0, width, device=device)
        y_H = torch.linspace(-1.0, 1.0, height, device=device)
        x_BC = (weights_BCHW.sum(-2) * x_W).sum(-1)
        y_BC = (weights_BCHW.sum(-1) * y_H).sum(-1)
        return torch.cat((x_BC, y_BC), -1)


class Encoder(nn.Module):
    """Maps pictures [*batch, *shape] to features [*batch, F], with a network that a config builds for one batch dim.

    `spec` is the spec of one picture. A ValueError tells where the config's module does not fit, or pictures differ,
    also those that a loaded state was learned on: weights of convolutions fit pictures of any size.
    """

    def __init__(self, cfg: EncoderCfg, spec: TensorSpec, *, device: Device = None) -> None:
        super().__init__()
        self.shape = spec.shape
        self.dtype = spec.dtype
        self.layout: Layout = cfg.layout
        maker = f"{type(cfg).__name__}.build for pictures {list(spec.shape)}"
        self.layers = cfg.build(spec, device=device)
        if not isinstance(self.layers, nn.Module):
            raise ValueError(f"{maker} returns a {type(self.layers).__name__}: expected a module")
        # Tried on two pictures; statistics of batches stay as they are.
        self.layers.eval()
        pictures = torch.zeros(2, *spec.shape, dtype=spec.dtype, device=device)
        try:
            with torch.no_grad():
                features = self.layers(pictures)
        except (RuntimeError, TypeError, ValueError) as error:
            raise ValueError(f"{maker}: it cannot map two of them: {error}") from error
        finally:
            self.layers.train()
        fits = isinstance(features, Tensor) and features.ndim == 2 and len(features) == 2
        if not fits:
            found = list(features.shape) if isinstance(features, Tensor) else type(features)
            raise ValueError(f"{maker}: it maps two of them to {found}: expected [2, features]")
        self.num_features: int = features.shape[1]

    def forward(self, pictures: Shaped[Tensor, "*pictures"]) -> Float[Tensor, "*features"]:
        """Return the features."""
        start = pictures.ndim - len(self.shape)
        is_shape = start >= 0 and pictures.shape[start:] == self.shape
        # Bytes and floats have other scales.
        if not is_shape or pictures.dtype != self.dtype:
            raise ValueError(
                f"the encoder was built for pictures {list(self.shape)} of {self.dtype}, and reads "
                f"{list(pictures.shape)} of {pictures.dtype}"
            )
        features = self.layers(pictures.reshape(-1, *self.shape))
        return features.reshape(*pictures.shape[:start], self.num_features)

    def get_extra_state(self) -> Int64[Tensor, " N"]:
        """Return the shape of one picture, which goes into a state beside the weights."""
        return torch.tensor(self.shape)

    def set_extra_state(self, shape_N: Int64[Tensor, " N"]) -> None:
        """Refuse a state that was learned on pictures of another shape."""
        if shape_N.tolist() != list(self.shape):
            raise ValueError(
                f"the encoder was built for pictures {list(self.shape)}, and what is loaded has learned on "
                f"{shape_N.tolist()}: take the same size, or train from the start"
            )

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any) -> None:
        # States of before shapes were in them say nothing of theirs.
        state_dict.setdefault(f"{prefix}{DESCRIPTION}", self.get_extra_state())
        super()._load_from_state_dict(state_dict, prefix, *args)


def picture_encoders(*networks: nn.Module) -> dict[NestedKey, Encoder]:
    """Return the observations that networks read through encoders, and one of the encoders of each.

    A ValueError if two of them read one observation by different layouts, as one would take rows for channels.
    """
    found: dict[NestedKey, Encoder] = {}
    for network in networks:
        for module in network.modules():
            if not isinstance(module, TensorDictModule) or not isinstance(module.module, Encoder):
                continue
            key = unravel_key(module.in_keys[0])
            other = found.setdefault(key, module.module)
            if other.layout != module.module.layout:
                raise ValueError(
                    f"encoders.{spell(key)}.layout: one network reads it as {other.layout!r} and another one as "
                    f"{module.module.layout!r}: give it the same layout in modules.actor and modules.critic"
                )
    return found
