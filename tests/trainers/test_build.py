"""What a run builds: envs with room for all contacts and rows."""

import dataclasses

import torch

from ksim_rl import conf
from ksim_rl.envs import ManagerBasedRlEnv
from ksim_rl.envs.contract import part
from ksim_rl.physics import capacity, engine_choice
from ksim_rl.trainers.build import build
from tests.envs.test_room import sled_env
from tests.trainers.test_trainer import Notes


def test_a_run_whose_envs_need_more_room_gets_it_before_training_and_says_so(monkeypatch):
    monkeypatch.setattr(capacity, "_cache", {})
    overrides = ["task=cartpole_balance", "num_envs=8", "device=cpu", "trainer.num_iterations=1"]
    overrides += ["data.num_env_states_per_minibatch=32", "trainer.eval_episodes=4"]
    overrides += ["trainer.matmul_precision=high"]
    cfg = dataclasses.replace(conf.compose(overrides), task=sled_env(num_envs=8).cfg)
    trainer, notes = build(cfg), Notes()
    # Products and convolutions have switches of their own.
    assert torch.get_float32_matmul_precision() == "high"
    assert torch.backends.cudnn.allow_tf32 and torch.backends.cudnn.deterministic
    trainer.train(notes)
    assert [note for note in notes.notes if "njmax 8 -> " in note and "nconmax 8 -> " in note]
    assert not [note for note in notes.notes if "warning" in note], notes.notes
    for env in (trainer.collector.env, trainer.evaluator.env):
        base = part(env, ManagerBasedRlEnv)
        assert base.world.njmax >= 48 and base.world.nconmax >= 12
    assert trainer.metrics["physics/nefc_share"] < 1.0


def test_evaluations_and_checkpoints_keep_the_engine_that_was_chosen_for_training(monkeypatch):
    monkeypatch.setattr(engine_choice, "LEAST_DOFS", 1)
    monkeypatch.setattr(engine_choice, "LEAST_WORLDS", 8)
    overrides = ["task=cartpole_balance", "num_envs=8", "device=cpu", "trainer.eval_episodes=4"]
    overrides += ["data.num_env_states_per_minibatch=32", "trainer.matmul_precision=highest"]
    trainer = build(conf.compose(overrides))
    assert not torch.backends.cudnn.allow_tf32
    for env in (trainer.collector.env, trainer.evaluator.env):
        # Alone, the four of the evaluation would be too few for C.
        assert part(env, ManagerBasedRlEnv).world.engine == "c"
    assert trainer.config["task"]["sim"]["engine"] == "c"
    overrides += ["collector.compile=true", "trainer.eval_episodes=0", "trainer.num_iterations=1"]
    compiled, notes = build(conf.compose(overrides)), Notes()
    assert part(compiled.collector.env, ManagerBasedRlEnv).world.engine == "warp"
    compiled.train(notes)
    assert [
        note
        for note in notes.notes
        if note.startswith("collector.compile=true: MuJoCo Warp simulates")
    ]
