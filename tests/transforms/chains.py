"""Envs and chains that several tests share."""

from collections.abc import Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.transforms import Compose, Transform

from ksim_rl.envs.masked_transformed_env import MaskedTransformedEnv
from ksim_rl.testing import CounterEnv
from ksim_rl.transforms import (
    ActionDelay,
    DelayCfg,
    GaussianNoise,
    ObservationClip,
    ObservationDelay,
    ObservationGroups,
    ObservationHistory,
    ObservationNoise,
    ObservationScale,
    UniformNoise,
)
from ksim_rl.transforms.row_transform import KeyedTransform, held_transforms

VECTOR = ("obs", "vector")
NOISY, COUNT, DRAWN = (("actor_terms", name) for name in ("vector", "count", "drawn"))


def full_chain() -> list[Transform]:
    """Return one transform of each kind, with draws in steps and at resets, per env and shared."""
    return [
        ActionDelay(delay=DelayCfg(max_lag=2, resample_every=2, hold_probability=0.3)),
        ObservationNoise(
            [VECTOR, "count", "drawn"],
            [NOISY, COUNT, DRAWN],
            noise=[
                GaussianNoise(std=0.1, bias=UniformNoise(low=-1.0, high=1.0)),
                UniformNoise(low=-0.5, high=0.5),
                UniformNoise(low=0.5, high=1.5, operation="multiply"),
            ],
        ),
        ObservationClip([NOISY], clip=(-50.0, 150.0)),
        ObservationScale([NOISY], scale=(1.0, 2.0, 3.0)),
        ObservationDelay([NOISY], delay=DelayCfg(min_lag=1, max_lag=3, resample_every=3)),
        ObservationDelay([COUNT], delay=DelayCfg(max_lag=3, per_env=False, resample_every=3)),
        ObservationHistory([NOISY, DRAWN], length=3),
        ObservationGroups(
            {"actor": [NOISY, COUNT, DRAWN], "critic": ["count", "episode"]},
            drop=[NOISY, COUNT, DRAWN],
        ),
    ]


def counter(
    *transforms: Transform, lengths: Sequence[int] = (3, 5, 4), stock: bool = False
) -> TransformedEnv:
    """Return a counter env with transforms, in our transformed env or in TorchRL's."""
    wrapper = TransformedEnv if stock else MaskedTransformedEnv
    return wrapper(CounterEnv(lengths), Compose(*transforms))


def seed_all(env: TransformedEnv, seed: int) -> None:
    """Seed env and transforms, in a stock env too, which reaches only itself."""
    env.set_seed(seed)
    for transform in held_transforms(env, KeyedTransform):
        transform.seed_(seed)


def actions(num_steps: int, env: EnvBase) -> Tensor:
    """Return fixed actions [T, E, A]."""
    generator = torch.Generator().manual_seed(7)
    return (
        torch.rand((num_steps, *env.full_action_spec[env.action_key].shape), generator=generator)
        * 2
        - 1
    )


def fixed_rollout(
    env: EnvBase, num_steps: int, root: TensorDictBase | None = None
) -> TensorDictBase:
    """Roll out with the fixed actions, from `root` or from a reset."""
    steps = iter(actions(num_steps, env))
    return env.rollout(
        num_steps,
        lambda td: td.set("action", next(steps)),
        break_when_any_done=False,
        auto_reset=root is None,
        tensordict=root,
    )


def assert_same(
    found: TensorDictBase, expected: TensorDictBase, rows: Sequence[int] | None = None
) -> None:
    """Check that two data agree bit for bit, in all rows or in some."""
    assert set(found.keys(True, True)) == set(expected.keys(True, True))
    for key, value in expected.items(True, True):
        ours, theirs = (
            (found[key], value) if rows is None else (found[key][list(rows)], value[list(rows)])
        )
        assert torch.equal(ours, theirs), (key, ours, theirs)


def copied(td: TensorDictBase) -> TensorDict:
    """Return the values as they are now."""
    return TensorDict(
        {key: value.clone() for key, value in td.items(True, True)}, batch_size=td.batch_size
    )
