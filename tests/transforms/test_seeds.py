"""Draws of transforms are repeatable, and independent in each worker, whatever wraps the env."""

import copy
import gc
import pickle
import weakref
from functools import partial

import pytest
import torch
from torchrl.collectors import Collector, MultiSyncCollector
from torchrl.envs import EnvCreator, ParallelEnv, SerialEnv, TransformedEnv
from torchrl.envs.transforms import Compose

from ksim_rl.envs import MaskedTransformedEnv
from ksim_rl.testing import CounterEnv
from ksim_rl.transforms import (
    ActionDelay,
    DelayCfg,
    Mirror,
    MirrorMap,
    ObservationDelay,
    ObservationNoise,
    UniformNoise,
)
from tests.transforms.chains import assert_same, fixed_rollout

NOISE = UniformNoise(low=-1.0, high=1.0, bias=UniformNoise(low=0.0, high=1.0))
# What each writes, in every worker from the same clean values, so that equal numbers are equal draws.
DRAWN = {
    "noise": (lambda: ObservationNoise("row", "out", noise=NOISE), "out"),
    "lag": (
        lambda: ObservationDelay("count", "out", delay=DelayCfg(max_lag=1000, resample_every=2)),
        "transform",
    ),
    "action lag": (lambda: ActionDelay(delay=DelayCfg(max_lag=1000)), "transform"),
}  # fmt: skip


def make(kind="noise", wrapper=TransformedEnv, lengths=(4, 4), nested=False):
    """Return an env whose clean values are the same in all workers."""
    transform = DRAWN[kind][0]()
    inner = wrapper(CounterEnv(lengths), transform if not nested else Compose(Compose(transform)))
    return TransformedEnv(inner, Compose()) if nested else inner


def draws(env, kind="noise", steps=6):
    """Return all that was drawn, one row per worker."""
    data = env.rollout(steps, break_when_any_done=False)
    if DRAWN[kind][1] == "out":
        return data["out"].reshape(2, -1)
    return torch.stack([part.transform.lag_E for part in env._envs]).float()


WRAPPED = {
    "stock": partial(make, wrapper=TransformedEnv),
    "ours": partial(make, wrapper=MaskedTransformedEnv),
    "nested": partial(make, nested=True),
}


@pytest.mark.parametrize("kind", DRAWN)
@pytest.mark.parametrize("wrapped", WRAPPED)
@pytest.mark.parametrize("seeding", ["set_seed", "manual_seed"])
def test_workers_of_a_serial_env_draw_apart_and_repeatably(kind, wrapped, seeding):
    if wrapped == "nested" and DRAWN[kind][1] == "transform":
        pytest.skip("lags are read from the outer transform")

    def drawn(seed):
        if seeding == "manual_seed":
            torch.manual_seed(seed)
        env = SerialEnv(2, partial(WRAPPED[wrapped], kind))
        if seeding == "set_seed":
            env.set_seed(seed)
        return draws(env, kind)

    first, again, other = drawn(3), drawn(3), drawn(4)
    assert torch.equal(first, again)
    assert not bool((first[0] == first[1]).all()) and not bool((first == other).all())
    if kind != "lag":
        assert (first[0] == first[1]).float().mean() < 0.5


full = pytest.mark.full


@pytest.mark.parametrize(
    ("start", "seeding"),
    [
        pytest.param("fork", "manual_seed", marks=full),
        pytest.param("fork", "set_seed", marks=full),
        pytest.param("spawn", "manual_seed", marks=full),
        pytest.param("spawn", "set_seed", marks=full),
    ],
)
def test_workers_of_a_parallel_env_draw_apart_and_repeatably(start, seeding):
    def drawn(seed):
        torch.manual_seed(seed)
        env = ParallelEnv(2, partial(make), mp_start_method=start)
        try:
            if seeding == "set_seed":
                env.set_seed(seed)
            return draws(env)
        finally:
            env.close()

    first, again, other = drawn(3), drawn(3), drawn(4)
    assert torch.equal(first, again)
    assert not bool((first[0] == first[1]).any())
    # The parent's `torch.manual_seed` does not reach a spawned process; `set_seed` does.
    assert bool((first == other).all()) == (seeding == "manual_seed" and start == "spawn")


@pytest.mark.full
@pytest.mark.parametrize("creator", [partial, EnvCreator])
def test_collectors_in_processes_draw_apart_and_repeatably(creator):
    def drawn(seed):
        torch.manual_seed(seed)
        collector = MultiSyncCollector(
            [creator(partial(make, lengths=()))] * 2,
            None,
            frames_per_batch=16,
            total_frames=16,
            cat_results="stack",
        )
        try:
            collector.set_seed(seed)
            return next(iter(collector))["out"].reshape(2, -1).clone()
        finally:
            collector.shutdown()

    first, again = drawn(3), drawn(3)
    assert torch.equal(first, again) and not bool((first[0] == first[1]).any())


def test_a_collector_in_this_process_seeds_transforms():
    def drawn(seed):
        torch.manual_seed(seed)  # a collector resets its env before it can be seeded
        collector = Collector(make(), None, frames_per_batch=8, total_frames=8)
        collector.set_seed(seed)
        return next(iter(collector))["out"].clone()

    assert torch.equal(drawn(3), drawn(3)) and not bool((drawn(3) == drawn(4)).any())


def test_a_stock_env_and_ours_draw_the_same_from_a_seed_and_return_the_same_next_one():
    stock, ours = make(), make(wrapper=MaskedTransformedEnv)
    assert stock.set_seed(5) == ours.set_seed(5) == CounterEnv().set_seed(5)
    assert_same(fixed_rollout(stock, 6), fixed_rollout(ours, 6))


def test_a_transform_that_joins_later_hears_seeds_too():
    first, later = make(), TransformedEnv(CounterEnv((4, 4)))
    later.append_transform(DRAWN["noise"][0]())
    first.set_seed(5), later.set_seed(5)
    assert_same(fixed_rollout(later, 6), fixed_rollout(first, 6))


def test_a_seed_that_was_given_stays_and_takes_none_from_torch():
    state = torch.get_rng_state()
    env = TransformedEnv(CounterEnv((4, 4)), ObservationNoise("row", "out", noise=NOISE, seed=7))
    env.reset()
    assert torch.equal(torch.get_rng_state(), state) and env.transform.seed_value == 7
    env.transform.seed_(8)
    env.reset()
    assert env.transform.seed_value == 8


def test_our_env_takes_its_transforms_seed_from_no_generator():
    env = make(wrapper=MaskedTransformedEnv)
    env.set_seed(0)
    state = torch.get_rng_state()
    env.reset()
    assert torch.equal(torch.get_rng_state(), state)


def test_a_state_from_before_the_first_reset_leaves_the_seed_open():
    unseeded, seeded = make(), make()
    seeded.transform.load_state_dict(unseeded.transform.state_dict())
    assert bool((unseeded.reset()["out"] != seeded.reset()["out"]).all())
    assert unseeded.transform.seed_value >= 0 and seeded.transform.seed_value >= 0
    seeded.transform.load_state_dict(unseeded.transform.state_dict())
    seeded.base_env.load_state_dict(unseeded.base_env.state_dict())
    assert_same(fixed_rollout(seeded, 4), fixed_rollout(unseeded, 4))


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_copies_hear_their_own_seeds(copied):
    env = make()
    other = copied(env)
    other.set_seed(5)
    assert other.transform.seed_value == 5 and env.transform.seed_value != 5


def test_an_env_goes_with_its_last_user():
    env = make()
    gone = weakref.ref(env)
    gc.collect()
    gc.disable()
    try:
        del env
        assert gone() is None
    finally:
        gc.enable()


def test_a_mirror_draws_apart_too():
    mirror = partial(
        Mirror, "count", maps={"count": MirrorMap(source=(0,), signs=(-1.0,))}, in_keys_inv=[]
    )
    env = SerialEnv(2, lambda: TransformedEnv(CounterEnv((2,) * 64), mirror()))
    env.set_seed(0)
    env.reset()
    first_E, second_E = (part.transform.mirrored_E for part in env._envs)
    assert 0.2 < (first_E == second_E).float().mean() < 0.8
