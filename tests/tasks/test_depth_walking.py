"""Go1 that sees the ground by a depth camera: what its student reads, and how it learns from a teacher that knows."""

import math

import pytest
import torch

from ksim_rl import conf, envs
from ksim_rl.runs.csv_table import read_table
from ksim_rl.tasks.depth_walking import go1_depth_rough
from ksim_rl.tasks.velocity_flat import go1_velocity_rough
from ksim_rl.trainers.run_cfg import RunCfg
from tests.absent_models import skipped_without_models
from tests.cli.test_train import run

TINY = [
    "device=cpu",
    "logger=none",
    "num_envs=8",
    "task.scene.terrain.num_levels=2",
    "task.scene.terrain.num_columns=8",
    "data.num_env_states_per_minibatch=32",
    "data.num_minibatches=2",
    "trainer.num_iterations=2",
    "trainer.eval_episodes=0",
    "trainer.video=false",
]


def test_the_student_reads_no_heights_and_the_teacher_what_it_learned_with():
    cfg, known = go1_depth_rough(), go1_velocity_rough()
    assert cfg.observations["actor"] == known.observations["actor"]
    assert cfg.observations["critic"] == known.observations["critic"]
    student = cfg.observations["student"]
    assert known.observations["actor"].terms.keys() - student.terms.keys() == {"height_scan"}
    # The networks of a student stay what they are when it is distilled.
    words = ["task=go1_depth_rough", "objective=distillation", "objective.teacher=RUN"]
    composed = conf.compose(words)
    assert isinstance(composed, RunCfg)
    assert composed.modules.observation_keys("actor") == ["student", ("camera", "fresh"), "depth"]
    assert composed.modules.recurrent_actor is not None


@pytest.mark.full
def test_the_camera_is_slow_late_and_sees_the_ground():
    with skipped_without_models():
        env = envs.make("go1_depth_rough", num_envs=8, seed=0)
    root = env.reset()
    first_EHW = root["depth"].clone()
    assert first_EHW.shape == (8, 48, 64) and first_EHW.dtype == torch.float32
    # The lower half is the ground, about 0.3 m below and not farther than 3 m; one block in twenty has no reading.
    ground_EHW = first_EHW[:, 30:]
    holes = (ground_EHW == 0.0).float().mean()
    assert 0.02 < holes < 0.15
    assert 0.2 < float(ground_EHW[ground_EHW > 0.0].median()) < 1.0
    fresh = []
    for _ in range(60):
        action = torch.zeros(8, 12)
        _, root = env.step_and_maybe_reset(root.set("action", action))
        fresh.append(root["camera", "fresh"])
    fresh_ET = torch.stack(fresh, 1)[..., 0]
    # Of 50 steps per second 15 show a new picture.
    assert float(fresh_ET.mean()) == pytest.approx(0.3, abs=0.05)
    env.close()


@pytest.mark.full
def test_a_student_learns_from_a_teacher(tmp_path):
    with skipped_without_models():
        run("train", "task=go1_velocity_rough", *TINY, f"hydra.run.dir={tmp_path / 'teacher'}")
    words = [
        "task=go1_depth_rough",
        "objective=distillation",
        f"objective.teacher={tmp_path / 'teacher'}",
        *(word for word in TINY if word != "logger=none"),
        "logger=local",
    ]
    run("train", *words, f"hydra.run.dir={tmp_path / 'student'}")
    _, rows = read_table(tmp_path / "student" / "metrics.csv")
    losses = [float(row["loss/distillation"]) for row in rows]
    assert len(losses) == 2 and all(math.isfinite(loss) and loss > 0.0 for loss in losses)
    assert float(rows[-1]["update/skipped_steps"]) == 0
