"""Moved numbers show what rounding may do, and leave alone what is not rounded."""

import torch

from ksim_rl.compiled.rounding import Nudging, nudged


def generator():
    return torch.Generator().manual_seed(0)


def test_each_number_moves_to_a_neighbour():
    x = torch.randn(1000)
    moved = nudged(x, generator())
    up, down = (
        torch.nextafter(x, torch.tensor(torch.inf)),
        torch.nextafter(x, torch.tensor(-torch.inf)),
    )
    assert ((moved == up) | (moved == down)).all()
    assert 400 < int((moved == up).sum()) < 600
    assert torch.equal(
        nudged(torch.tensor([torch.inf, 1.0]), generator())[:1], torch.tensor([torch.inf])
    )


def test_a_number_moves_by_so_many_units():
    x = torch.cat([torch.randn(1000), torch.tensor([0.0, 1.0])])
    moved = nudged(x, generator(), units=8)
    steps = moved.view(torch.int32) - x.view(torch.int32)
    # Powers of two have smaller units below them.
    assert set(steps[:1000].abs().tolist()) == {8}
    assert float(moved[-2].abs()) == 8 * 2.0**-149
    assert float((moved[-1] - 1.0).abs()) in (8 * 2.0**-23, 8 * 2.0**-24)


def test_whole_numbers_stay():
    whole = torch.arange(5)
    assert nudged(whole, generator()) is whole


def test_a_result_shows_the_last_places_of_what_it_is_made_of():
    x = torch.full((100,), 3.14159)
    with Nudging(generator()):
        sensitive, steady = 1.0 + x.cos(), x.square()
    # Moving x itself hardly changes its cosine there.
    assert (
        (1.0 + torch.nextafter(x, torch.tensor(4.0)).cos()) - (1.0 + x.cos())
    ).abs().max() < 1e-9
    assert (sensitive - (1.0 + x.cos())).abs().max() > 1e-8
    assert ((steady - x.square()) / x.square()).abs().max() < 2e-7


def test_what_is_moved_copied_or_chosen_is_exact():
    x = torch.randn(50, 3)
    with Nudging(generator()):
        same = torch.where(x > 0, x, x.abs()).clamp(max=1.0)
        kept = torch.zeros(50, 3).copy_(torch.cat([x[:, :1], x[:, 1:]], 1))
    assert torch.equal(same, torch.where(x > 0, x, x.abs()).clamp(max=1.0)) and torch.equal(kept, x)


def test_sums_in_place_move_where_they_lie():
    total = torch.zeros(1000)
    with Nudging(generator()):
        total.add_(1.0)
    assert (total != 1.0).all() and ((total - 1.0).abs() < 2e-7).all()
