import pytest
import torch
from torchrl.data import Unbounded
from torchrl.envs.transforms import (
    CatFrames,
    Compose,
    FrameSkipTransform,
    StepCounter,
    Transform,
)

from ksim_rl.envs.masked_transformed_env import MaskedTransformedEnv
from ksim_rl.testing import CounterEnv
from ksim_rl.transforms import (
    DelayCfg,
    ObservationDelay,
    ObservationHistory,
    ObservationScale,
    stacked_frames,
)
from tests.transforms.chains import VECTOR, counter, fixed_rollout


@pytest.mark.parametrize("length", [1, 2, 4])
def test_frames_are_the_last_ones_oldest_first(length):
    env = counter(ObservationHistory("count", "frames", length=length), lengths=(3, 6, 1))
    rollout_ET = fixed_rollout(env, 14)
    for part in (rollout_ET, rollout_ET["next"]):
        for frame in range(length):
            age = length - 1 - frame
            assert torch.equal(
                part["frames"][..., frame : frame + 1], (part["count"] - age).clamp(min=0)
            )


@pytest.mark.parametrize(("length", "stride"), [(3, 2), (2, 5), (4, 3), (1, 4)])
def test_frames_are_a_stride_apart(length, stride):
    env = counter(
        ObservationHistory("count", "frames", length=length, stride=stride), lengths=(3, 11, 1, 40)
    )
    rollout_ET = fixed_rollout(env, 30)
    ages = torch.tensor([(length - 1 - frame) * stride for frame in range(length)])
    for part in (rollout_ET, rollout_ET["next"]):
        assert torch.equal(part["frames"], (part["count"] - ages).clamp(min=0))


def test_other_dtypes_and_shapes_have_a_history_too():
    class Seeing(CounterEnv):
        def __init__(self):
            super().__init__((3, 5, 4))
            spec = self.observation_spec.clone()
            spec["image"] = Unbounded((3, 2, 5), dtype=torch.uint8)
            spec["steps"] = Unbounded((3,), dtype=torch.int64)
            self.observation_spec = spec

        def _observe(self):
            image = (self.count_E[:, None, None] + torch.arange(10).reshape(2, 5)).to(torch.uint8)
            return super()._observe() | {"image": image, "steps": self.count_E.clone()}

    env = MaskedTransformedEnv(
        Seeing(),
        [
            ObservationHistory(["image", "steps"], ["images", "many"], length=3, flat=False),
            ObservationDelay(["image", "steps"], delay=DelayCfg(min_lag=1, max_lag=1)),
        ],
    )
    rollout_ET = fixed_rollout(env, 12)
    count = rollout_ET["count"].long()
    ages = (count - torch.tensor([2, 1, 0])).clamp(min=0)
    assert torch.equal(rollout_ET["many"], ages)
    pixels = ages[..., None, None] + torch.arange(10).reshape(2, 5)
    assert torch.equal(rollout_ET["images"], pixels.to(torch.uint8))
    assert torch.equal(rollout_ET["steps"], (count[..., 0] - 1).clamp(min=0))
    assert torch.equal(rollout_ET["image"], pixels[:, :, 1].to(torch.uint8))


def test_after_a_reset_all_frames_are_the_reset_observation():
    env = counter(ObservationHistory("drawn", "frames", length=5))
    root = env.reset()
    assert torch.equal(root["frames"], root["drawn"].expand(3, 5))


def test_stacked_and_flat_agree():
    env = counter(
        ObservationHistory([VECTOR], ["flat"], length=3),
        ObservationHistory([VECTOR], ["stacked"], length=3, flat=False),
    )
    rollout_ET = fixed_rollout(env, 9)
    assert rollout_ET["stacked"].shape == (3, 9, 3, 3)
    assert torch.equal(rollout_ET["stacked"].flatten(-2), rollout_ET["flat"])


def test_it_equals_catframes():
    """TorchRL's transform with padding "same" does the same, unless a part of the rows is reset by hand."""
    chain = Compose(
        ObservationHistory([VECTOR], ["ours"], length=4),
        CatFrames(4, -1, in_keys=[VECTOR], out_keys=["theirs"], padding="same"),
    )
    rollout_ET = fixed_rollout(counter(chain, stock=True), 15)
    assert torch.equal(rollout_ET["ours"], rollout_ET["theirs"])
    assert torch.equal(rollout_ET["next", "ours"], rollout_ET["next", "theirs"])


@pytest.mark.parametrize("flat", [True, False])
def test_observations_of_one_dtype_share_a_ring(flat):
    """The frames of each are those that a transform of its own gives."""
    together = ObservationHistory(
        [VECTOR, "drawn", "count"], ["a", "b", "c"], length=4, stride=2, flat=flat
    )
    alone = [
        ObservationHistory(key, f"{name}_alone", length=4, stride=2, flat=flat)
        for name, key in {"a": VECTOR, "b": "drawn", "c": "count"}.items()
    ]
    rollout_ET = fixed_rollout(counter(together, *alone), 15)
    assert sum(name.startswith("ring_") for name in together.state_dict()) == 1
    for name in "abc":
        assert torch.equal(rollout_ET["next", name], rollout_ET["next", f"{name}_alone"])
        assert torch.equal(rollout_ET[name], rollout_ET[f"{name}_alone"])


def test_what_it_gives_out_does_not_change_later():
    env = counter(ObservationHistory("count", "frames", length=3))
    root = env.reset()
    before = root["frames"].clone()
    env.step_and_maybe_reset(root.clone().set("action", torch.zeros(3, 2)))
    assert torch.equal(root["frames"], before)


def test_bounds_are_repeated():
    spec = counter(ObservationHistory("drawn", length=3)).observation_spec["drawn"]
    assert spec.shape == (3, 3)
    assert bool((spec.space.low == 0).all()) and bool((spec.space.high == 1).all())


@pytest.mark.parametrize("length", [0, -1, 2.0, True])
def test_wrong_lengths_are_refused(length):
    with pytest.raises(ValueError, match="length="):
        ObservationHistory("count", length=length)
    with pytest.raises(ValueError, match="stride="):
        ObservationHistory("count", length=2, stride=length)


class _Own(Transform):
    """A user's transform, which may write whatever it likes."""

    def _call(self, next_tensordict):
        return next_tensordict


@pytest.mark.parametrize(
    ("chain", "found"),
    [
        ([ObservationHistory("count", length=3, flat=False)], {"count": (2, 1, 0)}),
        ([_Own(), ObservationHistory([VECTOR], ["a"], length=2, flat=False)], {"a": (1, 0)}),
        ([ObservationHistory("count", length=3)], {}),
        ([ObservationHistory("count", length=3, stride=2, flat=False)], {"count": (4, 2, 0)}),
        # The newest frames of late or changed stacks are not the frames of the steps before.
        *(
            (
                [ObservationHistory(["count", "drawn"], length=2, flat=False), behind],
                {"drawn": (1, 0)},
            )
            for behind in (
                ObservationDelay("count", delay=DelayCfg(max_lag=1)),
                ObservationScale("count", scale=2.0),
            )
        ),
        ([ObservationHistory("count", length=3, flat=False), _Own()], {}),
        # Its steps are several of the history.
        ([ObservationHistory("count", length=3, flat=False), FrameSkipTransform(2)], {}),
        ([ObservationHistory("count", length=3, flat=False), StepCounter()], {"count": (2, 1, 0)}),
    ],
)
def test_only_stacks_that_nothing_changes_are_known_as_such(chain, found):
    env = counter(*(transform.clone() for transform in chain))
    assert stacked_frames(env) == found
    # Further inside of stock envs as well.
    outer = MaskedTransformedEnv(env, [ObservationScale("episode", scale=2.0)])
    assert stacked_frames(outer) == found
