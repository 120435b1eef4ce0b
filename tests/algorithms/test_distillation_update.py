"""Distillation: a linear teacher is found exactly, states that only the student visits are learned, resume is exact."""

import shutil

import pytest
import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type

from ksim_rl import conf
from ksim_rl.algorithms.distillation.update import DistillationUpdate
from ksim_rl.device import state_tree
from ksim_rl.modules import ActorCfg, make_actor
from ksim_rl.testing import count_syncs
from ksim_rl.trainers import (
    RunCfg,
    RunProgress,
    build,
    checkpoint,
    load_policy,
    run,
)
from tests.algorithms.imitation_problems import (
    GAIN,
    DriftEnv,
    EchoEnv,
    linear_teacher,
    make_distillation,
)

BINNED = {"loss": "kl", "learning_rate": 0.05, "teacher_share": 0.0}


def played(actor, steps=12):
    """Return how far off the offsets are in the last steps of episodes without noise, [E]."""
    env = DriftEnv(64)
    env.set_seed(99)
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        rollout_ET = env.rollout(steps, actor, break_when_any_done=False)
    return rollout_ET["privileged"][:, -4:, 0].abs().mean(1)


def test_a_linear_student_becomes_its_linear_teacher():
    for loss in ("mse", "kl"):
        trainer = make_distillation(cfg={"loss": loss})
        old = trainer.update
        torch.manual_seed(3)
        student = make_actor(
            ActorCfg(
                in_keys=("privileged",), hidden_dims=(), obs_normalization=False, output_gain=1.0
            ),
            obs_dim=1,
            action_dim=1,
        )
        trainer.update = DistillationUpdate(
            old.cfg, actor=student, teacher=old.teacher, data=old.dataset.cfg
        )
        trainer.collector.policy = trainer.update.behavior
        trainer.collector._keys = trainer.update.rollout_keys
        for _ in range(8):
            trainer.iterate()
        head = student[0].module.head
        assert head.loc.weight.item() == pytest.approx(-GAIN, abs=0.02), loss
        assert head.loc.bias.item() == pytest.approx(0.0, abs=0.02), loss
        std = student(trainer.collector.collect()[:, 0].select("privileged"))["scale"].mean().item()
        # Its teacher's, where the distributions are compared; else as it was.
        assert std == pytest.approx({"kl": 0.3, "mse": 1.0}[loss], abs=0.05)


def test_dagger_stays_on_the_road_that_behavior_cloning_drifts_off():
    cloned = make_distillation(
        iterations=12, cfg={**BINNED, "teacher_share": 1.0, "teacher_share_decay": 1.0}
    )
    visited = make_distillation(iterations=12, cfg=BINNED)
    mixed = make_distillation(
        iterations=12, cfg={**BINNED, "teacher_share": 0.8, "teacher_share_decay": 0.7}
    )
    for trainer in (cloned, visited, mixed):
        trainer.train()
    # On its own data each does what the teacher does.
    assert cloned.metrics["update/action_error"] < 0.05
    assert visited.metrics["update/action_error"] < 0.15
    off = {
        name: played(t.update.actor)
        for name, t in (("cloned", cloned), ("visited", visited), ("mixed", mixed))
    }
    assert off["cloned"].mean() > 0.4, "what cloning has not seen it must not know"
    # Half a bin is 0.1; a step makes it 0.13.
    assert off["visited"].max() < 0.15
    assert off["mixed"].max() < 0.15
    assert mixed.metrics["update/teacher_share"] == pytest.approx(0.8 * 0.7**12, rel=1e-5)


def test_a_student_that_sees_its_own_last_action_does_not_drive_it_up_before_it_knows_anything():
    student = ActorCfg(hidden_dims=(32,), output_gain=1.0)
    trainer = make_distillation(
        iterations=30,
        cfg={"loss": "mse", "learning_rate": 1e-2},
        student=student,
        env=EchoEnv,
        teacher=linear_teacher(-0.9),
    )
    trainer.train()
    # The teacher's actions are of order 0.1; a normalizer that has seen 1e6 shows the student nothing.
    assert trainer.update.actor[0].module.normalizer.var.max() < 100.0
    assert trainer.metrics["update/action_error"] < 0.02


@pytest.mark.parametrize("cfg", [BINNED, {"loss": "mse", "teacher_share": 0.5}], ids=["kl", "mse"])
def test_an_update_makes_no_host_sync_and_skips_what_is_not_finite(cfg):
    trainer = make_distillation(cfg=cfg)
    update = trainer.update
    for _ in range(2):
        trainer.iterate()
    with count_syncs() as syncs:
        rollout_ET = trainer.collector.collect()
        update(rollout_ET)
        update.metrics()
    assert syncs.total == 0, syncs.report()
    rollout_ET["privileged"][3, 2] = float("nan")
    update(rollout_ET)
    assert update.metrics()["update/non_finite_env_states"] == 1
    assert all(value.isfinite() for value in update.metrics().values())
    head = update.actor[0].module.head
    before = {name: parameter.clone() for name, parameter in head.named_parameters()}
    with torch.no_grad():
        head.loc.bias.fill_(float("nan"))
    update(rollout_ET)
    assert update.metrics()["update/skipped_in_a_row"] == 16
    after = dict(head.named_parameters())
    assert all(torch.equal(before[name], after[name]) for name in before if name != "loc.bias")


def assert_same(one, other):
    (tensors, values), (others, other_values) = (
        state_tree.split(t.state_dict()) for t in (one, other)
    )
    for found in (values, other_values):
        del found["/seconds"]
    assert values == other_values and tensors.keys() == others.keys()
    assert [name for name in tensors if not torch.equal(tensors[name], others[name])] == []


def test_a_resumed_run_is_bit_identical_and_has_its_teacher_with_it(tmp_path):
    cfg = {**BINNED, "teacher_share": 0.5}
    straight = make_distillation(iterations=4, cfg=cfg)
    straight.train()
    make_distillation(tmp_path, iterations=2, cfg=cfg).train()
    resumed = make_distillation(iterations=4, seed=9, cfg=cfg, teacher=linear_teacher(gain=5.0))
    resumed.load(tmp_path)
    resumed.train()
    assert_same(straight, resumed)


# -- runs in physics -------------------------------------------------------------------------------------------------

SMALL = [
    "task=cartpole_balance",
    "device=cpu",
    "logger=none",
    "num_envs=4",
    "data.num_env_states_per_minibatch=16",
    "data.num_minibatches=2",
    "modules.actor.hidden_dims=[8]",
    "modules.critic.hidden_dims=[8]",
    "trainer.num_threads=1",
    "trainer.eval_episodes=0",
    "trainer.checkpoint_interval=0",
    "trainer.video=false",
]
# The student sees noisy positions with a history, and the teacher what its own run showed it.
STUDENT = [
    *SMALL,
    "objective=distillation",
    "modules.actor.in_keys=[student]",
    "+task.observations.student.terms=${task.observations.actor.terms}",
    "+task.observations.student.history=3",
]


@pytest.fixture(scope="module")
def teacher_run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("teacher") / "run"
    cfg = conf.compose([*SMALL, "modules.actor.in_keys=[critic]", "trainer.num_iterations=1"])
    run(cfg, folder, progress=RunProgress(1, enabled=False))
    return folder


def compose(teacher, *overrides, iterations=2):
    overrides = [
        *STUDENT,
        f"objective.teacher={teacher}",
        f"trainer.num_iterations={iterations}",
        *overrides,
    ]
    return conf.compose(overrides)


@pytest.mark.parametrize("modules", [pytest.param("mlp", marks=pytest.mark.full), "gru"])
def test_a_student_of_a_run_goes_on_without_the_folder_of_its_teacher(
    modules, teacher_run, tmp_path
):
    teacher = tmp_path / "teacher"
    shutil.copytree(teacher_run, teacher)
    memory = ["modules.recurrent_actor.hidden_dim=6"] if modules == "gru" else []
    chosen = [f"modules={modules}", *memory]
    straight = build(compose(teacher, *chosen, iterations=3))
    straight.train()
    folder = tmp_path / "student"
    run(compose(teacher, *chosen), folder, progress=RunProgress(1, enabled=False))
    shutil.rmtree(teacher)
    saved = checkpoint.load_latest(folder)
    # A run names the engine that `auto` chose.
    assert RunCfg.from_tree(saved.config) == compose(teacher, *chosen, "task.sim.engine=warp")
    cfg = compose(teacher, *chosen, iterations=3)
    resumed = build(cfg, resume_from=saved)
    resumed.train()
    assert_same(straight, resumed)
    taught = load_policy(teacher_run, device="cpu").actor.state_dict()
    kept = resumed.update.teacher.policy.state_dict()
    assert all(torch.equal(taught[name], kept[name]) for name in taught), "the teacher is frozen"
    policy = load_policy(folder, device="cpu").actor
    assert "student" in policy.in_keys and "critic" not in policy.in_keys
    with pytest.raises(ValueError, match="no checkpoint here"):
        build(cfg)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (
            ["~task.observations.critic.terms.velocity"],
            "objective.teacher=.*group 'critic': only the checkpoint has obs/velocity",
        ),
        (
            ["~task.observations.critic", "modules.critic.in_keys=[student]"],
            "the teacher reads 'critic', and this env shows .*'student'",
        ),
        (["objective.loss=mse", "modules.actor.distribution=categorical"], "categorical"),
    ],
)
def test_a_teacher_that_does_not_fit_is_refused(overrides, message, teacher_run):
    with pytest.raises(ValueError, match=message):
        build(compose(teacher_run, *overrides))


def test_a_teacher_with_a_memory_is_refused(tmp_path):
    trainer = build(conf.compose([*SMALL, "modules=gru", "modules.recurrent_actor.hidden_dim=6"]))
    trainer.folder = tmp_path / "checkpoint"
    trainer.iterate()
    trainer.save()
    with pytest.raises(ValueError, match="the teacher is recurrent"):
        build(compose(tmp_path, "objective.num_epochs=1"))
