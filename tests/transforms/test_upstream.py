"""What transforms use of torch and TorchRL beyond their documents is still there; a failure names what moved."""

import inspect
import multiprocessing
import sys
from importlib.metadata import version

import torch
from torchrl.collectors import _runner
from torchrl.envs import GymEnv, TransformedEnv, batched_envs
from torchrl.envs.transforms import Compose

from ksim_rl.testing import CounterEnv
from ksim_rl.transforms import ObservationNoise, UniformNoise, upstream


def test_views_know_their_base():
    whole = torch.zeros(4, 5)
    moved = f"torch {version('torch')}: Tensor._base is not what a view shows"
    assert all(upstream.base_of(part) is whole for part in whole.split([2, 3], dim=1)), moved
    assert upstream.base_of(whole) is None, moved


def test_transforms_know_their_container():
    noise = ObservationNoise("count", noise=UniformNoise(low=-1.0, high=1.0))
    moved = f"TorchRL {version('torchrl')}: Transform._container or TransformedEnv._transform"
    assert not upstream.is_in_env(noise), moved
    env = TransformedEnv(CounterEnv((3, 4)), Compose(noise))
    assert upstream.is_in_env(noise) and bool(noise.enabled), moved
    env.eval()
    assert not bool(noise.enabled), moved


def test_gym_envs_tell_their_horizon():
    moved = f"TorchRL {version('torchrl')}: GymWrapper._env is not the Gymnasium env"
    assert upstream.gym_horizon(GymEnv("Pendulum-v1")) == 200, moved
    assert upstream.gym_horizon(CounterEnv((3, 4))) is None


def test_a_stock_env_keeps_seeds_from_its_transforms():
    moved = (
        f"TorchRL {version('torchrl')}: TransformedEnv.set_seed is not what _SetSeed stands in for"
    )
    env = TransformedEnv(
        CounterEnv((3, 4)), ObservationNoise("count", noise=UniformNoise(low=-1.0, high=1.0))
    )
    assert TransformedEnv.set_seed(env, 5) == CounterEnv().set_seed(5), moved
    assert env.base_env.seed_value == 5 and env.transform.seed_value != 5, moved
    assert env.set_seed(6) == CounterEnv().set_seed(6) and env.transform.seed_value == 6, moved


def told(results, worker_idx=None):
    results.put(
        (upstream.fresh_seed(), multiprocessing.current_process()._kwargs.get("worker_idx"))
    )


def test_workers_know_their_number():
    moved = f"Python {sys.version_info[:2]}: Process._kwargs or _identity"
    fork = multiprocessing.get_context("fork")
    results, found = fork.Queue(), []
    for number in (0, 1, 0):
        process = fork.Process(target=told, kwargs={"results": results, "worker_idx": number})
        process.start()
        found.append(results.get(timeout=60))
        process.join()
    assert [number for _, number in found] == [0, 1, 0], moved
    # The same state of torch's generator and the same number give the same seed; another number gives another one.
    assert found[0] == found[2] and found[0][0] != found[1][0], moved
    # Its name since TorchRL 0.14.1.
    collect = getattr(_runner, "_main_async_collector_impl", _runner._main_async_collector)
    for function in (batched_envs._run_worker_pipe_shared_mem, collect):
        assert {"worker_idx", "idx"} & set(inspect.signature(function).parameters), (
            f"TorchRL: {function.__name__}"
        )
