"""What terms keep, and what they draw."""

import pytest
import torch

from ksim_rl.scene.state.buffers import Buffers
from tests.mdp.bench import FREE_BODY, Bench

E = 16


def odd_rows():
    return torch.arange(E) % 2 == 1


def test_a_buffer_belongs_to_the_calling_term():
    driver = Bench(FREE_BODY, E, {}).driver
    view = driver.view
    with driver.scope("rewards/a"):
        first = view.buffer("peak", 2)
    with driver.scope("rewards/b"):
        second = view.buffer("peak", 3, dtype=torch.int64)
    with driver.scope("rewards/a"):
        assert view.buffer("peak", 2) is first
        with pytest.raises(
            ValueError, match=r"'rewards/a\.peak' is torch.float32 \(2,\), asked for"
        ):
            view.buffer("peak", 3)
    assert first.shape == (E, 2) and second.dtype == torch.int64


def test_rows_that_reset_forget_unless_told_to_keep():
    driver, mask_E = Bench(FREE_BODY, E, {}).driver, odd_rows()
    view = driver.view
    with driver.scope("rewards/a"):
        forgets, keeps = view.buffer("forgets", 2, 2), view.buffer("keeps", keep=True)
    forgets.fill_(1.0), keeps.fill_(1.0)
    view.buffers.clear(mask_E)
    assert keeps.eq(1.0).all() and forgets[mask_E].eq(0.0).all() and forgets[~mask_E].eq(1.0).all()


def test_a_buffer_cannot_come_into_being_after_construction():
    driver = Bench(FREE_BODY, E, {}).driver
    view = driver.view
    with driver.scope("rewards/a"):
        held = view.buffer("held")
        held.fill_(1.0)
        driver.freeze()
        assert view.buffer("held") is held and held.eq(0.0).all()
        with pytest.raises(ValueError, match=r"'rewards/a\.late' is new after construction"):
            view.buffer("late")


def drawn(driver, scope, counter=None, *, times=1, draws="", normal=False):
    view = driver.view
    with driver.scope(scope, counter, draws=draws):
        return [view.normal(3) if normal else view.uniform(3) for _ in range(times)]


def test_draws_are_a_function_of_seed_scope_moment_and_row():
    driver = Bench(FREE_BODY, E, {}).driver
    view = driver.view
    (first,) = drawn(driver, "events/a")
    assert torch.equal(drawn(driver, "events/a")[0], first), "the same moment, the same numbers"
    others = [
        drawn(driver, "events/b")[0],
        drawn(driver, "events/a", draws="reset")[0],
        drawn(driver, "events/a", torch.ones((), dtype=torch.int64))[0],
        drawn(driver, "events/a", times=2)[1],
    ]
    for other in others:
        assert not torch.isclose(other, first).any()
    view.seed.fill_(1)
    assert not torch.isclose(drawn(driver, "events/a")[0], first).any()
    assert len(first.unique()) == first.numel(), "rows and columns draw apart"


def test_draws_advance_with_the_step_or_with_the_given_counter():
    driver = Bench(FREE_BODY, E, {}).driver
    view = driver.view
    before = drawn(driver, "events/a", normal=True)[0]
    view.step_count.add_(1)
    assert not torch.isclose(drawn(driver, "events/a", normal=True)[0], before).any()
    reset_before = drawn(driver, "events/a", view.reset_count_E)[0]
    view.reset_count_E[3] += 1
    reset_after = drawn(driver, "events/a", view.reset_count_E)[0]
    changed = (reset_after != reset_before).any(-1)
    assert changed.tolist() == [row == 3 for row in range(E)], (
        "one row's reset changes its own numbers only"
    )


def test_a_row_draws_the_same_numbers_among_few_and_many():
    few, many = Bench(FREE_BODY, 2, {}).driver, Bench(FREE_BODY, E, {}).driver
    assert torch.equal(drawn(few, "events/a")[0], drawn(many, "events/a")[0][:2])


def test_draws_keep_to_their_range():
    driver = Bench(FREE_BODY, E, {}).driver
    view = driver.view
    low, high = torch.tensor([0.0, -5.0]), torch.tensor([0.1, 5.0])
    with driver.scope("events/a"):
        drawn_E2 = view.uniform(2, low, high)
    assert (drawn_E2 >= low).all() and (drawn_E2 < high).all() and drawn_E2[:, 1].std() > 1.0


def test_a_buffer_starts_at_its_initial_value_whenever_it_starts():
    buffers = Buffers(3, torch.device("cpu"))
    pose_L = torch.tensor([1.0, 2.0])
    target_EL = buffers.get("target", 2, initial=pose_L)
    gain_EL = buffers.get("gain", 2, keep=True, initial=pose_L)
    assert target_EL.tolist() == [[1.0, 2.0]] * 3
    target_EL.fill_(9.0)
    buffers.freeze()
    assert target_EL.tolist() == gain_EL.tolist() == [[1.0, 2.0]] * 3
    target_EL.fill_(9.0)
    gain_EL.fill_(8.0)
    pose_L[0] = 5.0
    buffers.clear(torch.tensor([False, True, False]))
    assert target_EL.tolist() == [[9.0, 9.0], [5.0, 2.0], [9.0, 9.0]], "what it is now"
    assert gain_EL.tolist() == [[8.0, 8.0]] * 3
