"""Transforms in replay buffers: alike however they join, and no stored action changes."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, ReplayBuffer, TensorDictReplayBuffer
from torchrl.envs import TransformedEnv
from torchrl.envs.transforms import Compose

from ksim_rl.testing import CounterEnv
from ksim_rl.transforms import ActionDelay, ActionLowPass, Mirror
from tests.transforms.chains import assert_same
from tests.transforms.portable import PORTABLE
from tests.transforms.test_every_transform import samples, with_statistics
from tests.transforms.transform_checks import has_episodes

every_class = pytest.mark.parametrize("name", PORTABLE)
every_buffer = pytest.mark.parametrize("kind", [ReplayBuffer, TensorDictReplayBuffer])


def build(name):
    torch.manual_seed(0)
    return with_statistics(PORTABLE[name]("x"))


def buffer(kind, transform, how):
    """Return an empty buffer with a transform, joined in one of the ways."""
    storage = {"storage": LazyTensorStorage(8), "batch_size": 8}
    if how == "constructor":
        return kind(transform=transform, **storage)
    if how == "compose":
        return kind(transform=Compose(transform), **storage)
    found = kind(**storage)
    found.insert_transform(0, transform) if how == "insert" else found.append_transform(transform)
    return found


WAYS = ("constructor", "compose", "append", "insert")


@every_buffer
@every_class
def test_every_way_to_join_a_transform_gives_the_same(kind, name):
    """The stored data are those that were given; what is sampled, or the refusal, is the same in each way."""
    found, refusals = [], []
    for how in WAYS:
        torch.manual_seed(0)
        joined = buffer(kind, build(name), how)
        try:
            joined.extend(samples())
            stored = joined._storage.get(slice(None)).select("x", "action", "reward")
            assert_same(stored, samples())
            sampled = joined.sample()
            found.append(
                sampled[sampled["index"].argsort()] if "index" in sampled.keys() else sampled
            )
        except RuntimeError as error:
            refusals.append(str(error))
    transform = PORTABLE[name]("x")
    if has_episodes(transform):
        expected = f"{name} has state per env: use it in an env, not on a batch of samples"
        assert refusals == [expected] * len(WAYS) and not found
        return
    assert not refusals
    for other in found[1:]:
        if "index" in found[0].keys():
            assert_same(other, found[0])
        else:
            assert set(other.keys()) == set(found[0].keys())
            for key in found[0].keys():
                assert torch.equal(
                    *(td[key].flatten(1).sum(1).sort().values for td in (other, found[0]))
                ), key


@every_class
def test_one_sample_is_added_as_it_is(name):
    joined = buffer(ReplayBuffer, build(name), "constructor")
    if has_episodes(PORTABLE[name]("x")):
        with pytest.raises(RuntimeError, match="^[A-Za-z]* has state per env: [^.]*$"):
            joined.add(samples()[0])
        return
    joined.add(samples()[0])
    assert_same(joined._storage.get(slice(None)).select("x", "action", "reward"), samples()[:1])


@pytest.mark.parametrize(
    "build_one",
    [
        lambda: PORTABLE["ActionDelay"]("x"),
        lambda: PORTABLE["ActionLowPass"]("x"),
        lambda: PORTABLE["ActionScale"]("x"),
        lambda: PORTABLE["ActionClip"]("x"),
    ],
    ids=["ActionDelay", "ActionLowPass", "ActionScale", "ActionClip"],
)
def test_what_an_env_has_made_ready_changes_no_stored_action_either(build_one):
    transform = build_one()
    env = TransformedEnv(CounterEnv((3,) * 8, action_size=1), transform)
    env.rollout(2)
    joined = buffer(ReplayBuffer, transform.clone(), "constructor")
    if isinstance(transform, ActionDelay | ActionLowPass | Mirror):
        with pytest.raises(RuntimeError, match="has state per env"):
            joined.extend(samples())
    else:
        joined.extend(samples())
        assert torch.equal(joined._storage.get(slice(None))["action"], samples()["action"])
    # The one in the env goes on.
    env.rollout(2)


OUTWARD = [
    "ObservationNoise",
    "ObservationClip",
    "ObservationScale",
    "ObservationNormalization",
    "ObservationGroups",
]


@pytest.mark.parametrize("name", OUTWARD)
@pytest.mark.parametrize("how", ["alone", "constructor"])
def test_samples_without_the_key_are_refused_in_a_sentence(name, how):
    transform = with_statistics(PORTABLE[name]("x"))
    other = samples().rename_key_("x", "observed_x")
    with pytest.raises(KeyError, match=f"{name}: the samples have no 'x': .*observed_x"):
        if how == "alone":
            transform(other)
        else:
            joined = buffer(ReplayBuffer, transform, how)
            joined.extend(other)
            joined.sample()


@pytest.mark.parametrize(
    "name", ["ObservationNoise", "ObservationClip", "ObservationScale", "ObservationNormalization"]
)
@pytest.mark.parametrize("dtype", [torch.int64, torch.bool])
def test_samples_of_other_dtypes_are_refused_in_a_sentence(name, dtype):
    batch = TensorDict({"x": torch.ones(8, 3, dtype=dtype)}, batch_size=8)
    with pytest.raises(
        ValueError, match=f"{name}: 'x' is {dtype}: expected floating-point values$"
    ):
        with_statistics(PORTABLE[name]("x"))(batch)


def test_statistics_that_are_not_there_are_asked_for():
    joined = buffer(ReplayBuffer, PORTABLE["ObservationNormalization"]("x"), "append")
    joined.extend(samples())
    with pytest.raises(
        RuntimeError,
        match="^there are no statistics yet: an env, or `load_state_dict`, gives them$",
    ):
        joined.sample()
