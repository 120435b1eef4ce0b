"""The fused kernels, run by Triton's interpreter, make the same of a rollout as torch does."""

import copy
import importlib
import math
from dataclasses import replace

import pytest
import torch

from ksim_rl.algorithms.ppo.fused import NotFused, fused_networks, make_fused_ppo
from ksim_rl.data import DatasetCfg
from ksim_rl.modules import ActorCfg, TanhGaussian, make_actor, make_critic
from ksim_rl.objectives import PPOCfg, StepGuard
from ksim_rl.objectives.fused_ppo import FusedLayout, why_not_fused
from ksim_rl.suites.dm_control import training
from tests.algorithms.fused_problem import (
    ACTIONS,
    ACTOR_OBS,
    ENVS,
    HIDDEN,
    SIZES,
    STEPS,
    assert_equal_states,
    column,
    finite,
    flat,
    needs_interpreter,
    networks,
    rollout,
    to_eleven_bits,
    update,
)


def full(*values):
    return pytest.param(*values, marks=pytest.mark.full)


@needs_interpreter
@pytest.mark.parametrize(
    ("options", "actor_options"),
    [
        # Observations that are stored as 48 columns, and multiplied as 64.
        ({}, {"actor_obs": 40}),
        # Two pieces, of 256 and 16 columns: heights beside the state.
        full({"adam_eps": 1e-5}, {"actor_obs": 259, "hidden": (32, 16, 16)}),
        (
            {
                "clip_epsilon": 1.0,
                "clip_value": False,
                "schedule": "fixed",
                "max_grad_norm": None,
                "weight_decay": 0.1,
                "normalize_advantage": "none",
                "entropy_coeff": 0.3,
                "critic_coeff": 0.7,
            },
            {"std_type": "log", "init_std": 0.6, "obs_normalization": False},
        ),
        # Each layer in kernels of its own. The schedule is fixed, since a divergence of zero is not one of 1e-9 to it.
        (
            {"entropy_coeff": 0.3, "schedule": "fixed"},
            {"hidden": (48,), "critic": (40,), "activation": "silu", "state_dependent_std": True},
        ),
        full(
            {"symmetry": "loss", "symmetry_coeff": 0.7},
            {
                "hidden": (16, 32, 16, 16),
                "activation": "tanh",
                "state_dependent_std": True,
                "std_type": "log",
            },
        ),
        full({}, {"activation": "relu"}),
        full({}, {"activation": "tanh"}),
        full({"symmetry": "augment"}, {}),
        full({"symmetry": "augment"}, {"hidden": (48, 16), "activation": "relu"}),
        full({"symmetry": "loss"}, {}),
        full({}, {"hidden": (16, 16), "actor_obs": 298}),
    ],
)
def test_updates_equal_those_of_torch(fused_ppo, options, actor_options):
    cfg = PPOCfg(num_epochs=1, learning_rate=3e-3, **options)
    actor, critic = networks(**actor_options)
    torch_s, fused = update(cfg, actor, critic), update(cfg, actor, critic, fused_ppo)
    for seed in range(2):
        data = rollout(actor, seed=seed).clone()
        # Of an env state that is left out, as its reward is no number.
        data["scale"][3, 2, 0] = float("nan")
        torch_s(data.clone())
        fused(data)
    assert_equal_states(torch_s, fused, atol=1e-5)
    ours, theirs = fused.metrics(), torch_s.metrics()
    assert ours.keys() == theirs.keys()
    assert ours["update/non_finite_env_states"] == 4
    torch.testing.assert_close(ours["policy/std"], data["scale"].nanmean())
    assert 0.0 <= ours["update/clip_fraction"] < 1.0
    assert ("loss/mirror" in ours) == (cfg.symmetry == "loss")
    # Torch's has other numbers in the place of the env states that are left out, and takes their variance too.
    for name in theirs.keys() - {"update/explained_variance"}:
        torch.testing.assert_close(
            ours[name].float(),
            theirs[name].float(),
            atol=1e-4,
            rtol=1e-3,
            msg=lambda text, name=name: f"{name}: {text}",
        )


BOUND = 1.5


def exact_entropy(policy):
    """Add up the mean of the tanh's log slope on a fine grid, instead of by a few points."""
    at = torch.linspace(-8.0, 8.0, 1601)
    weight = torch.exp(-0.5 * at.square()) * 0.01 / math.sqrt(2.0 * math.pi)
    latent = policy.loc[..., None] + policy.scale[..., None] * at
    slope = 2.0 * (math.log(2.0) - latent - torch.nn.functional.softplus(-2.0 * latent))
    return policy.base.entropy() + ((slope * weight).sum(-1) + math.log(BOUND)).sum(-1)


def moments(made):
    states = [made.optimizer.state[own] for own in made.optimizer.param_groups[0]["params"]]
    return [state[name] for state in states for name in ("exp_avg", "exp_avg_sq")]


@needs_interpreter
@pytest.mark.parametrize(
    ("options", "actor_options"),
    [
        (
            {},
            {
                "hidden": (48, 16),
                "critic": (40, 32),
                "activation": "silu",
                "state_dependent_std": True,
            },
        ),
        full({"symmetry": "augment"}, {}),
        full({"clip_value": False}, {"std_type": "log", "activation": "relu"}),
    ],
)
def test_updates_of_squashed_policies_equal_those_of_torch(
    fused_ppo, options, actor_options, monkeypatch
):
    """Torch estimates the entropy by a sample, unless the distribution has one; TorchRL remembers which ones have."""
    monkeypatch.setattr(TanhGaussian, "entropy", exact_entropy, raising=False)
    monkeypatch.setattr(
        "ksim_rl.objectives.clip_ppo_loss.has_analytic_entropy", lambda policy: True
    )
    cfg = PPOCfg(num_epochs=1, learning_rate=3e-3, schedule="fixed", entropy_coeff=0.5, **options)
    bounded = {"distribution": "tanh_gaussian", "action_bound": BOUND, "init_std": 0.7}
    actor, critic = networks(**{**bounded, **actor_options})
    torch_s, fused = update(cfg, actor, critic), update(cfg, actor, critic, fused_ppo)
    for seed in range(2):
        data = rollout(actor, seed=seed).clone()
        torch_s(data.clone())
        fused(data)
    # Of gradients: Adam turns the rounding of one that nearly cancels into a whole step.
    for own, other in zip(moments(fused), moments(torch_s), strict=True):
        assert (own - other).norm() < 3e-4 * other.norm()
    ours, theirs = fused.metrics(), torch_s.metrics()
    for name in ("loss/policy", "loss/value", "loss/entropy", "update/kl", "update/clip_fraction"):
        torch.testing.assert_close(ours[name], theirs[name], atol=2e-4, rtol=1e-3)


@needs_interpreter
@pytest.mark.parametrize("desired_kl", [1e3, full(1e-12)])
def test_an_annealed_rate_is_that_of_torch(fused_ppo, desired_kl):
    limits = {"learning_rate": 3e-3, "learning_rate_min": 2e-3, "learning_rate_max": 4e-3}
    cfg = PPOCfg(num_epochs=1, desired_kl=desired_kl, anneal_learning_rate=True, **limits)
    actor, critic = networks()
    torch_s, fused = update(cfg, actor, critic), update(cfg, actor, critic, fused_ppo)
    plain = update(replace(cfg, anneal_learning_rate=False), actor, critic, fused_ppo)
    plain(rollout(actor))
    for done, high in ((0.0, 4e-3), (0.5, 2e-3), (0.75, 1e-3)):
        for made in (torch_s, fused):
            made.set_progress(done)
            made(rollout(actor))
        # The floor is no higher than the ceiling.
        rate = high if desired_kl > 1.0 else min(2e-3, high)
        for made in (torch_s, fused):
            assert made.metrics()["update/learning_rate"].item() == pytest.approx(rate, rel=1e-6)
        if done == 0.0:
            assert_equal_states(plain, fused, atol=0.0)
    assert_equal_states(torch_s, fused, atol=1e-4)


@needs_interpreter
@pytest.mark.filterwarnings("error")
def test_what_takes_no_part_may_be_anything_and_no_part_at_all_is_a_loss_of_zero(fused_ppo):
    """Padding acts with zeros on an observation of zeros: the density of 16 such narrow gaussians is infinite."""
    actor, critic = networks(action_dim=16, init_std=1e-3, obs_normalization=False)
    data = rollout(actor)
    fused = update(PPOCfg(num_epochs=1), actor, critic, fused_ppo)
    fused(data.clone())
    assert fused.metrics()["update/skipped_steps"] == 0
    data["next", "reward"].fill_(float("nan"))
    fused(data)
    metrics = fused.metrics()
    assert metrics["update/skipped_steps"] == 0
    assert metrics["update/non_finite_env_states"] == 2 + ENVS * STEPS
    for name in ("loss/policy", "loss/value", "loss/entropy", "update/kl", "update/grad_norm"):
        assert metrics[name] == 0.0, name
    assert (fused.fused._summary[:, column("loss")] == 0.0).all()


@needs_interpreter
def test_explained_variance_of_targets_far_from_zero(fused_ppo):
    actor, critic = networks()
    cfg = PPOCfg(num_epochs=1, learning_rate=1e-9, schedule="fixed", normalize_advantage="none")
    data = rollout(actor).apply(finite)
    data["next", "done"].fill_(True)
    data["next", "terminated"].fill_(True)
    data["next", "reward"].add_(1e4)
    torch_s, fused = update(cfg, actor, critic), update(cfg, actor, critic, fused_ppo)
    torch_s(data.clone())
    fused(data)
    name = "update/explained_variance"
    torch.testing.assert_close(fused.metrics()[name], torch_s.metrics()[name], atol=1e-3, rtol=0.0)
    assert fused.metrics()[name].abs() < 1.0


@needs_interpreter
def test_a_run_goes_on_with_the_other_kind(fused_ppo):
    cfg = PPOCfg(num_epochs=1)
    actor, critic = networks()
    torch_s, fused = update(cfg, actor, critic), update(cfg, actor, critic, fused_ppo)
    data = [rollout(actor, seed=seed) for seed in range(2)]
    torch_s(data[0].clone())
    fused.load_state_dict(torch_s.state_dict())
    torch_s(data[1].clone())
    fused(data[1])
    assert_equal_states(torch_s, fused)


@needs_interpreter
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_steps_that_are_not_finite_change_nothing_and_are_counted(fused_ppo):
    actor, critic = networks()
    fused = update(PPOCfg(num_epochs=1), actor, critic, fused_ppo)
    data = rollout(actor)
    fused(data.clone())
    with torch.no_grad():
        fused.critic.module.layers[0].weight.fill_(1e30)
    before = copy.deepcopy(flat(fused.state_dict()))
    fused(data)
    after = flat(fused.state_dict())
    learned = [name for name in before if "trunk" in name or "moments" in name]
    assert learned
    assert all(torch.equal(before[name], after[name]) for name in learned)
    metrics = fused.metrics()
    assert metrics["update/skipped_in_a_row"] == metrics["update/skipped_steps"] == 2
    assert all(value.isfinite() for value in metrics.values())


@pytest.mark.parametrize(
    "options",
    [{}, {"hidden": (40, 70), "critic": (100, 16), "state_dependent_std": True, "actor_obs": 298}],
)
def test_layout_places_every_parameter_once(options):
    made = fused_networks(*networks(**options))
    layout = FusedLayout(made)
    index = layout.padded_index(made)
    assert len(index) == layout.num_flat == sum(parameter.numel() for parameter in made.parameters)
    assert len(index.unique()) == len(index)
    # The weights' tiles cover the padded weights and the biases of both networks once each; chained kernels have the
    # first layer's, and the weights of the second, elsewhere.
    covered = torch.zeros(2, layout.num_padded - layout.out, dtype=torch.int64)
    for network, _, _, place, stride, columns, rows, bias in layout.weight_tiles(16).tolist():
        for row in range(rows):
            covered[network, place + row * stride : place + row * stride + columns] += 1
        if bias >= 0:
            covered[network, bias : bias + rows] += 1
    if layout.chained:
        covered[:, : layout.places[2].weight] += 1
        covered[:, layout.num_weights :][:, : layout.hidden[0]] += 1
    assert (covered == 1).all()
    assert index[0] == 0
    last_bias = layout.num_padded + layout.num_weights + sum(layout.hidden)
    assert index[-1] == last_bias


def made_columns(made):
    layout = FusedLayout(made)
    return max(layout.inputs, layout.gradients)


def test_a_symmetry_without_a_mirror_is_refused(fused_ppo):
    with pytest.raises(ValueError, match="symmetry=.loss. needs one"):
        fused_ppo(
            PPOCfg(symmetry="loss"),
            fused_networks(*networks()),
            optimizer=torch.optim.Adam([torch.zeros(1)]),
            guard=StepGuard(),
            num_env_states_per_minibatch=8,
            num_minibatches=1,
        )


@needs_interpreter
@pytest.mark.parametrize("hidden", [HIDDEN, full((48, 16))])
def test_what_tensor_cores_would_cut_off_is_rounded(fused_ppo, hidden):
    torch.set_float32_matmul_precision("high")
    actor, critic = networks(hidden=hidden)
    data = rollout(actor)
    # Not clipped: the mean of Adam is a sum of gradients.
    cfg = PPOCfg(num_epochs=1, schedule="fixed", learning_rate=1e-6, max_grad_norm=None)
    made, exact = update(cfg, actor, critic, fused_ppo), update(cfg, actor, critic)
    for one in (made, exact):
        one(data.clone())
    parameters = made.fused.parameters
    torch.testing.assert_close(
        parameters.weights, to_eleven_bits(parameters.exact), rtol=0.0, atol=0.0
    )
    arguments = made.fused._arguments
    for operands in (
        made.fused.dataset.obs,
        parameters.weights,
        arguments["inputs"],
        arguments["slopes"],
    ):
        assert operands.count_nonzero() and not (operands.view(torch.int32) & 0x1FFF).any()
    ours, theirs = (
        torch.cat([one.optimizer.state[own]["exp_avg"].flatten() for own in one.loss.parameters()])
        for one in (made, exact)
    )
    assert 1e-5 < (ours - theirs).norm() / theirs.norm() < 3e-3


def test_rounding_keeps_what_is_not_finite(fused_ppo):
    as_tf32 = importlib.import_module("ksim_rl.objectives.fused_ppo.dataset").as_tf32
    odd = torch.tensor([0x7FFFFFFF, -1, 0x7F800000, -0x800000], dtype=torch.int32).view(
        torch.float32
    )
    assert as_tf32(odd)[:2].isnan().all() and torch.equal(as_tf32(odd)[2:], odd[2:])


def test_what_the_kernels_cannot_do_is_said():
    bounded = ActorCfg(distribution="truncated_gaussian", action_bound=1.0)
    actor, critic = networks()
    made = fused_networks(actor, critic)
    assert why_not_fused(PPOCfg(precision="bfloat16"), made, **SIZES) is None
    assert "matmul_precision='highest'" in why_not_fused(PPOCfg(), made, **SIZES)
    torch.set_float32_matmul_precision("high")
    assert why_not_fused(PPOCfg(), made, **SIZES) is None
    wide = fused_networks(*networks(hidden=(272, 32)))
    assert "wider than 256" in why_not_fused(PPOCfg(), wide, **SIZES)
    assert why_not_fused(PPOCfg(precision="bfloat16"), wide, **SIZES) is None
    for option in (
        {"kernels": "torch"},
        {"advantage": "vtrace"},
        {"estimate_each_epoch": True},
        {"normalize_advantage": "minibatch"},
    ):
        cfg = PPOCfg(precision="bfloat16", **option)
        assert next(iter(option)) in why_not_fused(cfg, made, **SIZES)
    assert "['GELU'], and not all one of" in fused_networks(*networks(activation="gelu")).reason
    policy = make_actor(bounded, obs_dim=ACTOR_OBS, action_dim=ACTIONS)
    assert "Gaussian" in fused_networks(policy, critic).reason
    squashed = fused_networks(*networks(distribution="tanh_gaussian", action_bound=1.0))
    assert why_not_fused(PPOCfg(precision="bfloat16"), squashed, **SIZES) is None
    assert "squashed" in why_not_fused(
        PPOCfg(precision="bfloat16", symmetry="loss"), squashed, **SIZES
    )
    cfg = PPOCfg(precision="bfloat16")
    for options, reason in (
        ({"critic": (32, 32)}, "hidden layers of [32, 32, 16] and [32, 32]"),
        ({"hidden": (16, 1040)}, "wider than 1024"),
        ({"action_dim": 65}, "more than 64 actions"),
    ):
        assert reason in why_not_fused(cfg, fused_networks(*networks(**options)), **SIZES)
    assert "too many" in why_not_fused(
        cfg, made, num_env_states_per_minibatch=2**25, num_minibatches=2
    )
    # Symmetry doubles the rows of a minibatch.
    rows = {
        "num_env_states_per_minibatch": 2**31 // (2 * made_columns(made)) + 1,
        "num_minibatches": 1,
    }
    assert why_not_fused(cfg, made, **rows) is None
    assert "too many" in why_not_fused(
        PPOCfg(precision="bfloat16", symmetry="augment"), made, **rows
    )
    assert isinstance(fused_networks(actor, torch.nn.Identity()), NotFused)
    assert update(PPOCfg(), actor, critic).metrics()["update/fused"] == 0.0


def test_narrow_networks_are_fused_in_float32():
    torch.set_float32_matmul_precision("high")
    # The control suite's settings, with the observations and actions of a humanoid of CMU, which has the most.
    cfg = training.ppo()
    hidden = cfg.modules.critic.hidden_dims
    actor = make_actor(replace(cfg.modules.actor, hidden_dims=hidden), obs_dim=137, action_dim=56)
    made = fused_networks(actor, make_critic(cfg.modules.critic, obs_dim=137))
    sizes = {name: getattr(cfg.data, name) for name in SIZES}
    assert why_not_fused(cfg.objective, made, **sizes) is None
    assert made.chained


def test_on_the_cpu_torch_makes_the_steps():
    actor, critic = networks()
    made = update(PPOCfg(), actor, critic)
    assert make_fused_ppo(made) == made.fused == NotFused("they need CUDA and Triton")
    assert made.notes == []
    made.device = torch.device("cuda")
    assert made.notes == [
        "torch makes the gradient steps, not the fused kernels: they need CUDA and Triton"
    ]


def test_bfloat16_products_change_a_gradient_step_a_little():
    actor, critic = networks()
    data = rollout(actor)
    # The mean after one step of Adam is a tenth of the gradient.
    one = {"num_epochs": 1, "schedule": "fixed", "max_grad_norm": None}
    sizes = DatasetCfg(num_env_states_per_minibatch=48, num_minibatches=1)
    moved = {}
    for precision in ("float32", "bfloat16"):
        made = update(PPOCfg(precision=precision, **one), actor, critic, data=sizes)
        made(data.clone())
        moved[precision] = torch.cat(
            [entry["exp_avg"].flatten() for entry in made.optimizer.state.values()]
        )
    error = (moved["bfloat16"] - moved["float32"]).norm() / moved["float32"].norm()
    assert 1e-5 < error < 0.03
