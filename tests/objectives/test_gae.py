import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.objectives import ClipPPOLoss as StockClipPPOLoss
from torchrl.objectives import value

from ksim_rl.objectives import GAE, TDLambda, rollout_estimator
from ksim_rl.testing import count_syncs
from tests.objectives.problems import networks, rollout

GAMMA, LMBDA = 0.97, 0.9
OUT_KEYS = ("advantage", "value_target", "state_value", ("next", "state_value"))


def _stock(critic, data, **options):
    gae = value.GAE(
        gamma=GAMMA, lmbda=LMBDA, value_network=critic, vectorized=False, time_dim=1, **options
    )
    with torch.no_grad():
        return gae(data.clone())


@pytest.mark.parametrize("kind", [GAE, TDLambda])
def test_value_targets_of_another_lambda_are_those_of_an_estimator_with_it(kind):
    actor, critic = networks()
    data = rollout(actor, num_envs=16, length=12, end_probability=0.15)
    out = kind(gamma=GAMMA, lmbda=LMBDA, value_lmbda=1.0, critic=critic)(data.clone())
    plain = kind(gamma=GAMMA, lmbda=LMBDA, critic=critic)(data.clone())
    monte_carlo = kind(gamma=GAMMA, lmbda=1.0, critic=critic)(data.clone())
    assert torch.equal(out["advantage"], plain["advantage"])
    assert torch.equal(out["value_target"], monte_carlo["value_target"])
    assert not torch.allclose(out["value_target"], plain["value_target"], atol=0.01)


def test_monte_carlo_targets_are_the_discounted_rewards_up_to_the_end():
    data = _known(
        [1.0, 2.0, 3.0, 4.0], values=[9.0] * 4, next_values=[9.0, 9.0, 9.0, 5.0], terminated=[1]
    )
    out = GAE(gamma=0.5, lmbda=0.3, value_lmbda=1.0, critic=_critic())(data)
    # The rollout's end is no episode's: there the value 5 stands for what follows.
    expected = [1.0 + 0.5 * 2.0, 2.0, 3.0 + 0.5 * (4.0 + 0.5 * 5.0), 4.0 + 0.5 * 5.0]
    torch.testing.assert_close(out["value_target"].flatten(), torch.tensor(expected))


@pytest.mark.parametrize("normalize", [False, True])
@pytest.mark.parametrize("end_probability", [0.0, 0.15, 0.5])
def test_equals_stock_torchrl(end_probability, normalize):
    actor, critic = networks()
    data = rollout(actor, num_envs=16, length=12, end_probability=end_probability)
    expected = _stock(critic, data, average_gae=normalize)
    gae = GAE(gamma=GAMMA, lmbda=LMBDA, critic=critic, normalize_advantage=normalize)
    out = gae(data)
    assert out is data
    for key in OUT_KEYS:
        torch.testing.assert_close(out[key], expected[key], atol=1e-6, rtol=1e-6)
        assert not out[key].requires_grad


def test_a_critic_reads_no_more_numbers_at_a_time_than_fit(monkeypatch):
    actor, critic = networks()
    data = rollout(actor, num_envs=5, length=7)
    gae = GAE(gamma=GAMMA, lmbda=LMBDA, critic=critic)
    expected = gae(data.clone())
    rows = []
    critic.register_forward_pre_hook(lambda _, inputs: rows.append(inputs[0].numel()))
    numbers = sum(data[key].shape[-1] for key in critic.in_keys)
    # Eleven rows and a part of one more: 35 rows are 11, 11, 11 and 2, now and for what follows.
    monkeypatch.setattr(rollout_estimator, "MOST_NUMBERS", 12 * numbers - 1)
    found = gae(data.clone())
    assert rows == [11, 11, 11, 2] * 2
    for key in OUT_KEYS:
        torch.testing.assert_close(found[key], expected[key])


def test_memory_layout_names_and_time_dim_do_not_matter():
    actor, critic = networks()
    data = rollout(actor)
    gae = GAE(gamma=GAMMA, lmbda=LMBDA, critic=critic)
    expected = gae(data.clone())
    time_major = data.transpose(0, 1).contiguous()
    layouts = {
        "transposed view": (time_major.transpose(0, 1), -1),
        "time first": (time_major, 0),
        "names": (data.clone().refine_names(..., "T"), 1),
    }
    layouts["names"][0].names = ["time", "E"]
    for name, (layout, time_dim) in layouts.items():
        out = gae(layout, time_dim=time_dim)
        for key in OUT_KEYS:
            leaf = out[key].transpose(0, 1) if time_dim == 0 else out[key]
            torch.testing.assert_close(
                leaf, expected[key], msg=lambda text, name=name: f"{name}: {text}"
            )


def test_without_a_critic_values_come_from_the_data():
    actor, critic = networks()
    data = _stock(critic, rollout(actor))
    expected = data.select("advantage", "value_target")
    out = GAE(gamma=GAMMA, lmbda=LMBDA)(data.exclude("advantage", "value_target"))
    torch.testing.assert_close(out["advantage"], expected["advantage"])
    torch.testing.assert_close(out["value_target"], expected["value_target"])


class _ValueIs(torch.nn.Module):
    """A critic whose value is the first number of the observation."""

    def forward(self, obs):
        return obs[..., :1]


def _known(rewards, values, next_values, *, terminated=(), truncated=()):
    length = len(rewards)
    flags = {
        name: torch.zeros(1, length, 1, dtype=torch.bool) for name in ("terminated", "truncated")
    }
    for step in terminated:
        flags["terminated"][0, step] = True
    for step in truncated:
        flags["truncated"][0, step] = True
    column = lambda numbers: torch.tensor(numbers, dtype=torch.float32).view(1, length, 1)  # noqa: E731
    following = {"obs": column(next_values), "reward": column(rewards)}
    following |= flags | {"done": flags["terminated"] | flags["truncated"]}
    return TensorDict(
        {"obs": column(values), "next": TensorDict(following, [1, length])}, [1, length]
    )


def _critic():
    return TensorDictModule(_ValueIs(), in_keys=["obs"], out_keys=["state_value"])


def test_constant_reward_with_the_right_critic_has_no_advantage():
    true_value = 1.0 / (1.0 - GAMMA)
    data = _known([1.0] * 5, [true_value] * 5, [true_value] * 5, truncated=[2])
    out = GAE(gamma=GAMMA, lmbda=LMBDA, critic=_critic())(data)
    torch.testing.assert_close(out["advantage"], torch.zeros(1, 5, 1), atol=1e-4, rtol=0.0)
    torch.testing.assert_close(out["value_target"], torch.full((1, 5, 1), true_value))


def test_truncation_bootstraps_from_the_true_terminal_observation_and_termination_from_zero():
    # The root observation after the end (value 100) belongs to the next episode and must not matter.
    values, next_values = [1.0, 2.0, 100.0], [2.0, 7.0, 3.0]
    for flags, bootstrap in (({"truncated": [1]}, 7.0), ({"terminated": [1]}, 0.0)):
        out = GAE(gamma=0.5, lmbda=1.0, critic=_critic())(
            _known([1.0, 1.0, 1.0], values, next_values, **flags)
        )
        returns = [1.0 + 0.5 * (1.0 + 0.5 * bootstrap), 1.0 + 0.5 * bootstrap, 1.0 + 0.5 * 3.0]
        torch.testing.assert_close(out["value_target"].flatten(), torch.tensor(returns))
        torch.testing.assert_close(
            out["advantage"].flatten(), torch.tensor(returns) - torch.tensor(values)
        )


def test_a_step_that_is_both_terminated_and_truncated_counts_as_terminated():
    out = GAE(gamma=0.5, lmbda=1.0, critic=_critic())(
        _known([1.0], [0.0], [9.0], terminated=[0], truncated=[0])
    )
    assert out["value_target"].item() == 1.0


def test_lambda_zero_is_the_one_step_error_and_one_the_return():
    rewards, values, next_values = [1.0, 2.0, 3.0], [0.5, 0.25, 0.125], [0.25, 0.125, 4.0]
    one_step = [
        r + GAMMA * v_next - v for r, v, v_next in zip(rewards, values, next_values, strict=True)
    ]
    out = GAE(gamma=GAMMA, lmbda=0.0, critic=_critic())(_known(rewards, values, next_values))
    torch.testing.assert_close(out["advantage"].flatten(), torch.tensor(one_step))
    out = GAE(gamma=GAMMA, lmbda=1.0, critic=_critic())(_known(rewards, values, next_values))
    full = 1.0 + GAMMA * (2.0 + GAMMA * (3.0 + GAMMA * 4.0))
    assert out["value_target"].flatten()[0].item() == pytest.approx(full, rel=1e-6)


def test_a_reward_that_is_not_finite_marks_its_step_only():
    actor, critic = networks()
    data = rollout(actor, num_envs=4, length=5, end_probability=0.0)
    clean = data.clone()
    data["next", "reward"][1, 2] = float("nan")
    gae = GAE(gamma=GAMMA, lmbda=LMBDA, critic=critic)
    out, expected = gae(data), gae(clean.clone())
    assert out["advantage"].isnan().sum() == 1
    assert out["advantage"][1, 2].isnan()
    # Later steps and other envs do not notice; earlier ones bootstrap from V at the bad step.
    torch.testing.assert_close(out["advantage"][1, 3:], expected["advantage"][1, 3:])
    torch.testing.assert_close(out["advantage"][[0, 2, 3]], expected["advantage"][[0, 2, 3]])
    values = expected["state_value"]
    delta = (
        clean["next", "reward"][1, 1] + GAMMA * expected["next", "state_value"][1, 1] - values[1, 1]
    )
    torch.testing.assert_close(out["advantage"][1, 1], delta)


def test_a_terminal_observation_that_is_not_finite_does_not_matter():
    data = _known([1.0, 1.0], [0.5, 0.25], [0.25, float("nan")], terminated=[1])
    out = GAE(gamma=0.5, lmbda=1.0, critic=_critic())(data)
    torch.testing.assert_close(out["advantage"].flatten(), torch.tensor([1.5 - 0.5, 1.0 - 0.25]))


def test_normalization_is_over_the_finite_advantages_of_the_dataset():
    actor, critic = networks()
    data = rollout(actor, num_envs=16, length=12)
    raw = GAE(gamma=GAMMA, lmbda=LMBDA, critic=critic)(data.clone())
    data["next", "reward"][0, 3] = float("inf")
    out = GAE(gamma=GAMMA, lmbda=LMBDA, critic=critic, normalize_advantage=True)(data)
    finite = out["advantage"].isfinite()
    assert int((~finite).sum()) == 1
    advantage = out["advantage"][finite]
    assert advantage.mean().item() == pytest.approx(0.0, abs=1e-5)
    assert advantage.std().item() == pytest.approx(1.0, abs=1e-5)
    torch.testing.assert_close(out["value_target"][1:], raw["value_target"][1:])


def test_advantages_below_the_least_standard_deviation_are_divided_by_it():
    actor, critic = networks()
    data = rollout(actor, num_envs=16, length=12)
    raw = GAE(gamma=GAMMA, lmbda=LMBDA, critic=critic)(data.clone())["advantage"]
    options = {"normalize_advantage": True, "min_advantage_std": 2.0 * raw.std().item()}
    scaled = GAE(gamma=GAMMA, lmbda=LMBDA, critic=critic, **options)(data)["advantage"]
    torch.testing.assert_close(scaled, (raw - raw.mean()) / (2.0 * raw.std()))


def test_advantages_that_are_all_alike_stay_finite():
    data = _known([1.0], [0.0], [0.0], terminated=[0])
    out = GAE(gamma=0.5, lmbda=1.0, critic=_critic(), normalize_advantage=True)(data)
    assert out["advantage"].item() == 0.0


def test_serves_stock_losses_as_value_estimator():
    actor, critic = networks()
    data = rollout(actor)
    loss = StockClipPPOLoss(actor, critic)
    loss.make_value_estimator(GAE(gamma=GAMMA, lmbda=LMBDA, critic=critic))
    from_estimator = loss(data.clone())["loss_critic"]
    from_data = loss(_stock(critic, data))["loss_critic"]
    torch.testing.assert_close(from_estimator, from_data)
    target = loss.value_estimator.value_estimate(data)
    torch.testing.assert_close(target, _stock(critic, data)["value_target"])
    assert "advantage" not in data


def test_keys_can_be_renamed():
    actor, critic = networks()
    gae = GAE(gamma=GAMMA, lmbda=LMBDA, critic=critic)
    gae.set_keys(advantage="gain", reward="score")
    data = rollout(actor)
    expected = _stock(critic, data)["advantage"]
    data["next"].rename_key_("reward", "score")
    torch.testing.assert_close(gae(data)["gain"], expected)


@pytest.mark.parametrize("normalize", [pytest.param(False, marks=pytest.mark.full), True])
def test_no_host_sync_and_no_compiler_break(normalize):
    actor, critic = networks()
    data = rollout(actor)
    gae = GAE(gamma=GAMMA, lmbda=LMBDA, critic=critic, normalize_advantage=normalize)
    with count_syncs() as syncs:
        expected = gae(data.clone())
    assert syncs.total == 0, syncs.report()
    compiled = torch.compile(gae, fullgraph=True, backend="aot_eager")
    torch.testing.assert_close(compiled(data.clone())["advantage"], expected["advantage"])


def test_refusals_name_the_signal():
    actor, critic = networks()
    gae = GAE(gamma=GAMMA, lmbda=LMBDA, critic=critic)
    with pytest.raises(ValueError, match="'reward'.*None"):
        gae(rollout(actor).exclude(("next", "reward")))
    with pytest.raises(ValueError, match=r"'reward'\) \(8, 6\)"):
        data = rollout(actor)
        gae(data.set(("next", "reward"), data["next", "reward"].squeeze(-1)))
    # Flags of another shape would spread over values: [3, 3] with [3, 3, 1] gives [3, 3, 3].
    for terminated in (torch.zeros(3, 3, dtype=torch.bool), torch.zeros(3, 3, 2, dtype=torch.bool)):
        data = rollout(actor, num_envs=3, length=3)
        shape = ", ".join(map(str, terminated.shape))
        with pytest.raises(ValueError, match=rf"'terminated'\) \({shape}\)"):
            gae(data.set(("next", "terminated"), terminated))
    with pytest.raises(ValueError, match="time_dim=2.*2 batch dims"):
        gae(rollout(actor), time_dim=2)


# -- options of TorchRL's estimators -----------------------------------------------------------------------------


def test_the_estimator_of_torchrls_tutorial_is_made_as_it_stands():
    actor, critic = networks()
    data = rollout(actor, num_envs=16, length=12, end_probability=0.15)
    expected = _stock(critic, data, average_gae=True)
    out = GAE(
        gamma=GAMMA, lmbda=LMBDA, value_network=critic, average_gae=True, device=torch.device("cpu")
    )(data)
    torch.testing.assert_close(out["advantage"], expected["advantage"], atol=1e-6, rtol=1e-6)


@pytest.mark.parametrize("names", [None, ("time", "E")])
def test_without_a_time_dim_it_is_the_one_of_that_name_or_the_last(names):
    actor, critic = networks()
    data = rollout(actor, num_envs=5, length=7, end_probability=0.2)
    data.names = names
    stock = value.GAE(gamma=GAMMA, lmbda=LMBDA, value_network=critic, vectorized=False)
    with torch.no_grad():
        expected = stock(data.clone())
    out = GAE(gamma=GAMMA, lmbda=LMBDA, critic=critic, time_dim=None)(data.clone())
    torch.testing.assert_close(out["advantage"], expected["advantage"], atol=1e-6, rtol=1e-6)
    other = GAE(gamma=GAMMA, lmbda=LMBDA, critic=critic, time_dim=1 if names else 0)(data.clone())
    assert not torch.allclose(out["advantage"], other["advantage"])


def test_values_that_are_there_are_kept_if_asked():
    actor, critic = networks()
    data = rollout(actor)
    data.set("state_value", torch.full((*data.batch_size, 1), 2.0))
    kept = GAE(gamma=GAMMA, lmbda=LMBDA, critic=critic, skip_existing=True)(data.clone())
    assert (kept["state_value"] == 2.0).all()
    fresh = GAE(gamma=GAMMA, lmbda=LMBDA, critic=critic)(data.clone())
    assert not (fresh["state_value"] == 2.0).any()
    torch.testing.assert_close(kept["next", "state_value"], fresh["next", "state_value"])
    delta = data["next", "reward"] + GAMMA * kept["next", "state_value"] - 2.0
    short = GAE(gamma=GAMMA, lmbda=0.0, critic=critic, skip_existing=True)(data.clone())
    alive = ~data["next", "terminated"]
    torch.testing.assert_close(short["advantage"][alive], delta[alive])


@pytest.mark.parametrize("kind", [GAE, TDLambda])
@pytest.mark.parametrize(
    "option",
    [
        {"shifted": True},
        {"differentiable": True},
        {"vectorized": True},
        {"auto_reset_env": True},
        {"average_rewards": True},
        {"group_key": "task"},
        {"num_chunks": 2},
        {"value_chunk_size": 8},
        {"shifted_budget": 3},
    ],
    ids=str,
)
def test_options_that_ask_for_something_else_are_refused_by_name(kind, option):
    ((name, given),) = option.items()
    with pytest.raises(
        ValueError, match=f"{kind.__name__}: {name}={given!r} is not taken: .*; leave it out"
    ):
        kind(gamma=GAMMA, lmbda=LMBDA, **option)


def test_options_that_ask_for_nothing_else_are_taken():
    GAE(
        gamma=GAMMA,
        lmbda=LMBDA,
        shifted=False,
        differentiable=False,
        vectorized=False,
        skip_existing=False,
    )
    TDLambda(gamma=GAMMA, lmbda=LMBDA, vectorized=None, deactivate_vmap=True, value_chunk_dim=0)
