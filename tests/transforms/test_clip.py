import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.transforms import ClipTransform

from ksim_rl.transforms import ObservationClip
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
    ("clip", "low", "high"), [((-1.0, 0.5), 0.0, 0.5), ((0.25, None), 0.25, 1.0), ((2.0, 3.0), 2.0, 2.0)]
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
