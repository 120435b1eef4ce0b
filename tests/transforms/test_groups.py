import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import TransformedEnv
from torchrl.envs.transforms import CatTensors

from ksim_rl.testing import CounterEnv
from ksim_rl.transforms import ObservationGroups, ObservationHistory
from tests.transforms.chains import VECTOR, counter, fixed_rollout


def test_it_equals_cattensors():
    env = counter(
        ObservationGroups({"ours": [VECTOR, "count"]}),
        CatTensors([VECTOR, "count"], "theirs", del_keys=False, sort=False),
    )
    rollout_ET = fixed_rollout(env, 7)
    assert torch.equal(rollout_ET["ours"], rollout_ET["theirs"])


def test_terms_are_addressable_by_name():
    groups = ObservationGroups({"actor": ["count", VECTOR], "critic": ["row", "episode", "count"]})
    with pytest.raises(RuntimeError, match="once an env holds"):
        groups.slice("actor", "count")
    env = counter(groups)
    root = env.reset()
    for group, terms in {"actor": ["count", VECTOR], "critic": ["row", "episode", "count"]}.items():
        for term in terms:
            assert torch.equal(root[group][:, groups.slice(group, term)], root[term])
    assert groups.slice("actor", "vector") == groups.slice("actor", VECTOR) == slice(1, 4)
    assert groups.group_specs["actor"].as_dict() == {"count": [0, 1], "obs/vector": [1, 4]}
    assert groups.group_specs["actor"].size == root["actor"].shape[-1] == 4


def test_unknown_names_are_refused_with_near_ones():
    groups = ObservationGroups({"actor": ["count", VECTOR]})
    counter(groups).reset()
    with pytest.raises(ValueError, match="did you mean 'vector'"):
        groups.slice("actor", "vectr")
    with pytest.raises(ValueError, match="did you mean 'actor'"):
        groups.slice("aktor", "vector")


def test_dropped_terms_leave_data_and_specs():
    env = counter(ObservationGroups({"actor": [VECTOR, "count"]}, drop=[VECTOR]))
    root = env.reset()
    assert "obs" not in root and "count" in root
    assert "obs" not in env.observation_spec


def test_bounds_are_concatenated():
    spec = counter(ObservationGroups({"actor": ["drawn", "count"]})).observation_spec["actor"]
    assert spec.space.low[0].tolist() == [0.0, -torch.inf] and spec.space.high[0].tolist() == [
        1.0,
        torch.inf,
    ]


def test_samples_are_concatenated_too():
    td = TensorDict({"a": torch.ones(4), "b": torch.zeros(4, 2, 2)}, batch_size=4)
    assert ObservationGroups({"g": ["a", "b"]})(td)["g"].shape == (4, 5)


def test_bool_terms_become_numbers():
    td = TensorDict(
        {"a": torch.ones(4, 1), "touch": torch.ones(4, 2, dtype=torch.bool)}, batch_size=4
    )
    assert ObservationGroups({"g": ["a", "touch"]})(td)["g"].dtype == torch.float32


@pytest.mark.parametrize("groups", [{}, {"actor": []}, {"actor": ["a", "a"]}])
def test_wrong_groups_are_refused(groups):
    with pytest.raises(ValueError, match="groups"):
        ObservationGroups(groups)


def test_a_group_does_not_replace_the_observations():
    with pytest.raises(ValueError, match="rename the group"):
        counter(ObservationGroups({"obs": ["count"]})).output_spec  # noqa: B018


@pytest.mark.parametrize(
    ("transform", "advice"),
    [
        (ObservationGroups({"actor": ["count", "rgb"]}), "read it by an encoder"),
        (ObservationHistory("rgb", length=2), "flat=False"),
    ],
)
def test_pictures_are_not_flattened(transform, advice):
    env = TransformedEnv(CounterEnv(picture=(4, 5, 3)), transform)
    with pytest.raises(ValueError, match=rf"'rgb' is a picture, uint8 \[4, 5, 3\].*{advice}"):
        env.observation_spec  # noqa: B018 (making the specs is what checks)
