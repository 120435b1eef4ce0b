"""N iterations at a stretch equal N/2, a checkpoint, and N/2 in new objects: every tensor, bit for bit."""

import json
import subprocess
import sys

import pytest
import torch

from ksim_rl import conf
from ksim_rl.algorithms.gradient_steps import DatasetUpdate
from ksim_rl.device import state_tree
from ksim_rl.trainers import build, checkpoint
from tests.trainers.target_env import MemoryLogger, make_trainer


def parts(trainer):
    tensors, values = state_tree.split(trainer.state_dict())
    del values["/seconds"]
    return tensors, values


def trained(*args, **options):
    """Make and train; torch's global generator starts over with each."""
    trainer = make_trainer(*args, **options)
    trainer.train()
    return trainer


def assert_same(one, other):
    (tensors, values), (other_tensors, other_values) = parts(one), parts(other)
    assert values == other_values
    assert tensors.keys() == other_tensors.keys()
    differ = [name for name in tensors if not torch.equal(tensors[name], other_tensors[name])]
    assert differ == []


def test_a_resumed_run_is_bit_identical(tmp_path):
    straight = trained(iterations=6)
    trained(tmp_path, iterations=3)
    # Another seed: all of it must come from the checkpoint.
    resumed = make_trainer(iterations=6, seed=123)
    resumed.load(tmp_path)
    assert resumed.iteration == 3
    resumed.train()
    assert_same(straight, resumed)


@pytest.mark.parametrize("ppo", [{"desired_kl": 1e3}, {"schedule": "fixed"}], ids=str)
def test_an_annealed_run_ends_near_zero_and_resumes_with_the_same_rates(tmp_path, ppo):
    ppo = {**ppo, "learning_rate": 3e-3, "learning_rate_max": 3e-3, "anneal_learning_rate": True}
    straight_log, resumed_log = MemoryLogger(), MemoryLogger()
    straight = trained(iterations=6, ppo=ppo, loggers=[straight_log])
    half = make_trainer(tmp_path, iterations=6, ppo=ppo)
    for _ in range(3):
        half.iterate()
    half.save()
    resumed = make_trainer(iterations=6, seed=123, ppo=ppo, loggers=[resumed_log])
    resumed.load(tmp_path)
    resumed.train()
    assert_same(straight, resumed)
    rates, rates_after = (
        [row["update/learning_rate"] for row in log.rows if "update/learning_rate" in row]
        for log in (straight_log, resumed_log)
    )
    assert rates == pytest.approx([3e-3 * left / 6 for left in (6, 5, 4, 3, 2, 1)], rel=1e-6)
    assert rates_after == rates[3:]


@pytest.mark.parametrize("ppo", [{"desired_kl": 1e3}, {"schedule": "fixed"}], ids=str)
def test_a_run_that_is_not_annealed_is_the_same_as_one_that_knows_no_progress(ppo, monkeypatch):
    trainer = trained(iterations=3, ppo=ppo)
    monkeypatch.setattr(DatasetUpdate, "set_progress", lambda *_: None)
    assert_same(trainer, trained(iterations=3, ppo=ppo))


IN_A_NEW_PROCESS = """
import pathlib, sys
from tests.trainers.target_env import make_trainer
folder = pathlib.Path(sys.argv[1])
trainer = make_trainer(folder, iterations=4, seed=9)
trainer.load(folder)
trainer.train()
"""


@pytest.mark.full
def test_a_run_resumed_in_a_new_process_is_bit_identical(tmp_path):
    straight = trained(iterations=4)
    trained(tmp_path, iterations=2)
    subprocess.run([sys.executable, "-c", IN_A_NEW_PROCESS, str(tmp_path)], check=True)
    resumed = make_trainer(seed=77)
    resumed.load(tmp_path)
    assert_same(straight, resumed)


def test_saving_does_not_change_the_run(tmp_path):
    assert_same(trained(iterations=3), trained(tmp_path, iterations=3, checkpoint_interval=1))


def test_evaluating_does_not_change_the_run():
    assert_same(trained(iterations=3), trained(iterations=3, eval_interval=1))


def test_a_checkpoint_of_version_1_resumes_bit_for_bit(tmp_path):
    straight = trained(iterations=4)
    trained(tmp_path, iterations=2)
    manifest_path = checkpoint.load_latest(tmp_path).path / checkpoint.MANIFEST
    manifest = json.loads(manifest_path.read_text())["manifest"]
    # What version 1 did not have; its config was sorted by name.
    for path in ("/hooks", "/update/recurrent_state"):
        del manifest["values"][path]
    manifest |= {"format_version": 1}
    manifest_path.write_bytes(checkpoint._seal(json.loads(json.dumps(manifest, sort_keys=True))))
    resumed = make_trainer(iterations=4, seed=123)
    resumed.load(tmp_path)
    resumed.train()
    assert_same(straight, resumed)


def test_a_checkpoint_of_another_network_is_refused_with_both_shapes(tmp_path):
    make_trainer(tmp_path, iterations=1).train()
    saved = checkpoint.load_latest(tmp_path)
    name = next(
        name for name, tensor in saved.state["update"]["actor"].items() if tensor.shape == (16, 1)
    )
    saved.state["update"]["actor"][name] = torch.zeros(32, 1)
    with pytest.raises(
        ValueError, match=r"actor: .* float32\[32, 1\] in the checkpoint and float32\[16, 1\]"
    ):
        make_trainer().load_state_dict(saved.state)


def test_a_checkpoint_of_other_observations_is_refused(tmp_path):
    make_trainer(tmp_path, iterations=1).train()
    saved = checkpoint.load_latest(tmp_path)
    saved.state["observation_columns"] = {"actor": {"obs/height": [0, 1]}}
    with pytest.raises(
        ValueError, match="other observations: .*only the checkpoint has obs/height"
    ):
        make_trainer().load_state_dict(saved.state)


def test_a_checkpoint_of_another_transform_is_refused_and_its_networks_still_fit(tmp_path):
    trained(tmp_path, iterations=2)
    saved = checkpoint.load_latest(tmp_path)
    env = saved.state["env"]
    name = next(name for name in env if name.startswith("transform."))
    saved.state["env"] = {other: value for other, value in env.items() if other != name}
    with pytest.raises(ValueError, match="another env.*ksim-rl train checkpoint=RUN"):
        make_trainer().load_state_dict(saved.state)
    fresh = make_trainer(seed=5)
    fresh.load_weights(tmp_path)
    assert fresh.iteration == 0
    for key, value in fresh.update.actor.state_dict().items():
        assert torch.equal(value, saved.state["update"]["actor"][key])


def test_what_an_env_refuses_of_a_checkpoint_is_said_with_the_way_out(tmp_path, monkeypatch):
    trained(tmp_path, iterations=1)
    trainer = make_trainer()

    def refuse(*_, **__):
        raise ValueError("state of an env: the checkpoint has no 'clock'")

    monkeypatch.setattr(trainer.collector.env, "load_state_dict", refuse)
    with pytest.raises(
        ValueError, match="another env.* has no 'clock'. Its networks.*train checkpoint=RUN"
    ):
        trainer.load_state_dict(checkpoint.load_latest(tmp_path).state)


def test_a_resumed_run_in_real_physics_is_bit_identical(tmp_path):
    overrides = [
        "task=cartpole_swingup",
        "num_envs=8",
        "data.num_env_states_per_minibatch=32",
        "trainer.eval_episodes=0",
    ]
    overrides += [
        "modules.actor.hidden_dims=[8]",
        "modules.critic.hidden_dims=[8]",
        "task.episode_length_s=0.1",
    ]

    def run(iterations, *, seed=1, load=None, folder=None):
        trainer = build(
            conf.compose([*overrides, f"seed={seed}", f"trainer.num_iterations={iterations}"])
        )
        trainer.folder = folder
        if load is not None:
            trainer.load(load)
        trainer.train()
        return trainer

    straight = run(4)
    run(2, folder=tmp_path)
    columns = checkpoint.load_latest(tmp_path).state["observation_columns"]["actor"]
    assert [start for start, _ in columns.values()][1:] == [stop for _, stop in columns.values()][
        :-1
    ]
    assert_same(straight, run(4, seed=5, load=tmp_path))
