import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.transforms import ClipTransform, ObservationNorm

from ksim_rl.transforms import ObservationClip, ObservationScale
from tests.transforms.chains import VECTOR, counter, fixed_rollout


@pytest.mark.parametrize("clip", [(1.0, 102.0), (None, 150.0), (2.0, None)])
def test_it_equals_torchrls_clip(clip):
    env = counter(
        ObservationClip(VECTOR, "ours", clip=clip),
        ClipTransform([VECTOR], ["theirs"], low=clip[0], high=clip[1]),
    )
    rollout_ET = fixed_rollout(env, 8)
    assert torch.equal(rollout_ET["ours"], rollout_ET["theirs"])
    assert not torch.equal(rollout_ET["ours"], rollout_ET[VECTOR])


@pytest.mark.parametrize(
    ("clip", "low", "high"),
    [((-1.0, 0.5), 0.0, 0.5), ((0.25, None), 0.25, 1.0), ((2.0, 3.0), 2.0, 2.0)],
)
def test_bounds_are_narrowed(clip, low, high):
    spec = counter(ObservationClip("drawn", clip=clip)).observation_spec["drawn"]
    assert (spec.space.low[0].item(), spec.space.high[0].item()) == (low, high)


def test_nan_stays_visible_and_samples_are_clipped_too():
    td = ObservationClip("x", clip=(0.0, 1.0))(
        TensorDict({"x": torch.tensor([torch.nan, 2.0, -1.0])}, batch_size=3)
    )
    assert torch.isnan(td["x"][0]) and td["x"][1:].tolist() == [1.0, 0.0]


@pytest.mark.parametrize(
    "clip", [(1.0, 0.0), (None, None), (0.0,), 3.0, (0.0, float("inf")), {"b": (0.0, 1.0)}]
)
def test_wrong_ranges_are_refused(clip):
    with pytest.raises(ValueError, match="clip"):
        ObservationClip("a", clip=clip)


@pytest.mark.parametrize("scale", [0.25, (1.0, -2.0, 0.0)])
def test_it_equals_torchrls_norm_without_an_offset(scale):
    factor = torch.tensor(scale)
    env = counter(
        ObservationScale(VECTOR, "ours", scale=scale),
        ObservationNorm(
            loc=torch.zeros_like(factor), scale=factor, in_keys=[VECTOR], out_keys=["theirs"]
        ),
    )
    rollout_ET = fixed_rollout(env, 8)
    assert torch.equal(rollout_ET["ours"], rollout_ET["theirs"])


def test_bounds_are_scaled_and_turned():
    spec = counter(ObservationScale("drawn", scale=-2.0)).observation_spec["drawn"]
    assert (spec.space.low[0].item(), spec.space.high[0].item()) == (-2.0, 0.0)


def test_an_unbounded_observation_times_zero_is_bounded():
    spec = counter(ObservationScale(VECTOR, scale=(1.0, 0.0, 1.0))).observation_spec[VECTOR]
    assert spec.space.low[0].tolist() == [-torch.inf, 0.0, -torch.inf]


def test_samples_are_scaled_too():
    td = ObservationScale("x", scale=3.0)(TensorDict({"x": torch.ones(2, 1)}, batch_size=2))
    assert td["x"].tolist() == [[3.0], [3.0]]


@pytest.mark.parametrize("scale", [float("nan"), "2", (1.0, float("inf")), {"b": 1.0}])
def test_wrong_factors_are_refused(scale):
    with pytest.raises(ValueError, match="scale"):
        ObservationScale("a", scale=scale)


def test_a_wrong_number_of_factors_is_refused():
    with pytest.raises(ValueError, match="has 2 numbers"):
        counter(ObservationScale(VECTOR, scale=(1.0, 2.0))).output_spec  # noqa: B018
