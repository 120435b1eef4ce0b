"""The fused gradient steps on a GPU, beside torch's. Skipped where there is no GPU."""

import copy

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from benchmarks.update import make_rollout
from ksim_rl.algorithms.ppo.update import PPOUpdate
from ksim_rl.data import DatasetCfg
from ksim_rl.device.capture import Captured
from ksim_rl.modules import ActorCfg, CriticCfg, make_actor, make_critic
from ksim_rl.objectives import PPOCfg
from ksim_rl.transforms import MirrorMap
from tests.gpu.no_syncs import no_syncs

pytestmark = pytest.mark.gpu
ENVS, STEPS, OBS = 256, 24, 48
DEVICE = torch.device("cuda")
SQUASHED = {"distribution": "tanh_gaussian", "action_bound": 1.0, "init_std": 0.7}


def networks(
    *, hidden_dims=(512, 256, 128), action_dim=12, obs=OBS, activation="elu", **actor_options
):
    torch.manual_seed(2)
    actor_cfg = ActorCfg(hidden_dims=hidden_dims, activation=activation, **actor_options)
    actor = make_actor(actor_cfg, obs_dim=obs, action_dim=action_dim, device=DEVICE)
    critic_cfg = CriticCfg(hidden_dims=hidden_dims, activation=activation)
    return actor, make_critic(critic_cfg, obs_dim=obs, device=DEVICE)


def mirror(obs, actions):
    def swapped(size):
        return MirrorMap(source=(1, 0, *range(2, size)), signs=(-1, -1, *[1] * (size - 2)))

    return {"actor": swapped(obs), "critic": swapped(obs), "action": swapped(actions)}


def update(actor, critic, *, minibatches=4, **options):
    data = DatasetCfg(
        num_env_states_per_minibatch=ENVS * STEPS // minibatches, num_minibatches=minibatches
    )
    cfg = PPOCfg(**({"precision": "bfloat16"} | options))
    network = actor[0].module
    maps = (
        mirror(network.trunk[0].in_features, network.head.loc.out_features)
        if cfg.symmetry != "none"
        else None
    )
    copies = {"actor": copy.deepcopy(actor), "critic": copy.deepcopy(critic)}
    return PPOUpdate(cfg, **copies, data=data, device=DEVICE, mirror=maps)


def moments(made):
    parameters = (*made.actor.parameters(), *made.critic.parameters())
    return [made.optimizer.state[parameter]["exp_avg"] for parameter in parameters]


def layers(made, *held):
    """Return by layer what is held of its parameters, weights and biases together, [len(held), all].

    A standard deviation counts with its head: of one action it is one number, in which nearly all can cancel.
    """
    names = [name for module in (made.actor, made.critic) for name, _ in module.named_parameters()]
    found = {}
    for name, *values in zip(names, *held, strict=True):
        layer = name.rpartition(".")[0].removesuffix(".loc")
        found.setdefault(layer, []).append(torch.stack(values).flatten(1))
    return {layer: torch.cat(parts, dim=1) for layer, parts in found.items()}


def errors(made, exact):
    """Return by layer how far its gradient is from the exact one, relative to that."""
    joined = layers(made, moments(made), moments(exact))
    return {
        layer: float((ours - theirs).norm() / theirs.norm())
        for layer, (ours, theirs) in joined.items()
    }


def parameters(made):
    return [*made.actor.parameters(), *made.critic.parameters()]


@pytest.mark.parametrize(
    ("network_options", "symmetry"),
    [
        ({}, "none"),
        ({}, "augment"),
        ({"hidden_dims": (256, 128, 64), "action_dim": 29, "std_type": "log"}, "none"),
        ({"hidden_dims": (48, 32, 16), "action_dim": 1}, "none"),
        ({}, "loss"),
        ({"hidden_dims": (1024, 1024), "activation": "relu", "obs": 298}, "none"),
        # Heights beside the state: observations in two pieces, of which the second is small, or large.
        ({"obs": 259}, "none"),
        ({"obs": 298, "action_dim": 29}, "augment"),
        (
            {
                "hidden_dims": (512, 512, 256, 128),
                "activation": "silu",
                "state_dependent_std": True,
            },
            "augment",
        ),
        (
            {
                "hidden_dims": (80, 48),
                "activation": "tanh",
                "state_dependent_std": True,
                "std_type": "log",
            },
            "loss",
        ),
        (
            {
                "hidden_dims": (256, 128),
                "activation": "silu",
                "state_dependent_std": True,
                **SQUASHED,
            },
            "none",
        ),
    ],
)
def test_the_gradient_is_that_of_exact_products(network_options, symmetry):
    actor, critic = networks(**network_options)
    rollout_ET = make_rollout(
        actor, num_envs=ENVS, device=DEVICE, obs=network_options.get("obs", OBS)
    )
    rollout_ET["next", "reward"][3, 4] = float("nan")
    # One step, not clipped: the mean of Adam is then a tenth of the gradient.
    one = {"minibatches": 1, "num_epochs": 1, "max_grad_norm": None, "symmetry": symmetry}
    if "distribution" in network_options:
        one["entropy_coeff"] = 1e-6  # torch estimates it by a sample
    fused = update(actor, critic, **one)
    exact = update(actor, critic, precision="float32", kernels="torch", **one)
    plain = update(actor, critic, kernels="torch", **one)
    assert fused.metrics()["update/fused"] == 1.0
    assert exact.metrics()["update/fused"] == plain.metrics()["update/fused"] == 0.0
    for made in (fused, exact, plain):
        made(rollout_ET.clone())
    # Sums that cancel lose more to rounding, whoever adds: torch's own products in bfloat16 are the measure there.
    of_torch = errors(plain, exact)
    for layer, error in errors(fused, exact).items():
        assert error < max(0.02, 1.5 * of_torch[layer]), (layer, error, of_torch[layer])
    ours, theirs = fused.metrics(), exact.metrics()
    assert ours["update/non_finite_env_states"] == theirs["update/non_finite_env_states"] == 1
    for name in ("loss/policy", "loss/value", "loss/entropy", "policy/std"):
        sampled = name == "loss/entropy" and "distribution" in network_options
        torch.testing.assert_close(
            ours[name], theirs[name], atol=0.1 if sampled else 1e-3, rtol=1e-2
        )


@pytest.mark.parametrize(
    "network_options",
    [
        {"hidden_dims": (256, 256, 128), "action_dim": 21, "obs": 67, "init_std": 0.03},
        {"hidden_dims": (256, 256, 128), "action_dim": 29, "obs": 298},
        {"hidden_dims": (256, 128)},
        {"hidden_dims": (128, 128), "activation": "silu", "state_dependent_std": True, **SQUASHED},
    ],
)
def test_float32_is_rounded_as_by_torch(network_options):
    torch.set_float32_matmul_precision("high")
    actor, critic = networks(**network_options)
    rollout_ET = make_rollout(
        actor, num_envs=ENVS, device=DEVICE, obs=network_options.get("obs", OBS)
    )
    one = {"precision": "float32", "minibatches": 1, "num_epochs": 1, "max_grad_norm": None}
    one |= {"entropy_coeff": 1e-6} if "distribution" in network_options else {}
    fused, plain = update(actor, critic, **one), update(actor, critic, kernels="torch", **one)
    assert (fused.metrics()["update/fused"], plain.metrics()["update/fused"]) == (1.0, 0.0)
    fused(rollout_ET.clone())
    plain(rollout_ET.clone())
    torch.set_float32_matmul_precision("highest")
    exact = update(actor, critic, kernels="torch", **one)
    exact(rollout_ET.clone())
    of_torch = errors(plain, exact)
    for layer, error in errors(fused, exact).items():
        assert error < max(0.005, 1.5 * of_torch[layer]), (layer, error, of_torch[layer])
    # The policy is the one that acted; narrow as it is, it must be to a small part of its standard deviation.
    assert fused.metrics()["update/kl"] < 1e-3


@pytest.mark.parametrize(
    ("network_options", "options"),
    [({}, {}), ({"min_std": 1.0}, {"min_advantage_std": 2.0})],
    ids=str,
)
def test_the_fused_kernels_equal_torch_in_bfloat16(network_options, options):
    actor, critic = networks(**network_options)
    rollout_ET = make_rollout(actor, num_envs=ENVS, device=DEVICE)
    fused = update(actor, critic, schedule="fixed", **options)
    plain = update(actor, critic, schedule="fixed", kernels="torch", **options)
    assert plain.metrics()["update/fused"] == 0.0
    before = [parameter.clone() for parameter in parameters(fused)]
    for made in (fused, plain):
        made(rollout_ET.clone())
    with torch.no_grad():
        joined = layers(fused, before, parameters(fused), parameters(plain))
    for layer, (start, ours, theirs) in joined.items():
        # Adam turns each rounding of a small gradient into a whole step.
        assert (ours - theirs).norm() < 0.2 * (theirs - start).norm(), layer
    for name in ("loss/value", "update/grad_norm", "update/clip_fraction"):
        torch.testing.assert_close(
            fused.metrics()[name], plain.metrics()[name], atol=0.01, rtol=0.03
        )


@pytest.mark.parametrize(
    "options", [{"desired_kl": 1e3}, {"desired_kl": 1e-12}, {"schedule": "fixed"}], ids=str
)
def test_annealed_rates_are_those_of_torch_also_in_a_graph(options):
    limits = {"learning_rate": 3e-3, "learning_rate_min": 2e-3, "learning_rate_max": 4e-3}
    actor, critic = networks()
    rollout_ET = make_rollout(actor, num_envs=ENVS, device=DEVICE)
    annealed = {**limits, **options, "anneal_learning_rate": True}
    fused, plain = (
        update(actor, critic, **annealed),
        update(actor, critic, kernels="torch", **annealed),
    )
    assert (fused.metrics()["update/fused"], plain.metrics()["update/fused"]) == (1.0, 0.0)
    for done in (0.0, 0.1, 0.4, 0.5, 0.75, 0.9, 1.0):
        high = (3e-3 if "schedule" in options else 4e-3) * (1.0 - done)
        low = 2e-3 if options.get("desired_kl") == 1e-12 else high
        for made in (fused, plain):
            made.set_progress(done)
            made(rollout_ET)
            assert float(made.metrics()["update/learning_rate"]) == pytest.approx(
                min(low, high), rel=1e-6
            )
    # The later ones are replays.
    assert fused._run.ready and plain._run.ready
    with no_syncs():
        fused.set_progress(0.5)


def test_annealing_at_the_start_of_a_run_changes_no_bit():
    actor, critic = networks()
    rollout_ET = make_rollout(actor, num_envs=ENVS, device=DEVICE)
    annealed, plain = update(actor, critic, anneal_learning_rate=True), update(actor, critic)
    for _ in range(4):
        annealed.set_progress(0.0)
        for made in (annealed, plain):
            made(rollout_ET)
    assert all(
        torch.equal(one, other)
        for one, other in zip(parameters(annealed), parameters(plain), strict=True)
    )


@pytest.mark.parametrize("hidden_dims", [(512, 256, 128), (512, 256)])
def test_captured_steps_are_the_eager_ones_bit_for_bit(hidden_dims):
    actor, critic = networks(hidden_dims=hidden_dims)
    rollout_ET = make_rollout(actor, num_envs=ENVS, device=DEVICE)
    eager, captured = update(actor, critic), update(actor, critic)
    eager._rollout_ET = captured._rollout_ET = rollout_ET
    graph = Captured(captured._update, device=DEVICE, require_graphs=True)
    for _ in range(5):
        eager._update()
        graph()
    assert graph.ready
    assert all(
        torch.equal(one, other)
        for one, other in zip(parameters(eager), parameters(captured), strict=True)
    )
    assert all(parameter.isfinite().all() for parameter in parameters(eager))
    assert captured.metrics()["update/skipped_steps"] == 0
    assert all(
        torch.equal(value, captured.metrics()[name]) for name, value in eager.metrics().items()
    )


@pytest.mark.parametrize("hidden_dims", [(512, 256, 128), (512, 256)])
def test_no_host_sync(hidden_dims):
    actor, critic = networks(hidden_dims=hidden_dims)
    rollout_ET = make_rollout(actor, num_envs=ENVS, device=DEVICE)
    made = update(actor, critic)
    made._rollout_ET = rollout_ET
    made._update()
    with no_syncs():
        made._update()
        made.metrics()


@pytest.mark.parametrize(
    "network_options", [{}, {"obs": 45, "action_dim": 29, "std_type": "log"}, {"obs": 298}]
)
def test_the_ratio_at_the_first_step_is_one(network_options):
    actor, critic = networks(output_gain=1.0, **network_options)
    obs = network_options.get("obs", OBS)
    # Of 1e-3 off one a ratio counts as clipped.
    one = {"minibatches": 1, "num_epochs": 1, "clip_epsilon": 1e-3}
    clipped = {}
    for name in ("behavior", "actor"):
        made = update(actor, critic, **one)
        assert made.metrics()["update/fused"] == 1.0
        # The second rollout is of the policy that the first update has left, with other statistics.
        for _ in range(2):
            acting = getattr(made, name)
            rollout_ET = make_rollout(acting, num_envs=ENVS, device=DEVICE, obs=obs)
            with torch.no_grad():
                plain = made.actor(rollout_ET.select("actor"))["loc"]
            torch.testing.assert_close(rollout_ET["loc"], plain, atol=0.1, rtol=0.05)
            made(rollout_ET)
            clipped.setdefault(name, []).append(float(made.metrics()["update/clip_fraction"]))
    assert clipped["behavior"] == [0.0, 0.0]
    assert min(clipped["actor"]) > 0.1


def test_what_a_graph_of_a_rollout_replays_follows_the_modules():
    made = update(*networks())
    behavior, seen = (
        made.behavior,
        TensorDict({"actor": torch.randn(ENVS, OBS, device=DEVICE)}, [ENVS]),
    )
    means = torch.empty(ENVS, 12, device=DEVICE)

    def act():
        with (
            torch.no_grad(),
            behavior.steady(),
            set_exploration_type(ExplorationType.DETERMINISTIC),
        ):
            means.copy_(behavior(seen.copy())["action"])

    graph = Captured(act, device=DEVICE, require_graphs=True)
    for _ in range(4):
        graph()
    assert graph.ready
    before = means.clone()
    with torch.no_grad():
        made.actor[0].module.head.loc.bias += 0.5
    graph()
    torch.testing.assert_close(means, before + 0.5)
    assert torch.equal(means, behavior(seen.copy())["loc"])


def test_steps_that_are_not_finite_are_skipped():
    actor, critic = networks()
    rollout_ET = make_rollout(actor, num_envs=ENVS, device=DEVICE)
    made = update(actor, critic, num_epochs=1)
    made(rollout_ET)
    with torch.no_grad():
        made.critic.module.layers[0].weight.fill_(1e30)
    before = [parameter.clone() for parameter in made.actor.parameters()]
    made(rollout_ET)
    assert all(
        torch.equal(one, other) for one, other in zip(before, made.actor.parameters(), strict=True)
    )
    assert made.metrics()["update/skipped_steps"] == 4
