"""Behavior cloning finds the policy that made the actions, reads folders with care, and is a start for PPO."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl import objectives
from torchrl.data import OneHot

from ksim_rl import conf, data
from ksim_rl.algorithms.bc.demonstration import read_demonstration
from ksim_rl.data import EpisodeWriter, Leaf, Origin
from ksim_rl.data.dataset_storage import MASK_KEY
from ksim_rl.modules import ActorCfg, CriticCfg, make_actor, make_critic
from ksim_rl.objectives import DEMONSTRATION, VALUE_TARGET, BCAndValueLoss, BCCfg, BCLoss
from ksim_rl.testing.counter_env import CounterEnv
from ksim_rl.trainers import RunProgress, build, run
from ksim_rl.trainers.checkpoint import load_latest
from ksim_rl.trainers.restoring import load_networks
from tests.algorithms.imitation_problems import linear_demonstration, make_bc
from tests.trainers.target_env import make_trainer

SMALL = (
    "device=cpu",
    "num_envs=4",
    "task=cartpole_swingup",
    "task.sim.engine=c",
    "task.episode_length_s=0.1",
    "data.num_env_states_per_minibatch=16",
    "data.num_minibatches=2",
    "modules.actor.hidden_dims=[8]",
    "modules.critic.hidden_dims=[8]",
    "trainer.num_iterations=2",
    "trainer.eval_episodes=0",
    "trainer.video=false",
    "logger=none",
)


@pytest.mark.parametrize(
    ("loss", "std"), [("nll", 0.3), pytest.param("mse", 1.0, marks=pytest.mark.full)]
)
def test_a_linear_policy_is_found_and_with_nll_its_noise_too(loss, std):
    trainer = make_bc(
        iterations=8, cfg={"loss": loss, "num_epochs": 8, "anneal_learning_rate": True}
    )
    for _ in range(8):
        trainer.iterate()
    trainer.settle()
    head = trainer.update.actor[0].module.head
    expected = torch.tensor([[2.0, -1.0], [0.0, 1.0]])
    torch.testing.assert_close(head.loc.weight.detach(), expected, atol=0.03, rtol=0.0)
    torch.testing.assert_close(
        head.loc.bias.detach(), torch.tensor([0.5, 0.0]), atol=0.03, rtol=0.0
    )
    shown = TensorDict({"actor": torch.zeros(1, 2)}, [1])
    scale = trainer.update.actor.get_dist(shown).scale
    assert scale.flatten().tolist() == pytest.approx([std, std], abs=0.03)
    # Two numbers with the entropy of a normal distribution each, or the variance of the noise.
    entropy = 2 * math.log(0.3 * math.sqrt(2 * math.pi * math.e))
    # The held-out env states are 512 draws.
    least, width = {"nll": (entropy, 0.15), "mse": (0.09, 0.015)}[loss]
    assert trainer.metrics["loss/held_out"] == pytest.approx(least, abs=width)


def test_the_loss_is_the_stock_one_and_leaves_out_masked_rows():
    torch.manual_seed(0)
    actor = make_actor(ActorCfg(hidden_dims=(4,), obs_normalization=False), obs_dim=2, action_dim=2)
    rows_B = linear_demonstration(64, held_out=8).learned_N.clone()
    for kind, function in (("nll", None), ("mse", "mse")):
        loss = BCLoss(actor, loss=kind)(rows_B)["loss_bc"]
        dist = actor.get_dist(rows_B)
        if kind == "nll":
            expected = -dist.log_prob(rows_B["action"]).mean()
            assert loss == objectives.BCLoss(actor, loss_function=function)(rows_B)["loss_bc"]
        else:
            expected = (dist.mean - rows_B["action"]).square().mean()
        torch.testing.assert_close(loss, expected)
        # Half of the rows, with actions far off, do not count.
        spoilt_B = torch.cat([rows_B, rows_B])
        spoilt_B["action"][len(rows_B) :] = 1e6
        mask_B1 = torch.arange(len(spoilt_B))[:, None] < len(rows_B)
        spoilt_B[MASK_KEY] = mask_B1
        torch.testing.assert_close(BCLoss(actor, loss=kind)(spoilt_B)["loss_bc"], expected)


def test_statistics_of_a_recording_weigh_as_much_as_was_learned_from_it(monkeypatch):
    trainer = make_bc(iterations=3, normalizes=True)
    learned_N = trainer.update.demonstration.learned_N["actor"]
    normalizer = trainer.update.actor[0].module.normalizer
    # A recording of hours is not read again in each iteration.
    monkeypatch.setattr(normalizer, "count_rows", None)
    for iteration in range(3):
        assert int(normalizer.count) == (1 + iteration) * len(learned_N)
        trainer.iterate()
    torch.testing.assert_close(normalizer.mean, learned_N.mean(0))
    torch.testing.assert_close(normalizer.var, learned_N.var(0, unbiased=False))


def test_rows_that_are_masked_count_for_neither_loss():
    torch.manual_seed(0)
    actor = make_actor(ActorCfg(hidden_dims=(4,), obs_normalization=False), obs_dim=2, action_dim=2)
    critic = make_critic(CriticCfg(hidden_dims=(4,), obs_normalization=False), obs_dim=2)
    loss = BCAndValueLoss(BCLoss(actor), critic)
    recorded_B = linear_demonstration(64, held_out=8).learned_N.clone()
    size = len(recorded_B)
    rows = {"critic": torch.randn(size, 2), VALUE_TARGET: torch.randn(size, 1)}
    whole_B = TensorDict({**rows, DEMONSTRATION: recorded_B}, [size])
    expected = loss(whole_B)
    value_B1 = critic(whole_B.select("critic"))["state_value"]
    torch.testing.assert_close(
        expected["loss_critic"], (value_B1 - whole_B[VALUE_TARGET]).square().mean()
    )
    spoilt_B = torch.cat([whole_B, whole_B])
    spoilt_B[DEMONSTRATION, "action"][size:] = 1e6
    spoilt_B[VALUE_TARGET][size:] = 1e6
    spoilt_B[MASK_KEY] = torch.arange(2 * size)[:, None] < size
    found = loss(spoilt_B)
    for name in ("loss_bc", "loss_critic"):
        torch.testing.assert_close(found[name], expected[name])


@pytest.mark.full
def test_the_critic_learns_what_the_rollouts_return():
    """Each step is made to reward 1."""
    trainer = make_bc(cfg={"gamma": 0.5, "num_epochs": 4, "learning_rate": 0.02})
    env = trainer.collector.env
    step = env._step

    def rewarded(tensordict):
        following = step(tensordict)
        following["reward"].fill_(1.0)
        return following

    env._step = rewarded
    for _ in range(15):
        trainer.iterate()
    shown = TensorDict({"critic": trainer.collector.collect()["critic"].reshape(-1, 2)})
    values = trainer.update.critic(shown)["state_value"]
    # 1 + 1/2 + 1/4 + ..., where episodes go on.
    assert values.median().item() == pytest.approx(2.0, abs=0.1)


def test_a_policy_without_a_critic_is_a_start_that_says_so(tmp_path):
    update = make_trainer().update
    state = make_trainer().update.state_dict()
    alone = {name: value for name, value in state.items() if name != "critic"}
    before = {name: value.clone() for name, value in update.state_dict()["critic"].items()}
    assert "the critic starts from scratch" in load_networks(update, alone, tmp_path)
    assert load_networks(update, state, tmp_path) == ""
    for name, value in before.items():
        assert torch.equal(value, update.state_dict()["critic"][name]), name
    with pytest.raises(ValueError, match="no network 'actor'"):
        load_networks(update, {"critic": state["critic"]}, tmp_path)


def test_an_update_that_goes_on_from_its_state_is_the_same():
    first = make_bc(cfg={"num_epochs": 1})
    first.iterate()
    state = first.state_dict()
    again = make_bc(cfg={"num_epochs": 1}, seed=1)
    again.load_state_dict(state)
    for trainer in (first, again):
        torch.manual_seed(3)
        trainer.iterate()
    for name, value in first.update.state_dict()["actor"].items():
        assert torch.equal(value, again.update.state_dict()["actor"][name]), name


def write(folder, *, episodes=20, **changed):
    """Write episodes of a `CounterEnv` of 2 actions; some leaves may differ."""
    leaves = {("obs", "vector"): (3,), ("action",): (2,)} | changed.pop("leaves", {})
    made = [Leaf(key=key, shape=shape) for key, shape in leaves.items() if shape is not None]
    with EpisodeWriter(folder, made, origin=Origin(**changed)) as writer:
        for number in range(episodes):
            rows = {leaf.key: np.full((2, *leaf.shape), number, dtype=np.float32) for leaf in made}
            writer.append(rows)
    return folder


KEYS = [("obs", "vector"), "action"]


def read(folder, held_out=0.1):
    cpu = torch.device("cpu")
    return read_demonstration(folder, CounterEnv(), keys=KEYS, held_out=held_out, device=cpu)


def test_whole_episodes_are_held_out(tmp_path):
    found = read(write(tmp_path / "episodes"))
    assert found.held_out_N["action"][:, 0].tolist() == [9.0, 9.0, 19.0, 19.0]
    assert len(found.learned_N) == 36
    assert read(tmp_path / "episodes", held_out=0.0).held_out_N is None


def test_held_out_rows_that_are_not_finite_count_for_no_loss(tmp_path):
    folder = write(tmp_path / "episodes")
    path = folder / "env_states" / "obs" / "vector.memmap"
    vector_D3 = np.fromfile(path, dtype=np.float32).reshape(-1, 3)
    vector_D3[18, 1] = np.nan  # the first of the held-out rows
    vector_D3.tofile(path)
    held_out_N = read(folder).held_out_N
    assert held_out_N[MASK_KEY].flatten().tolist() == [False, True, True, True]
    held_out_N["actor"] = held_out_N["obs", "vector"]
    cfg = ActorCfg(hidden_dims=(4,), obs_normalization=False)
    loss = BCLoss(make_actor(cfg, obs_dim=3, action_dim=2))
    expected = loss(held_out_N[1:].exclude(MASK_KEY))["loss_bc"]
    torch.testing.assert_close(loss(held_out_N)["loss_bc"], expected)


@pytest.mark.parametrize(
    ("leaves", "message"),
    [
        ({("action",): None}, "it has no 'action'"),
        ({("obs", "vector"): (4,)}, r"its 'obs/vector' is float32 \[4\], and the env's"),
    ],
)
def test_leaves_that_do_not_fit_are_refused_by_name(tmp_path, leaves, message):
    folder = write(tmp_path / "episodes", leaves=leaves)
    with pytest.raises(ValueError, match=message) as refused:
        read(folder)
    assert str(folder) in str(refused.value)


def test_actions_that_are_choices_are_refused(tmp_path):
    env = CounterEnv()
    env.action_spec = OneHot(2, shape=(3, 2))
    cpu = torch.device("cpu")
    with pytest.raises(
        ValueError, match="are choices, and learning from recorded episodes is for continuous"
    ):
        read_demonstration(write(tmp_path / "episodes"), env, keys=KEYS, held_out=0.0, device=cpu)


def test_a_learning_rate_that_follows_a_divergence_is_refused():
    with pytest.raises(ValueError, match="use 'fixed'"):
        BCCfg(episodes="x", schedule="adaptive")


def test_a_run_learns_from_a_folder_and_ppo_goes_on_from_it(tmp_path):
    folder = tmp_path / "episodes"
    leaves = {("actor",): (5,), ("obs", "vector"): None, ("action",): (1,)}
    columns = {"actor": {"obs/position": (0, 3), "obs/velocity": (3, 5)}}
    write(folder, leaves=leaves, columns=columns)
    cfg = conf.compose([*SMALL, "objective=bc", f"objective.episodes={folder}"])
    outcome = run(cfg, tmp_path / "cloned", progress=RunProgress(2, enabled=False))
    assert outcome.iteration == 2

    ppo = build(conf.compose([*SMALL, f"checkpoint={tmp_path / 'cloned'}"]))
    cloned = build(dataclasses.replace(cfg, checkpoint=str(tmp_path / "cloned")))
    for network in ("actor", "critic"):
        own = ppo.update.state_dict()[network]
        for name, value in cloned.update.state_dict()[network].items():
            assert torch.equal(value, own[name]), name

    other = {"actor": {"obs/velocity": (0, 2), "obs/position": (2, 5)}}
    write(tmp_path / "other", leaves=leaves, columns=other)
    with pytest.raises(ValueError, match="objective.episodes=.*other"):
        build(conf.compose([*SMALL, "objective=bc", f"objective.episodes={tmp_path / 'other'}"]))
    assert data.read_episodes(folder).contents.num_episodes == 20


@pytest.mark.full
def test_fast_sac_goes_on_from_a_clone_of_its_kind(tmp_path):
    """Such a clone has no critic, and actions within its bounds only."""
    leaves = {("actor",): (5,), ("obs", "vector"): None, ("action",): (1,)}
    columns = {"actor": {"obs/position": (0, 3), "obs/velocity": (3, 5)}}
    # Actions are the numbers of the episodes.
    for episodes in (2, 3):
        write(tmp_path / str(episodes), episodes=episodes, leaves=leaves, columns=columns)
    cloning = [*SMALL, "objective=bc", "modules=fast_sac", "trainer.num_iterations=1"]
    with pytest.raises(ValueError, match=r"actions reach 2, and the policy stays within \[-1.0\]"):
        build(conf.compose([*cloning, f"objective.episodes={tmp_path / '3'}"]))
    cfg = conf.compose([*cloning, f"objective.episodes={tmp_path / '2'}"])
    cloned = run(cfg, tmp_path / "cloned", progress=RunProgress(1, enabled=False))
    assert cloned.iteration == 1

    start = f"checkpoint={tmp_path / 'cloned'}"
    replaying = [*SMALL, "objective=fast_sac", "data.num_minibatches=4", "data.capacity=20", start]
    trainer = build(conf.compose(replaying))
    assert any("data.policy_starts" in note for note in trainer.notes)
    saved = load_latest(tmp_path / "cloned").state["update"]["actor"]
    for name, value in trainer.update.actor.state_dict().items():
        assert torch.equal(value, saved[name]), name
    with pytest.raises(ValueError, match="its networks are others"):
        build(conf.compose([*SMALL, start]))
