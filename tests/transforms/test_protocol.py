"""Every transform against what TorchRL checks of transforms, on envs of thirteen shapes; see `protocol`."""

from collections import Counter

import pytest
import torch
from torchrl.data import Binary, Composite
from torchrl.envs import TransformedEnv

from ksim_rl.transforms import (
    ActionScale,
    EpisodeTracker,
    Mirror,
    ObservationScale,
    TimeAwareObservation,
)
from tests.transforms.leaf_env import LeafEnv
from tests.transforms.portable import exported_transforms
from tests.transforms.protocol import (
    CHECKS,
    KINDS,
    PARALLEL,
    SHAPES,
    SHORT,
    TURNED,
    is_refused,
    outcome,
    transformed,
)

QUICK = (
    "specs_alone",
    "reset_and_steps",
    "samples_alone",
    "samples_from_a_buffer",
    "inverse_of_samples",
)


def shapes_of(check, *, short):
    if check in PARALLEL:
        return ("rows", "agents")
    return SHORT if short else tuple(SHAPES)


def run(check, kind, shapes):
    counts = Counter(outcome(check, kind, shape) for shape in shapes)
    print(f"{check}, {kind}: {dict(counts)}")
    assert counts["refused"] + counts["not asked"] == sum(
        is_refused(kind, shape) for shape in shapes
    )
    assert sum(counts.values()) == len(shapes)


def test_no_transform_is_left_out():
    assert {kind.split(" ")[0] for kind in KINDS} == exported_transforms()
    assert len(SHORT) >= 6 and set(SHORT) <= set(SHAPES)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("check", QUICK)
def test_short_form(check, kind):
    run(check, kind, shapes_of(check, short=True))


@pytest.mark.full
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("check", CHECKS)
def test_long_form(check, kind):
    run(check, kind, shapes_of(check, short=False))


@pytest.mark.parametrize("kind", [kind for kind in KINDS if is_refused(kind, "whole")])
def test_a_refusal_names_transform_key_and_dtype(kind):
    env = transformed(kind, "whole")
    with pytest.raises(
        ValueError, match=rf"^{kind.split(' ')[0]}: '(x|action)' is torch.int64: expected floating"
    ):
        env.output_spec, env.input_spec  # noqa: B018


@pytest.mark.parametrize(
    ("transform", "message"),
    [
        (lambda: Mirror("x", maps={"x": TURNED}, in_keys_inv=[]), "the map of 'x' has 3 columns for shape \\(\\)"),
        (lambda: ObservationScale("x", scale=(1.0, 2.0, 3.0)), "'x' has 3 numbers, but the .* has shape \\(\\)"),
        (lambda: ActionScale(scale=(1.0, 2.0, 3.0)), "scale has 3 numbers, but the action 'action' has shape \\(\\)"),
    ],
)  # fmt: skip
def test_rows_are_no_columns(transform, message):
    """Three envs with a number each are not an env with three numbers."""
    env = TransformedEnv(LeafEnv((3,), (), action_leaf=()), transform())
    with pytest.raises(ValueError, match=message):
        env.output_spec, env.input_spec  # noqa: B018


def test_a_key_among_agents_needs_their_batch_size():
    env = TransformedEnv(
        LeafEnv((3,), agents=True), TimeAwareObservation(("agents", "clock"), horizon=3)
    )
    with pytest.raises(
        ValueError, match=r"\('agents', 'clock'\) lies in a TensorDict of batch size \(3, 2\)"
    ):
        env.output_spec  # noqa: B018


def test_rewards_that_are_flags_are_no_returns():
    env = LeafEnv((3,))
    env.full_reward_spec = Composite(
        reward=Binary(1, shape=torch.Size([3, 1]), dtype=torch.bool), shape=[3]
    )
    with pytest.raises(
        ValueError, match="EpisodeTracker: 'reward' is torch.bool: expected numbers"
    ):
        TransformedEnv(env, EpisodeTracker()).output_spec  # noqa: B018
