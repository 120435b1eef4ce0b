"""Each transform, and the usual chain, in a CUDA graph; without a GPU the sync counter stands in for it."""

import pytest
import torch
from torchrl.envs.transforms import Compose

from ksim_rl.device import random
from ksim_rl.envs.masked_transformed_env import MaskedTransformedEnv
from ksim_rl.testing import CounterEnv
from ksim_rl.transforms import ring
from ksim_rl.transforms.tally import tally
from tests.device.test_random import exact_uniform
from tests.transforms.chains import actions, full_chain
from tests.transforms.transform_checks import KINDS


def on_gpu(kind: str) -> MaskedTransformedEnv:
    chain = full_chain() if kind == "chain" else [KINDS[kind]()]
    counter = CounterEnv((3, 5, 4, 7), picture=(6, 8, 3), device="cuda")
    env = MaskedTransformedEnv(counter, Compose(*chain))
    env.set_seed(3)
    return env


@pytest.mark.gpu
@pytest.mark.parametrize("kind", ["chain", *KINDS])
def test_steps_and_resets_do_not_synchronize_and_replay_as_they_ran(kind):
    eager, captured = on_gpu(kind), on_gpu(kind)
    chosen, key = actions(30, eager).cuda(), eager.action_key
    roots = [eager.reset(), captured.reset()]
    root = roots[1].clone()
    action = torch.zeros_like(chosen[0])

    def body() -> None:
        _, after = captured.step_and_maybe_reset(root.copy().set(key, action))
        for name in list(root.keys(True, True)):
            root.get(name).copy_(after.get(name))

    def check(step: int) -> None:
        _, roots[0] = eager.step_and_maybe_reset(roots[0].set(key, chosen[step]))
        for name, value in root.items(True, True):
            assert torch.equal(value, roots[0][name]), (step, name)

    stream = torch.cuda.Stream()
    # The resets above may still run on the stream before.
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        try:
            for step in range(3):
                action.copy_(chosen[step])
                body()
                # The first step builds the specs that the env keeps from then on.
                torch.cuda.set_sync_debug_mode("error")
        finally:
            torch.cuda.set_sync_debug_mode("default")
        torch.cuda.synchronize()
        for step in range(3):
            _, roots[0] = eager.step_and_maybe_reset(roots[0].set(key, chosen[step]))
        graph = torch.cuda.CUDAGraph()
        graph.capture_begin(capture_error_mode="thread_local")
        body()
        graph.capture_end()
        for step in range(3, 30):
            action.copy_(chosen[step])
            graph.replay()
            torch.cuda.synchronize()
            check(step)


def begin(
    ring_EM, age_E, value_E, mask_E, *, num_frames=1, parts=None, lag_E=None, draws=ring.NO_DRAWS
):
    """Let the masked rows begin."""
    return ring.turn(ring_EM, age_E, value_E, lag_E, mask_E, num_frames, 0, parts, True, *draws)


def push(ring_EM, age_E, value_E, *, num_frames, stride, parts=None):
    """Make a step."""
    return ring.turn(
        ring_EM, age_E, value_E, None, None, num_frames, stride, parts, True, *ring.NO_DRAWS
    )


@pytest.mark.gpu
@pytest.mark.parametrize(
    "dtype", [torch.uint8, torch.bool, torch.float16, torch.float32, torch.int64]
)
@pytest.mark.parametrize("shape", [(), (3,), (48,), (2, 5)])
def test_rings_of_any_dtype_and_width_give_back_what_was_pushed(dtype, shape):
    rows, length = 37, 4
    pushed_TE = (
        torch.randint(0, 2 if dtype == torch.bool else 100, (9, rows, *shape)).to(dtype).cuda()
    )
    ring_EM = torch.zeros(rows, length, *shape, dtype=dtype, device="cuda")
    # Beyond 32 bits, as after a long run; the ring stands where it stood for an age of 0.
    age_E = torch.zeros(rows, dtype=torch.int64, device="cuda")
    everyone_E, nobody_E = (torch.full((rows,), flag, device="cuda") for flag in (True, False))
    shaped = (rows, length, *shape)
    begun_EN = begin(ring_EM, age_E, pushed_TE[0], everyone_E, num_frames=length).view(shaped)
    assert all(torch.equal(begun_EN[:, frame], pushed_TE[0]) for frame in range(length))
    age_E.fill_(2**34)
    ring_EM.copy_(pushed_TE[0].unsqueeze(1))
    for step in range(1, 9):
        found_EN = push(ring_EM, age_E, pushed_TE[step], num_frames=length, stride=1).view(shaped)
        for frame in range(length):
            assert torch.equal(found_EN[:, frame], pushed_TE[max(step - length + 1 + frame, 0)]), (
                step,
                frame,
            )
    unmoved = begin(ring_EM, age_E, pushed_TE[0], nobody_E).view(pushed_TE[0].shape)
    assert torch.equal(unmoved, pushed_TE[0])
    again_EN = push(ring_EM, age_E, pushed_TE[8], num_frames=length, stride=1).view(shaped)
    assert torch.equal(again_EN[:, 0], pushed_TE[6]), "a reset of no row changes no ring"
    assert bool((age_E == 2**34 + 9).all())


@pytest.mark.gpu
@pytest.mark.parametrize("sizes", [[3, 3, 12, 1], [16, 4, 8], [300, 20]])
def test_rings_of_several_parts_give_all_frames_of_one_part_after_another(sizes):
    rows, length, stride = 37, 3, 2
    pushed_TEL = torch.randn(12, rows, sum(sizes), device="cuda")
    ring_EM = torch.zeros(rows, (length - 1) * stride + 1, sum(sizes), device="cuda")
    age_E = torch.zeros(rows, dtype=torch.int64, device="cuda")
    parts = torch.tensor([4 * size for size in sizes], dtype=torch.int32, device="cuda")
    mask_E = torch.arange(rows, device="cuda") % 3 == 0
    begin(ring_EM, age_E, pushed_TEL[0], torch.ones_like(mask_E), num_frames=length, parts=parts)
    first_E = torch.zeros_like(age_E)
    for step in range(1, 12):
        found_EL = push(
            ring_EM, age_E, pushed_TEL[step], num_frames=length, stride=stride, parts=parts
        )
        start = 0
        for part_EL in pushed_TEL.split(sizes, dim=2):
            for frame in range(length):
                wanted_E = torch.maximum(
                    first_E, step - (length - 1 - frame) * torch.full_like(first_E, stride)
                )
                expected_EL = part_EL[wanted_E, torch.arange(rows, device="cuda")]
                stop = start + part_EL.shape[2]
                assert torch.equal(found_EL[:, start:stop], expected_EL), (step, frame)
                start = stop
        if step == 6:
            begin(ring_EM, age_E, pushed_TEL[6], mask_E, num_frames=length, parts=parts)
            first_E = torch.where(mask_E, 6, first_E)


@pytest.mark.gpu
def test_rows_that_begin_draw_their_lags():
    rows = 37
    ring_EM, age_E = torch.zeros(rows, 4, 3, device="cuda"), torch.zeros(rows, device="cuda").long()
    lag_E, count_E = torch.full_like(age_E, 9), torch.arange(rows, device="cuda")
    mask_E = torch.arange(rows, device="cuda") % 2 == 0
    seed = torch.tensor(5, device="cuda")
    draws = seed, count_E, 77, 1, 3
    begin(ring_EM, age_E, torch.ones(rows, 3, device="cuda"), mask_E, lag_E=lag_E, draws=draws)
    assert torch.equal(count_E, torch.arange(rows, device="cuda") + mask_E)
    drawn_E = random.integers(random.row_keys(seed, 77, count_E, rows), 1, 1, 3)[:, 0]
    assert torch.equal(lag_E, torch.where(mask_E, drawn_E, 9))


@pytest.mark.gpu
def test_draws_are_the_hash_that_they_say_they_are():
    seed, counter_E = torch.tensor(5).cuda(), torch.tensor([3, 2**40 + 9, 0]).cuda()
    keys = random.row_keys(seed, 77, counter_E, 3)
    expected = [
        [exact_uniform(5, 77, row, int(counter_E[row]), index) for index in range(40)]
        for row in range(3)
    ]
    assert random.uniform(keys, 40).tolist() == expected
    lowest = [[-3 + int(number * 2**24) * 9 // 2**24 for number in row] for row in expected]
    drawn = random.integers(keys, 40, -3, 5)
    assert (drawn - torch.tensor(lowest).cuda()).abs().max() <= 1 and int(drawn.min()) >= -3
    sample = random.normal(random.row_keys(seed, 7, seed, 4000), 50).double()
    assert (
        abs(float(sample.mean())) < 4 / 200_000**0.5
        and abs(float(sample.var()) - 1) < 4 * (2 / 200_000) ** 0.5
    )


@pytest.mark.gpu
def test_tallies():
    step_E, total_E = torch.zeros(999).long().cuda(), torch.zeros(999, 1).cuda()
    reward_E = torch.randn(999, 1).cuda()
    for count in range(1, 5):
        steps, totals = tally(step_E, total_E, reward_E, None)
        assert bool((steps == count).all())
        torch.testing.assert_close(totals, count * reward_E)
    mask_E = torch.arange(999).cuda() % 7 == 0
    steps, totals = tally(step_E, total_E, None, mask_E)
    assert torch.equal(steps == 0, mask_E) and torch.equal(totals[:, 0] == 0, mask_E)
