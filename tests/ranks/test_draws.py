import torch
from torchrl.envs import TransformedEnv

from ksim_rl import ranks
from ksim_rl.device import random
from ksim_rl.modules import Categorical, DiagonalGaussian, TruncatedGaussian
from ksim_rl.testing import CounterEnv
from ksim_rl.transforms import DelayCfg, GaussianNoise, ObservationDelay, ObservationNoise
from tests.ranks.gloo import results

NUM_ENVS = 8


def draws(num_rows):
    """Return numbers of all kinds, each with the rows in its first dim."""
    torch.manual_seed(0)
    keys = random.row_keys(torch.tensor(3), random.stream_id("test"), torch.tensor(5), num_rows)
    flat = torch.linspace(-1.0, 1.0, 3).expand(num_rows, 3)
    bounds = {"low": torch.full((3,), -2.0), "high": torch.full((3,), 2.0)}
    drawn = {
        "uniform": random.uniform(keys, 3),
        "one": random.normal(keys, 1),
        "normal": random.normal(keys, 3),
        "integers": random.integers(keys, 3, 0, 10),
        "gaussian": DiagonalGaussian(flat, flat.exp()).sample(),
        "several": DiagonalGaussian(flat, flat.exp()).sample((4,)).movedim(1, 0),
        "truncated": TruncatedGaussian(flat, flat.exp(), **bounds).sample(),
        "categorical": Categorical(flat).sample(),
        "randint": ranks.randint(1000, (num_rows,)),
    }
    shared = random.row_keys(torch.tensor(3), 1, torch.tensor(5), 1, shared=True)
    return drawn | {"shared": random.uniform(shared, 3).expand(num_rows, 3)}


def env_states(num_rows):
    env = TransformedEnv(CounterEnv((5,) * num_rows))
    env.append_transform(ObservationNoise("drawn", noise=GaussianNoise(std=1.0)))
    env.append_transform(ObservationDelay("drawn", delay=DelayCfg(min_lag=0, max_lag=3)))
    env.set_seed(4)
    return env.rollout(12, break_when_any_done=False)["drawn"]


def everything(num_rows):
    return draws(num_rows) | {"env": env_states(num_rows)}


def test_each_rank_sees_the_numbers_of_its_rows_of_one_process(tmp_path):
    whole = everything(NUM_ENVS)
    parts = results(everything, NUM_ENVS // 2, size=2, folder=tmp_path)
    for name, expected in whole.items():
        found = torch.cat([part[name] for part in parts])
        assert torch.equal(found, expected), name
    assert not torch.equal(parts[0]["env"], parts[1]["env"])
