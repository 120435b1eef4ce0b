import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Composite, Unbounded
from torchrl.envs.transforms import RenameTransform

from ksim_rl.envs.masked_transformed_env import MaskedTransformedEnv
from ksim_rl.testing import CounterEnv, check_env
from ksim_rl.transforms import (
    DelayCfg,
    GaussianNoise,
    HistoryCfg,
    ObservationClip,
    ObservationDelay,
    ObservationGroupCfg,
    ObservationGroups,
    ObservationHistory,
    ObservationNoise,
    ObservationScale,
    ObservationTermCfg,
    UniformNoise,
    group_specs,
    observation_columns,
)
from ksim_rl.transforms.groups.group_cfg import compile_groups
from tests.transforms.chains import assert_same, fixed_rollout


class TermEnv(CounterEnv):
    """The counter env with the key layout of our envs: every observation under "obs"."""

    def __init__(self):
        super().__init__((3, 5, 4))
        leaves = {name: Unbounded((3, 1)) for name in ("count", "episode", "row", "drawn")}
        leaves["vector"] = Unbounded((3, 3))
        self.observation_spec = Composite(obs=Composite(leaves, shape=(3,)), shape=(3,))

    def _observe(self):
        observed = super()._observe()
        leaves = {name: observed[name] for name in ("count", "episode", "row", "drawn")}
        leaves["vector"] = observed["obs"]["vector"]
        return {"obs": TensorDict(leaves, batch_size=3)}


def read(view):
    raise AssertionError("transforms read no term")


def term(**chain) -> ObservationTermCfg:
    return ObservationTermCfg(term=read, **chain)


GROUPS = {
    "actor": ObservationGroupCfg(
        terms={
            "vector": term(
                noise=GaussianNoise(std=0.1, bias=UniformNoise(low=-1.0, high=1.0)),
                clip=(-5.0, 150.0),
                scale=(1.0, 0.1, 0.01),
                delay=DelayCfg(max_lag=2),
                history=3,
            ),
            "row": term(),
            "count": term(noise=UniformNoise(low=-0.5, high=0.5), history=HistoryCfg(length=2)),
        }
    ),
    "critic": ObservationGroupCfg(terms={"count": term(), "vector": term(scale=0.5)}, keep_terms=True),
}  # fmt: skip


def by_hand():
    a, c = "actor_terms", "critic_terms"
    return [
        ObservationNoise(
            [("obs", "vector"), ("obs", "count")],
            [(a, "vector"), (a, "count")],
            noise=[
                GaussianNoise(std=0.1, bias=UniformNoise(low=-1.0, high=1.0)),
                UniformNoise(low=-0.5, high=0.5),
            ],
        ),
        ObservationClip([(a, "vector")], clip=(-5.0, 150.0)),
        ObservationScale([(a, "vector")], scale=(1.0, 0.1, 0.01)),
        ObservationDelay([(a, "vector")], delay=DelayCfg(max_lag=2)),
        ObservationHistory([(a, "count")], length=2),
        ObservationHistory([(a, "vector")], length=3),
        ObservationScale([("obs", "vector")], [(c, "vector")], scale=0.5),
        RenameTransform([("obs", "count")], [(c, "count")], create_copy=True),
        ObservationGroups(
            {
                "actor": [(a, "vector"), ("obs", "row"), (a, "count")],
                "critic": [("obs", "count"), (c, "vector")],
            },
            drop=[(a, "vector"), (a, "count")],
        ),
    ]


def test_config_and_hand_written_chain_give_identical_rollouts():
    envs = [MaskedTransformedEnv(TermEnv(), chain) for chain in (compile_groups(GROUPS), by_hand())]
    for env in envs:
        env.set_seed(2)
    ours, theirs = (fixed_rollout(env, 15) for env in envs)
    assert_same(ours, theirs)
    assert ours["actor"].shape == (3, 15, 9 + 1 + 2)


def test_delay_and_history_of_a_whole_group():
    """Terms without a delay of their own share one lag; those without a history of their own have the group's."""
    group = ObservationGroupCfg(
        terms={
            "count": term(),
            "row": term(delay=DelayCfg(min_lag=1, max_lag=1)),
            "vector": term(history=1),
        },
        delay=DelayCfg(max_lag=3),
        history=HistoryCfg(length=3, stride=2),
    )
    a = "actor_terms"
    by_hand = [
        ObservationDelay([("obs", "row")], [(a, "row")], delay=DelayCfg(min_lag=1, max_lag=1)),
        ObservationDelay(
            [("obs", "count"), ("obs", "vector")],
            [(a, "count"), (a, "vector")],
            delay=DelayCfg(max_lag=3),
        ),
        ObservationHistory([(a, "count"), (a, "row")], length=3, stride=2),
        ObservationGroups(
            {"actor": [(a, "count"), (a, "row"), (a, "vector")]},
            drop=[(a, "count"), (a, "row"), (a, "vector")],
        ),
    ]
    envs = [
        MaskedTransformedEnv(TermEnv(), chain)
        for chain in (compile_groups({"actor": group}), by_hand)
    ]
    for env in envs:
        env.set_seed(4)
    ours, theirs = (fixed_rollout(env, 15) for env in envs)
    assert_same(ours, theirs)
    assert ours["actor"].shape == (3, 15, 3 + 3 + 3)
    assert [group.num_frames(name) for name in group.terms] == [3, 3, 1]


def test_frames_of_a_whole_group_are_stacked():
    group = ObservationGroupCfg(
        terms={"count": term(), "vector": term(scale=0.5)}, history=HistoryCfg(length=3, flat=False)
    )
    env = MaskedTransformedEnv(TermEnv(), compile_groups({"actor": group}))
    check_env(env, num_steps=8)
    rollout_ET = fixed_rollout(env, 12)
    assert rollout_ET["actor"].shape == (3, 12, 3, 4)
    ages = torch.tensor([2, 1, 0])
    columns = group_specs(env)["actor"].slice("count")
    expected = (rollout_ET["obs", "count"] - ages).clamp(min=0)
    assert torch.equal(rollout_ET["actor"][..., columns].squeeze(-1), expected)


def test_the_columns_of_each_term_are_plain_data():
    env = MaskedTransformedEnv(TermEnv(), compile_groups(GROUPS))
    assert observation_columns(env) == {
        "actor": {"actor_terms/vector": [0, 9], "obs/row": [9, 10], "actor_terms/count": [10, 12]},
        "critic": {"obs/count": [0, 1], "critic_terms/vector": [1, 4]},
    }


def test_all_transforms_that_can_follow_the_level_that_is_given():
    level = torch.zeros(())
    terms = {
        "count": term(noise=UniformNoise(low=1.0, high=2.0, by_level=True)),
        "row": term(noise=UniformNoise(low=1.0, high=2.0)),
        "vector": term(delay=DelayCfg(max_lag=2, by_level=True)),
    }
    groups = {"actor": ObservationGroupCfg(terms=terms)}
    env = MaskedTransformedEnv(TermEnv(), compile_groups(groups, level=level))
    root = env.reset()
    noise = root["actor"][:, :2] - torch.cat([root["obs", "count"], root["obs", "row"]], dim=-1)
    assert bool((noise[:, 0] == 0).all()) and bool((noise[:, 1] >= 1).all())
    level.fill_(1.0)
    root = env.reset()
    assert bool((root["actor"][:, 0] >= 1).all())


def test_the_env_passes_all_checks():
    check_env(MaskedTransformedEnv(TermEnv(), compile_groups(GROUPS)), num_steps=8)


def test_kept_terms_are_what_the_vector_holds_and_others_are_gone():
    env = MaskedTransformedEnv(TermEnv(), compile_groups(GROUPS))
    root = env.reset()
    assert "actor_terms" not in root
    kept = root["critic_terms"]
    assert torch.equal(torch.cat([kept["count"], kept["vector"]], -1), root["critic"])
    assert torch.equal(root["obs", "vector"] * 0.5, kept["vector"])


def test_terms_without_a_chain_go_straight_into_the_vector():
    plain = ObservationGroupCfg(terms={"count": term(), "row": term()})
    assert [type(t) for t in compile_groups({"actor": plain, "critic": plain})] == [
        ObservationGroups
    ]


def test_noise_of_one_group_leaves_the_other_clean():
    noisy = ObservationGroupCfg(terms={"count": term(noise=UniformNoise(low=1.0, high=2.0))})
    clean = ObservationGroupCfg(terms=noisy.terms, enable_noise=False)
    root = MaskedTransformedEnv(
        TermEnv(), compile_groups({"actor": noisy, "critic": clean})
    ).reset()
    assert bool((root["actor"] >= 1).all())
    assert torch.equal(root["critic"], root["obs", "count"])


def test_two_noisy_groups_draw_apart():
    noisy = ObservationGroupCfg(terms={"count": term(noise=GaussianNoise(std=1.0))})
    root = MaskedTransformedEnv(
        TermEnv(), compile_groups({"actor": noisy, "critic": noisy})
    ).reset()
    assert not (root["actor"] == root["critic"]).any()


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: ObservationGroupCfg(terms={}), "terms"),
        (lambda: ObservationTermCfg(term=3), "term=3"),
        (lambda: term(clip=(1.0, 0.0)), "clip"),
        (lambda: term(scale=float("nan")), "scale"),
        (lambda: term(history=0), "history"),
        (lambda: term(history=HistoryCfg(length=0)), "length"),
        (lambda: term(history=HistoryCfg(length=2, stride=0)), "stride"),
        (lambda: term(history=HistoryCfg(length=2, flat=False)), "flat"),
        (lambda: ObservationGroupCfg(terms={"row": term()}, history=0), "history.length"),
        (lambda: term(noise=1.0), "noise"),
    ],
)
def test_wrong_configs_are_refused(build, message):
    with pytest.raises(ValueError, match=message):
        build()
