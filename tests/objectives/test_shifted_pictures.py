"""Pictures that move at random, against padding and cutting."""

import pytest
import torch
from tensordict import TensorDict
from torch.nn.functional import pad

from ksim_rl.objectives import ShiftedPictures
from ksim_rl.ranks import draws

PIXELS = 2


def places(pictures_BNHWC, moved_BNHWC):
    """Where each picture was cut out of one with repeated edges, rows and columns from 0 to 4."""
    found = []
    for picture_NHWC, moved_NHWC in zip(pictures_BNHWC, moved_BNHWC, strict=True):
        padded = pad(picture_NHWC.movedim(-1, 1).float(), [PIXELS] * 4, mode="replicate")
        fits = []
        for row in range(2 * PIXELS + 1):
            for column in range(2 * PIXELS + 1):
                cut = padded[..., row : row + 7, column : column + 9].movedim(1, -1)
                if torch.equal(cut.to(picture_NHWC.dtype), moved_NHWC):
                    fits.append((row, column))
        (place,) = fits
        found.append(place)
    return found


def test_frames_of_a_stack_move_together_and_what_follows_by_itself():
    torch.manual_seed(0)
    frames = torch.randint(256, (60, 3, 7, 9, 3)).to(torch.uint8)
    depth = torch.rand(60, 7, 9)
    leaves = {"rgb": frames, "depth": depth, "joints": torch.rand(60, 2)}
    minibatch = TensorDict({**leaves, "next": dict(leaves)}, batch_size=[60])
    ShiftedPictures({"rgb": "HWC", "depth": "HWC"}, pixels=PIXELS, minibatch=30).shift_(minibatch)
    now = places(frames, minibatch["rgb"])
    following = places(frames, minibatch["next", "rgb"])
    assert len(set(now)) > 15 and now != following
    for part in (minibatch, minibatch["next"]):
        assert part["rgb"].dtype == torch.uint8 and torch.equal(part["joints"], leaves["joints"])
    assert places(depth[:, None, :, :, None], minibatch["depth"][:, None, :, :, None]) != now


def test_ranks_move_the_rows_that_shards_of_one_process_have(monkeypatch):
    depth_MB = torch.rand(3, 8, 7, 9)

    def moved(part_MB):
        torch.manual_seed(0)
        rows = part_MB.flatten(0, 1)
        minibatches = TensorDict({"depth": rows, "next": {"depth": rows}}, batch_size=[len(rows)])
        size = part_MB.shape[1]
        ShiftedPictures({"depth": "HWC"}, pixels=PIXELS, minibatch=size).shift_(minibatches)
        return minibatches["depth"].unflatten(0, part_MB.shape[:2])

    whole_MB = moved(depth_MB)
    monkeypatch.setattr(draws, "size", lambda: 2)
    monkeypatch.setattr(draws, "first_row", lambda num_rows: num_rows)
    # The second of two ranks.
    assert torch.equal(moved(depth_MB[:, 4:]), whole_MB[:, 4:])


def test_a_shift_by_more_than_a_picture_is_refused():
    shifted = ShiftedPictures({"depth": "HWC"}, pixels=7, minibatch=2)
    shifted.check_shape("depth", (7, 9))
    said = r"random_shift: 'depth': pixels=7: it takes pictures of at least 7 .* these have 6 x 9"
    with pytest.raises(ValueError, match=said):
        shifted.check_shape("depth", (6, 9))
    rows = torch.rand(2, 6, 9)
    with pytest.raises(ValueError, match=said):
        shifted.shift_(TensorDict({"depth": rows, "next": {"depth": rows}}, batch_size=[2]))


def test_networks_without_pictures_are_refused():
    with pytest.raises(ValueError, match="random_shift=4: no network reads a picture"):
        ShiftedPictures({}, pixels=4, minibatch=1)
