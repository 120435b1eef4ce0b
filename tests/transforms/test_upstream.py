"""What transforms use of torch and TorchRL beyond their documents is still there; a failure names what moved."""

from importlib.metadata import version

import torch
from torchrl.envs import GymEnv, TransformedEnv
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
