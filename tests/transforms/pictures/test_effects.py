"""Each effect against slices, torch's own functions or its formula, on bytes and on floats."""

import math

import pytest
import torch
from torch.nn import functional

from ksim_rl.transforms import (
    Blur,
    Brightness,
    Contrast,
    CutOut,
    DepthHoles,
    DepthRange,
    DepthSteps,
    PixelNoise,
    RandomCrop,
    RandomShift,
)

E, N, H, W, C = 3, 2, 7, 6, 3


def pictures(dtype=torch.uint8):
    generator = torch.Generator().manual_seed(2)
    bytes_ENHWC = torch.randint(256, (E, N, H, W, C), generator=generator)
    if dtype == torch.uint8:
        return bytes_ENHWC.to(dtype)
    return bytes_ENHWC.to(dtype) / 255


def assert_light(found, expected, dtype):
    """Bytes are the rounded formula, floats the formula, both from none to full light."""
    top = 255.0 if dtype == torch.uint8 else 1.0
    assert found.dtype == dtype
    expected = expected.clamp(0.0, top)
    if dtype != torch.uint8:
        torch.testing.assert_close(found, expected)
    else:
        # One step where float32 rounds a half to the other side.
        assert (found.float() - expected).abs().max() < 0.51


def draws(*rows):
    return torch.tensor(rows, dtype=torch.float32)


@pytest.mark.parametrize("dtype", [torch.uint8, torch.float32])
def test_a_shift_is_a_cut_from_pictures_with_repeated_edges(dtype):
    clean = pictures(dtype)
    # Uniform draws for the 7 offsets from -3 to 3, rows first.
    wanted = [(-3, 3), (0, 0), (2, -1)]
    unit_E2 = draws(*[[(offset + 3.5) / 7 for offset in pair] for pair in wanted])
    found = RandomShift(pixels=3)(clean, unit_E2)
    assert found.dtype == dtype
    for env, (down, right) in enumerate(wanted):
        planes = clean[env].permute(0, 3, 1, 2).double()
        padded = functional.pad(planes, (3, 3, 3, 3), mode="replicate")
        cut = padded[..., 3 + down : 3 + down + H, 3 + right : 3 + right + W]
        assert torch.equal(found[env].permute(0, 3, 1, 2).double(), cut)


def test_a_crop_reaches_every_place_and_none_beyond():
    clean = pictures()
    crop = RandomCrop(height=5, width=6)
    assert crop.new_shape((N, H, W, C)) == (N, 5, 6, C)
    found = crop(clean, draws([0.0, 0.0], [0.5, 0.5], [1 - 2**-24, 1 - 2**-24]))
    for env, row in enumerate((0, 1, 2)):
        assert torch.equal(found[env], clean[env, :, row : row + 5])
    with pytest.raises(ValueError, match="only 7 x 6 pixels"):
        RandomCrop(height=8, width=2).new_shape((N, H, W, C))


@pytest.mark.parametrize("dtype", [torch.uint8, torch.float32])
def test_brightness_and_contrast(dtype):
    clean = pictures(dtype)
    factor = torch.tensor([0.5, 1.0, 1.5])[:, None, None, None, None]
    unit_E1 = draws([0.0], [0.5], [1.0])
    found = Brightness(factor=(0.5, 1.5))(clean, unit_E1)
    assert_light(found, clean.float() * factor, dtype)
    mean = torch.stack([torch.stack([frame.float().mean() for frame in env]) for env in clean])[
        ..., None, None, None
    ]
    found = Contrast(factor=(0.5, 1.5))(clean, unit_E1)
    assert_light(found, mean + (clean.float() - mean) * factor, dtype)


@pytest.mark.parametrize("dtype", [torch.uint8, torch.float32])
def test_blur_is_a_convolution_with_a_gaussian(dtype):
    clean = pictures(dtype)
    found = Blur(sigma=(0.0, 1.0))(clean, draws([0.0], [0.6], [1.0]))
    assert torch.equal(found[0], clean[0])
    for env, sigma in ((1, 0.6), (2, 1.0)):
        offset = torch.arange(-3.0, 4.0)
        weight = torch.exp(-0.5 * (offset / sigma) ** 2)
        kernel = torch.outer(weight, weight) / weight.sum() ** 2
        planes = clean[env].float().permute(0, 3, 1, 2).reshape(N * C, 1, H, W)
        padded = functional.pad(planes, (3, 3, 3, 3), mode="replicate")
        blurred = functional.conv2d(padded, kernel[None, None])
        expected = blurred.reshape(N, C, H, W).permute(0, 2, 3, 1)
        assert_light(found[env], expected, dtype)


@pytest.mark.parametrize("dtype", [torch.uint8, torch.float32])
def test_noise_of_pixels_is_a_share_of_full_light(dtype):
    clean = pictures(dtype)
    noise = PixelNoise(std=0.1)
    normal_EK = torch.randn(E, noise.num_draws((N, H, W, C)))
    top = 255.0 if dtype == torch.uint8 else 1.0
    expected = clean.float() + 0.1 * top * normal_EK.view(clean.shape)
    assert_light(noise(clean, normal_EK), expected, dtype)


def test_a_rectangle_is_cut_out_within_the_picture():
    clean = pictures().clamp(min=1)
    # Heights 2, 3 and 4, widths the other way round; at the start, in between and at the end.
    unit_E4 = draws([0.0, 1.0, 0.0, 0.0], [0.5, 0.5, 0.5, 0.5], [1.0, 0.0, 0.999, 0.999])
    found = CutOut(pixels=(2, 4))(clean, unit_E4)
    for env, (top, left, height, width) in enumerate(((0, 0, 2, 4), (2, 2, 3, 3), (3, 4, 4, 2))):
        expected = clean[env].clone()
        expected[:, top : top + height, left : left + width] = 0
        assert torch.equal(found[env], expected)


def test_depth_has_holes_steps_and_a_range():
    depth = 6 * pictures(torch.float32)[..., :1]
    holes = DepthHoles(share=0.3, pixels=3, missing=-1.0)
    blocks = (math.ceil(H / 3), math.ceil(W / 3))
    assert holes.num_draws((N, H, W, 1)) == blocks[0] * blocks[1]
    unit_EK = torch.rand(E, blocks[0] * blocks[1])
    found = holes(depth, unit_EK)
    for row in range(H):
        for column in range(W):
            is_hole_E = unit_EK[:, row // 3 * blocks[1] + column // 3] < 0.3
            expected = torch.where(is_hole_E[:, None, None], -1.0, depth[:, :, row, column])
            assert torch.equal(found[:, :, row, column], expected)
    none_E = torch.zeros(E, 0)
    steps = DepthSteps(step=0.25)(depth, none_E)
    torch.testing.assert_close(steps, (depth * 4).round() / 4)
    # 3 m are 3000 steps of 1 mm, more than float16 has digits for: the nearest one is the number itself.
    far = (3.0 + depth / 6).half()
    half = DepthSteps(step=0.001)(far, none_E)
    assert half.dtype == torch.float16 and torch.equal(half, far)
    seen = DepthRange(reach=(1.0, 4.0))(depth, none_E)
    is_within = (depth >= 1.0) & (depth <= 4.0)
    assert torch.equal(seen, torch.where(is_within, depth, 0.0))


@pytest.mark.parametrize(
    ("effect", "fields", "message"),
    [
        (RandomShift, {"pixels": 0}, "pixels=0"),
        (Brightness, {"factor": (1.5, 0.5)}, "low exceeds high"),
        (DepthHoles, {"share": 1.5}, "share=1.5"),
        (Blur, {"each": "frame"}, "each='frame'"),
    ],
)
def test_settings_out_of_range_are_refused(effect, fields, message):
    with pytest.raises(ValueError, match=message):
        effect(**fields)


@pytest.mark.parametrize(
    ("effect", "least"),
    [
        (RandomShift(pixels=4), 4),
        (Blur(sigma=(0.0, 2.0)), 6),
        (CutOut(pixels=(2, 6)), 6),
        (DepthHoles(pixels=5), 5),
        (RandomCrop(height=5, width=3), 5),
    ],
)
def test_pictures_that_are_smaller_than_an_effect_are_refused(effect, least):
    """A shift is by one side at most, and so far does a blur reach, three standard deviations."""
    effect.new_shape((1, least, least + 3, 3))
    for too_small in ((1, least - 1, 20, 3), (2, 20, least - 1, 1)):
        if isinstance(effect, RandomCrop) and too_small[1] == 20:
            continue
        with pytest.raises(ValueError, match="pixels in height and width|have only"):
            effect.new_shape(too_small)
