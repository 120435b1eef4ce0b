"""Lambda returns and V-trace: against stock TorchRL, and against recursions in float64 written out here."""

import math

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.objectives import value
from torchrl.objectives.value.functional import vtrace_advantage_estimate

from ksim_rl.objectives import GAE, ClipPPOLoss, TDLambda, VTrace
from ksim_rl.testing import count_syncs
from tests.objectives.problems import networks, rollout

GAMMA, LMBDA = 0.97, 0.9
KINDS = ("td_lambda", "vtrace")


def _parts(*, drift=0.2, **options):
    """Return a rollout, and the networks that it is judged by: the policy has moved since it was collected."""
    actor, critic = networks()
    data = rollout(actor, **options)
    with torch.no_grad():
        for parameter in actor.parameters():
            parameter.add_(drift * torch.randn_like(parameter))
    return actor, critic, data


def _make(kind, actor, critic, **options):
    if kind == "gae":
        return GAE(gamma=GAMMA, lmbda=LMBDA, critic=critic, **options)
    if kind == "td_lambda":
        return TDLambda(gamma=GAMMA, lmbda=LMBDA, critic=critic, **options)
    return VTrace(gamma=GAMMA, actor=actor, critic=critic, **options)


def _ratio(actor, data):
    with torch.no_grad():
        log_prob = actor.get_dist(data.select("actor")).log_prob(data["action"])
    return (log_prob - data["action_log_prob"]).exp().unsqueeze(-1)


def _columns(out):
    """Return the float64 numbers of one env, step by step."""
    names = {
        "value": "state_value",
        "next_value": ("next", "state_value"),
        "reward": ("next", "reward"),
    }
    names |= {"done": ("next", "done"), "terminated": ("next", "terminated")}
    return {name: out[key].double().squeeze(-1) for name, key in names.items()}


def _lambda_returns(out, lmbda):
    c = _columns(out)
    returns = torch.zeros_like(c["value"])
    for env in range(returns.shape[0]):
        following = 0.0
        for t in reversed(range(returns.shape[1])):
            v_next = 0.0 if c["terminated"][env, t] else float(c["next_value"][env, t])
            last = t == returns.shape[1] - 1
            if not last and not c["done"][env, t]:
                v_next = (1 - lmbda) * v_next + lmbda * following
            following = float(c["reward"][env, t]) + GAMMA * v_next
            returns[env, t] = following
    return returns


def _vtrace(out, ratio, *, lmbda=1.0, rho_thresh=1.0, c_thresh=1.0):
    """Sum the definition (Espeholt et al., equation 1) for each step, rather than recurse."""
    c, ratio = _columns(out), ratio.double().squeeze(-1)
    targets, advantages = torch.zeros_like(c["value"]), torch.zeros_like(c["value"])
    length = targets.shape[1]

    def bootstrapped(env, t, following):
        return float(c["reward"][env, t]) + (0.0 if c["terminated"][env, t] else GAMMA * following)

    for env in range(targets.shape[0]):
        for s in range(length):
            total, weight = float(c["value"][env, s]), 1.0
            for t in range(s, length):
                error = bootstrapped(env, t, float(c["next_value"][env, t])) - float(
                    c["value"][env, t]
                )
                total += weight * min(rho_thresh, float(ratio[env, t])) * error
                weight *= GAMMA * lmbda * min(c_thresh, float(ratio[env, t]))
                if c["done"][env, t]:
                    break
            targets[env, s] = total
        for s in range(length):
            ends = s == length - 1 or bool(c["done"][env, s])
            following = float(c["next_value"][env, s] if ends else targets[env, s + 1])
            error = bootstrapped(env, s, following) - float(c["value"][env, s])
            advantages[env, s] = min(rho_thresh, float(ratio[env, s])) * error
    return advantages, targets


@pytest.mark.parametrize("end_probability", [0.0, 0.15, 0.5])
def test_lambda_returns_equal_stock_torchrl_and_a_float64_recursion(end_probability):
    _, critic, data = _parts(num_envs=16, length=12, end_probability=end_probability)
    for vectorized in (False, True):
        stock = value.TDLambdaEstimator(
            gamma=GAMMA, lmbda=LMBDA, value_network=critic, vectorized=vectorized, time_dim=1
        )
        expected = stock(data.clone())
        out = TDLambda(gamma=GAMMA, lmbda=LMBDA, critic=critic)(data.clone())
        for key in ("advantage", "value_target", "state_value", ("next", "state_value")):
            torch.testing.assert_close(out[key], expected[key], atol=2e-6, rtol=1e-6)
    returns = _lambda_returns(out, LMBDA)
    torch.testing.assert_close(
        out["value_target"].squeeze(-1).double(), returns, atol=1e-6, rtol=1e-6
    )


@pytest.mark.parametrize("thresholds", [{}, {"rho_thresh": 2.0, "c_thresh": 1.3}])
@pytest.mark.parametrize("end_probability", [0.0, 0.15, 0.5])
def test_vtrace_equals_stock_torchrl_and_the_definition(end_probability, thresholds):
    actor, critic, data = _parts(num_envs=16, length=12, end_probability=end_probability)
    out = VTrace(gamma=GAMMA, actor=actor, critic=critic, **thresholds)(data)
    ratio = _ratio(actor, data)
    assert (ratio > 1.0).any() and (ratio < 1.0).any()
    # The function rather than TorchRL's class, which compares with the log-probability of an action drawn again.
    advantage, value_target = vtrace_advantage_estimate(
        GAMMA,
        ratio.log(),
        torch.zeros_like(ratio),
        out["state_value"],
        out["next", "state_value"],
        out["next", "reward"],
        out["next", "done"],
        out["next", "terminated"],
        **thresholds,
    )
    torch.testing.assert_close(out["advantage"], advantage, atol=2e-6, rtol=1e-6)
    torch.testing.assert_close(out["value_target"], value_target, atol=2e-6, rtol=1e-6)
    for actual, expected in zip(
        ("advantage", "value_target"), _vtrace(out, ratio, **thresholds), strict=True
    ):
        torch.testing.assert_close(out[actual].squeeze(-1).double(), expected, atol=2e-6, rtol=2e-6)


def test_vtrace_weights_longer_returns_by_lambda():
    actor, critic, data = _parts()
    out = VTrace(gamma=GAMMA, actor=actor, critic=critic, lmbda=0.6)(data)
    expected = _vtrace(out, _ratio(actor, data), lmbda=0.6)
    torch.testing.assert_close(
        out["advantage"].squeeze(-1).double(), expected[0], atol=2e-6, rtol=2e-6
    )
    torch.testing.assert_close(
        out["value_target"].squeeze(-1).double(), expected[1], atol=2e-6, rtol=2e-6
    )


def _continuous(data):
    """Make each next observation the observation of the next step, as collectors do."""
    goes_on = ~data["next", "done"][:, :-1]
    for key in ("actor", "critic"):
        following = torch.where(goes_on, data[key][:, 1:], data["next", key][:, :-1])
        data["next", key][:, :-1] = following
    return data


def test_in_a_collected_rollout_lambda_returns_and_gae_agree():
    _, critic, data = _parts()
    data = _continuous(data)
    outs = [_make(kind, None, critic)(data.clone()) for kind in ("gae", "td_lambda")]
    for key in ("advantage", "value_target"):
        torch.testing.assert_close(outs[0][key], outs[1][key], atol=2e-6, rtol=1e-6)


def test_vtrace_of_the_policy_that_collected_is_the_lambda_return():
    actor, critic, data = _parts(drift=0.0)
    data = _continuous(data)
    out = VTrace(gamma=GAMMA, actor=actor, critic=critic, lmbda=LMBDA)(data.clone())
    expected = TDLambda(gamma=GAMMA, lmbda=LMBDA, critic=critic)(data)
    torch.testing.assert_close(out["value_target"], expected["value_target"], atol=2e-6, rtol=1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_truncation_bootstraps_from_the_true_terminal_observation_and_termination_from_zero(kind):
    class FirstColumn(torch.nn.Module):
        def forward(self, obs):
            return obs[..., :1]

    actor, _ = networks()
    critic = TensorDictModule(FirstColumn(), in_keys=["critic"], out_keys=["state_value"])
    for flag, bootstrap in (("truncated", 7.0), ("terminated", 0.0)):
        data = rollout(actor, num_envs=1, length=3, end_probability=0.0)
        # The observation after the end (value 100) belongs to the next episode and must not matter.
        data["critic"][0, :, 0] = torch.tensor([1.0, 2.0, 100.0])
        data["next", "critic"][0, :, 0] = torch.tensor([2.0, 7.0, 3.0])
        data["next", "reward"].fill_(1.0)
        data["next", flag][0, 1] = True
        data["next", "done"][0, 1] = True
        options = {"gamma": 0.5, "lmbda": 1.0, "critic": critic}
        estimator = TDLambda(**options) if kind == "td_lambda" else VTrace(actor=actor, **options)
        returns = [1.0 + 0.5 * (1.0 + 0.5 * bootstrap), 1.0 + 0.5 * bootstrap, 1.0 + 0.5 * 3.0]
        out = estimator(data)
        torch.testing.assert_close(out["value_target"].flatten(), torch.tensor(returns))
        torch.testing.assert_close(
            out["advantage"].flatten(), torch.tensor(returns) - torch.tensor([1.0, 2.0, 100.0])
        )


@pytest.mark.parametrize("kind", KINDS)
def test_a_step_that_is_not_finite_is_marked_and_the_recursion_starts_anew_before_it(kind):
    actor, critic, data = _parts(num_envs=4, length=6, end_probability=0.0)
    clean = data.clone()
    data["next", "reward"][1, 3] = float("nan")
    data["next", "critic"][2, 5] = float("inf")  # also the last step
    estimator = _make(kind, actor, critic)
    out = estimator(data)
    assert out["advantage"].isnan().sum() == 2
    assert out["advantage"][1, 3].isnan() and out["advantage"][2, 5].isnan()
    # Later steps and other envs do not notice; for earlier ones it is as if the rollout ended before it.
    whole = estimator(clean.clone())
    torch.testing.assert_close(out["advantage"][1, 4:], whole["advantage"][1, 4:])
    torch.testing.assert_close(out["advantage"][[0, 3]], whole["advantage"][[0, 3]])
    # There the recursion goes on from V at the bad step.
    clean["next", "critic"][1, 2] = clean["critic"][1, 3]
    data["next", "critic"][1, 2] = clean["critic"][1, 3]
    expected = estimator(clean[1:2, :3].clone())["advantage"][0]
    torch.testing.assert_close(estimator(data)["advantage"][1, :3], expected)


@pytest.mark.parametrize("kind", KINDS)
def test_a_terminal_observation_that_is_not_finite_does_not_matter(kind):
    actor, critic, data = _parts(num_envs=2, length=4, end_probability=0.0)
    for step in (1, 3):
        data["next", "terminated"][0, step] = data["next", "done"][0, step] = True
    expected = _make(kind, actor, critic)(data.clone())["advantage"]
    for step in (1, 3):
        data["next", "critic"][0, step] = float("nan")
    out = _make(kind, actor, critic)(data)["advantage"]
    torch.testing.assert_close(out, expected)


@pytest.mark.parametrize("normalize", [pytest.param(False, marks=pytest.mark.full), True])
@pytest.mark.parametrize("kind", KINDS)
def test_no_host_sync_no_compiler_break_no_gradient(kind, normalize):
    actor, critic, data = _parts()
    estimator = _make(kind, actor, critic, normalize_advantage=normalize)
    with count_syncs() as syncs:
        expected = estimator(data.clone())
    assert syncs.total == 0, syncs.report()
    assert not expected["advantage"].requires_grad and not expected["value_target"].requires_grad
    if normalize:
        assert expected["advantage"].mean().item() == pytest.approx(0.0, abs=1e-5)
        assert expected["advantage"].std().item() == pytest.approx(1.0, abs=1e-5)
    compiled = torch.compile(estimator, fullgraph=True, backend="aot_eager")
    torch.testing.assert_close(compiled(data.clone())["advantage"], expected["advantage"])


@pytest.mark.parametrize("kind", KINDS)
def test_memory_layout_and_time_dim_do_not_matter(kind):
    actor, critic, data = _parts()
    estimator = _make(kind, actor, critic)
    expected = estimator(data.clone())
    time_major = data.transpose(0, 1).contiguous()
    for layout, time_dim in ((time_major.transpose(0, 1), -1), (time_major, 0), (data.clone(), 1)):
        out = estimator(layout.clone(False), time_dim=time_dim)
        for key in ("advantage", "value_target"):
            leaf = out[key].transpose(0, 1) if time_dim == 0 else out[key]
            torch.testing.assert_close(leaf, expected[key])


@pytest.mark.parametrize("kind", KINDS)
def test_serves_losses_as_value_estimator(kind):
    actor, critic, data = _parts()
    loss = ClipPPOLoss(actor, critic)
    loss.make_value_estimator(_make(kind, actor, critic))
    torch.testing.assert_close(
        loss(data.clone())["loss_critic"],
        loss(_make(kind, actor, critic)(data.clone()))["loss_critic"],
    )


def test_vtrace_refuses_what_it_cannot_compare():
    actor, critic, data = _parts()
    with pytest.raises(ValueError, match="actor=None"):
        VTrace(gamma=GAMMA, critic=critic)
    with pytest.raises(ValueError, match="'action_log_prob'.*None"):
        VTrace(gamma=GAMMA, actor=actor, critic=critic)(data.exclude("action_log_prob"))


def test_a_ratio_beyond_the_threshold_stops_at_it():
    # Two steps of one env, with a policy that makes the first action e times as likely as it was.
    actor, critic, data = _parts(drift=0.0, num_envs=1, length=2, end_probability=0.0)
    data["action_log_prob"] -= 1.0
    out = VTrace(gamma=GAMMA, actor=actor, critic=critic, rho_thresh=2.0, c_thresh=1.0)(data)
    v, v_next = out["state_value"].flatten(), out["next", "state_value"].flatten()
    r = out["next", "reward"].flatten()
    errors = r + GAMMA * v_next - v
    assert math.e > 2.0
    torch.testing.assert_close(
        out["value_target"].flatten()[0], v[0] + 2.0 * (errors[0] + GAMMA * errors[1])
    )
    torch.testing.assert_close(out["value_target"].flatten()[1], v[1] + 2.0 * errors[1])


def test_the_results_are_written_into_the_data():
    actor, critic, data = _parts()
    for kind in KINDS:
        out = _make(kind, actor, critic)(data)
        assert out is data
        assert isinstance(out, TensorDict)
