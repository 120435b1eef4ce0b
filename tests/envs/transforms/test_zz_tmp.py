"""Each transform, and the usual chain, in a CUDA graph; without a GPU the sync counter stands in for it."""

import pytest
import torch
from torchrl.envs.transforms import Compose

from ksim_rl import random
from ksim_rl.envs.masked_transformed_env import MaskedTransformedEnv
from ksim_rl.envs.transforms import ring
from ksim_rl.envs.transforms.tally import count_down, tally
from ksim_rl.testing import CounterEnv
from tests.envs.transforms.chains import actions, full_chain
from tests.envs.transforms.transform_checks import KINDS
from tests.test_random import exact_uniform


def on_gpu(kind: str) -> MaskedTransformedEnv:
    chain = full_chain() if kind == "chain" else [KINDS[kind]()]
    env = MaskedTransformedEnv(CounterEnv((3, 5, 4, 7), device="cpu"), Compose(*chain))
    env.set_seed(3)
    return env



@pytest.mark.parametrize("kind", ["chain", *KINDS])
def test_steps_and_resets_do_not_synchronize_and_replay_as_they_ran(kind):
    eager, captured = on_gpu(kind), on_gpu(kind)
    chosen, key = actions(30, eager).cpu(), eager.action_key
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



@pytest.mark.parametrize("dtype", [torch.uint8, torch.bool, torch.float16, torch.float32, torch.int64])
@pytest.mark.parametrize("shape", [(), (3,), (48,), (2, 5)])
def test_rings_of_any_dtype_and_width_give_back_what_was_pushed(dtype, shape):
    rows, length = 37, 4
    pushed_TE = torch.randint(0, 2 if dtype == torch.bool else 100, (9, rows, *shape)).to(dtype).cpu()
    ring_EM = torch.zeros(rows, length, *shape, dtype=dtype, device="cpu")
    start_E = torch.zeros(rows, dtype=torch.int64, device="cpu")
    # Beyond 32 bits, as the clock of a long run.
    clock = torch.tensor(2**33 + 3, device="cpu")
    everyone_E, nobody_E = (torch.full((rows,), flag, device="cpu") for flag in (True, False))
    begun_EN = ring.begin(ring_EM, start_E, clock, pushed_TE[0], everyone_E, length)
    assert all(torch.equal(begun_EN[:, frame], pushed_TE[0]) for frame in range(length))
    lag_EN = torch.arange(length - 1, -1, -1, device="cpu").expand(rows, -1)
    for step in range(1, 9):
        clock.add_(1)
        found_EN = ring.push_and_read(ring_EM, start_E, clock, pushed_TE[step], lag_EN)
        for frame in range(length):
            assert torch.equal(found_EN[:, frame], pushed_TE[max(step - length + 1 + frame, 0)]), (
                step,
                frame,
            )
    assert torch.equal(ring.begin(ring_EM, start_E, clock, pushed_TE[0], nobody_E)[:, 0], pushed_TE[0])
    again_EN = ring.push_and_read(ring_EM, start_E, clock, pushed_TE[8], lag_EN)
    assert torch.equal(again_EN[:, 0], pushed_TE[5]), "a reset of nobody changes no ring"



def test_draws_are_the_hash_that_they_say_they_are():
    seed, counter_E = torch.tensor(5).cpu(), torch.tensor([3, 2**40 + 9, 0]).cpu()
    keys = random.row_keys(seed, 77, counter_E, 3)
    expected = [
        [exact_uniform(5, 77, row, int(counter_E[row]), index) for index in range(40)] for row in range(3)
    ]
    assert random.uniform(keys, 40).tolist() == expected
    lowest = [[-3 + int(number * 2**24) * 9 // 2**24 for number in row] for row in expected]
    drawn = random.integers(keys, 40, -3, 5)
    assert (drawn - torch.tensor(lowest).cpu()).abs().max() <= 1 and int(drawn.min()) >= -3
    sample = random.normal(random.row_keys(seed, 7, seed, 4000), 50).double()
    assert (
        abs(float(sample.mean())) < 4 / 200_000**0.5
        and abs(float(sample.var()) - 1) < 4 * (2 / 200_000) ** 0.5
    )



def test_tallies():
    step_E, total_E, left_E = (
        torch.zeros(999).long().cpu(),
        torch.zeros(999, 1).cpu(),
        torch.full((999,), 3.0).cpu(),
    )
    reward_E = torch.randn(999, 1).cpu()
    for count in range(1, 5):
        steps, totals = tally(step_E, total_E, reward_E, None)
        assert bool((steps == count).all())
        torch.testing.assert_close(totals, count * reward_E)
        assert torch.equal(count_down(left_E, None, 3.0, 3.0), torch.full_like(left_E, max(3 - count, 0)) / 3)
    mask_E = torch.arange(999).cpu() % 7 == 0
    steps, totals = tally(step_E, total_E, None, mask_E)
    assert torch.equal(steps == 0, mask_E) and torch.equal(totals[:, 0] == 0, mask_E)
    assert torch.equal(count_down(left_E, mask_E, 3.0, 1.0) == 3, mask_E)
