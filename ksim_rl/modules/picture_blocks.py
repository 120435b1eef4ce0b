"""The first convolution of an encoder reads pictures in blocks of pixels: one copy of the bytes, and many channels."""

from functools import partial

import torch
from jaxtyping import Float, Shaped
from torch import Tensor, nn
from torch.nn import functional

from ksim_rl.transforms.pictures.layout import Layout, framed


class PictureBlocks(nn.Module):
    """Maps pictures [B, *shape] to floats [B, S * S * N * C, H / S, W / S]: the pixels of each block are its channels.

    It is one copy, channels last in memory. Bytes become what autocast asks for, as all 256 of them are exact there,
    and other pictures float32; `low` is taken off them. The channels of a pixel are N stacked pictures in a row, the
    oldest first. Rows and columns at the end that no window of the convolution reaches are left out.
    """

    def __init__(self, layout: Layout, *, low: float, kernel_size: int, stride: int) -> None:
        super().__init__()
        self.layout: Layout = layout
        self.low = low
        self.block = _block_size(kernel_size, stride)
        self.kernel_size = kernel_size
        self.stride = stride

    def forward(self, pictures: Shaped[Tensor, " B *shape"]) -> Float[Tensor, "B C H W"]:
        """Return the pictures as `BlockConvolution` reads them."""
        pictures_BNHWC = framed(pictures, self.layout)
        dtype = torch.float32
        if self.low != 0.0:
            pictures_BNHWC = pictures_BNHWC.float() - self.low
        elif pictures.dtype == torch.uint8:
            dtype = _narrowest(pictures.device)
        height, width = pictures_BNHWC.shape[2:4]
        reached_BNHWC = pictures_BNHWC[:, :, : self._reached(height), : self._reached(width)]
        # [B, N, H / S, S, W / S, S, C]
        blocks = reached_BNHWC.unflatten(3, (-1, self.block)).unflatten(2, (-1, self.block))
        pixels_last = blocks.permute(0, 2, 4, 3, 5, 1, 6)
        # Floats are made here, for the pictures at hand only: datasets keep bytes.
        copied = pixels_last.to(dtype, memory_format=torch.contiguous_format)
        return copied.flatten(3).movedim(-1, 1)

    def _reached(self, size: int) -> int:
        """Return how many rows or columns windows reach: a multiple of `block` where that is the stride."""
        if self.block == 1:
            return size
        return (size - self.kernel_size) // self.stride * self.stride + self.kernel_size


class BlockConvolution(nn.Conv2d):
    """A convolution, with its weights [O, I, K, K], that reads the blocks of `PictureBlocks`, and scales them.

    A window of K = M * S pixels that moves by S pixels covers M x M whole blocks, and moves by one. So there are S * S
    times as many channels to add up in a smaller window: kernels for matrices read 144 of them at a time where three
    pictures in colour have 9. The scale goes into the weights, which are fewer than the pixels.
    """

    def __init__(self, plain: nn.Conv2d, *, scale: float) -> None:
        # The weights of the plain one, so that none are drawn here.
        super().__init__(
            plain.in_channels,
            plain.out_channels,
            plain.kernel_size[0],
            stride=plain.stride[0],
            device="meta",
        )
        self.weight = plain.weight
        self.bias = plain.bias
        self.block = _block_size(self.kernel_size[0], self.stride[0])
        self.scale = scale

    def forward(self, blocks_BCHW: Float[Tensor, "B C H W"]) -> Float[Tensor, "B O H2 W2"]:
        """Return what the plain convolution gives for the scaled pictures."""
        windows = self.kernel_size[0] // self.block
        # [O, I, M, S, M, S]
        parts = self.weight.unflatten(3, (windows, self.block)).unflatten(2, (windows, self.block))
        weight_OIMM = parts.permute(0, 3, 5, 1, 2, 4).flatten(1, 3) * self.scale
        convolve = partial(
            functional.conv2d,
            weight=weight_OIMM,
            bias=self.bias,
            stride=self.stride[0] // self.block,
        )
        # Bytes have become what autocast asks for. Within torch.func.vmap it is on and rounds no weights: a convolution
        # of no pictures tells, for which next to nothing runs.
        if blocks_BCHW.dtype != weight_OIMM.dtype:
            none = convolve(blocks_BCHW[:0].to(weight_OIMM.dtype))
            if none.dtype == weight_OIMM.dtype:
                blocks_BCHW = blocks_BCHW.to(weight_OIMM.dtype)
        return convolve(blocks_BCHW)


def _block_size(kernel_size: int, stride: int) -> int:
    """Return the side of blocks that windows cover whole, pixels: the stride, or 1 where it does not divide them."""
    if kernel_size % stride == 0:
        return stride
    return 1


def _narrowest(device: torch.device) -> torch.dtype:
    """Return the dtype to which autocast would round the pictures, or float32."""
    if torch.is_autocast_enabled(device.type):
        return torch.get_autocast_dtype(device.type)
    return torch.float32
