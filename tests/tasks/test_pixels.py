"""Tasks that are seen: what their policy reads, and that each kind of algorithm trains on it."""

import json
import math
import re

import pytest
import torch

from ksim_rl import conf, envs
from ksim_rl.algorithms.ppo.wiring import build_networks
from ksim_rl.objectives import ShiftedPictures
from ksim_rl.scene.rendering.rendering import choose_gl_platform
from ksim_rl.tables.measure import run_cfg
from ksim_rl.tables.table import load
from ksim_rl.trainers import build
from ksim_rl.trainers.build import build_env
from tests.cli.test_train import run

TINY = [
    "task=cartpole_balance_pixels",
    "device=cpu",
    "logger=none",
    "num_envs=4",
    "task.scene.sensors.side.width=36",
    "task.scene.sensors.side.height=36",
    "trainer.num_iterations=2",
    "trainer.eval_episodes=0",
    "trainer.video=false",
]
PPO = ["data.num_env_states_per_minibatch=16", "data.num_minibatches=2"]
ALONE = ["modules.trunk=null", "modules.actor.in_keys=[actor]", "modules.critic.in_keys=[critic]"]
FAST_SAC = [
    "objective=fast_sac",
    "data.capacity=64",
    "data.num_env_states_per_minibatch=16",
    "data.learning_starts=2",
]
SEES = "+modules.actor.encoders.actor={spatial_softmax: true}"


def cart_column(rgb_EHWC):
    """The mean column of the cart, whose lower half is brighter than the floor, below the rail and the pole."""
    half_EW = rgb_EHWC[:, 53:57].int().amax(-1).amin(1)
    is_cart_EW = half_EW > 100
    counts_E = is_cart_EW.sum(-1)
    # Its front of 0.4 m is 1.45 m away, where 64 columns are 1.2 m.
    assert bool(((counts_E >= 20) & (counts_E <= 23)).all())
    return (is_cart_EW * torch.arange(64.0)).sum(-1) / counts_E


def test_its_policy_reads_three_pictures_40_ms_apart_and_nothing_else():
    env = envs.make("cartpole_balance_pixels", num_envs=2, seed=0)
    root = env.reset()
    frames_ENHWC = root["actor"]
    assert frames_ENHWC.shape == (2, 3, 64, 64, 3) and frames_ENHWC.dtype == torch.uint8
    assert "observations/actor (3, 64, 64, 3)" in env.base_env.explain()
    actor, critic = build_networks(conf.compose(["task=cartpole_balance_pixels"]), env)
    assert {*actor.in_keys, *critic.in_keys} - {"loc", "scale"} == {"actor"}
    first = cart_column(frames_ENHWC[:, -1])
    # The pole is orange up to its tip, which is in the picture.
    red_EHW, _, blue_EHW = frames_ENHWC[:, -1].int().unbind(-1)
    is_pole_EH = (red_EHW - blue_EHW > 60).any(-1)
    assert bool(is_pole_EH[:, 1:4].any(-1).all()) and not bool(is_pole_EH[:, 0].any())
    seen = [frames_ENHWC]
    for _ in range(15):
        _, root = env.step_and_maybe_reset(actor(root).set("action", torch.full((2, 1), 10.0)))
        seen.append(root["actor"])
    # A step takes 10 ms.
    for before, after in zip(seen, seen[4:], strict=False):
        assert torch.equal(after[:, :-1], before[:, 1:])
    # 10 N on 1.1 kg for 0.15 s are 0.1 m.
    moved_E = cart_column(root["actor"][:, -1]) - first
    assert bool(((moved_E > 4.0) & (moved_E < 7.0)).all())


@pytest.mark.full
def test_the_reachers_policy_sees_its_target_and_finger_where_they_are():
    env = envs.make("reacher_pixels", num_envs=8, seed=0)
    root = env.reset()
    for steps in (0, 3):
        # The second time around envs 0 to 3 have new targets, the others those that they had.
        if steps:
            is_reset = torch.arange(8)[:, None] < 4
            root = env.reset(root.clone().set("_reset", is_reset))
        rgb_EHWC = root["actor"][:, -1].int()
        red, green, blue = rgb_EHWC.unbind(-1)
        finger_E2 = env.base_env.view.site("finger").pos_EL[:, :2]
        target_E2 = env.base_env.view.command("target")
        assert pixels_apart((green > 90) & (red < 60), target_E2).max() < 0.8
        # An arm may lie above its ball, and a ball above the finger.
        apart_E = torch.linalg.vector_norm(finger_E2 - target_E2, dim=-1)
        seen_E = pixels_apart((red > 90) & (blue < 80) & (green < 190), finger_E2)
        assert seen_E[apart_E > 0.04].max() < 0.8


def pixels_apart(is_seen_EHW, place_E2):
    """How far the middle of some pixels is from a place in the plane of the finger, pixels."""
    count_E = is_seen_EHW.sum((1, 2))
    assert bool((count_E > 2).all())
    place_P = torch.arange(64.0)
    column_E = (is_seen_EHW.sum(1) * place_P).sum(-1) / count_E
    row_E = (is_seen_EHW.sum(2) * place_P).sum(-1) / count_E
    # 0.63 m below the lens, of 45 degrees in 64 pixels; rows run downwards.
    pixels_per_m = 32.0 / (0.63 * math.tan(math.radians(22.5)))
    x_E, y_E = place_E2.unbind(-1)
    return torch.hypot(column_E - 31.5 - pixels_per_m * x_E, row_E - 31.5 + pixels_per_m * y_E)


@pytest.mark.full
@pytest.mark.parametrize("name", load("pixels").groups()["blind"])
def test_the_blind_see_black(name):
    cfg = run_cfg(load("pixels").rows[name], 1, device="cpu", smoke=True)
    env = build_env(cfg, num_envs=2, seed=1)
    root = env.reset()
    pictures = [leaf for leaf in root.values(True, True) if leaf.dtype == torch.uint8]
    assert pictures
    for leaf in pictures:
        assert leaf.shape[-3:] == (64, 64, 3) and not leaf.any()


def test_a_policy_without_an_encoder_and_a_replay_without_memory_are_refused():
    with pytest.raises(ValueError, match="modules.trunk: in_keys: 'actor' is no vector"):
        build(conf.compose([*TINY, *PPO, "~modules.trunk.encoders.actor"]))
    # The trunk's features would take the place of a group of that name.
    group = "{terms: {joints: {term: {_target_: ksim_rl.mdp.JointPos}}}}"
    with pytest.raises(ValueError, match="modules.trunk: the env has an observation 'features'"):
        build(conf.compose([*TINY, *PPO, f"+task.observations.features={group}"]))
    with pytest.raises(ValueError, match="group 'actor' is an image.*objective.symmetry=none"):
        build(conf.compose([*TINY, *PPO, "objective.symmetry=augment"]))
    huge = ["objective=fast_sac", "data.capacity=10000000"]
    # Three frames now and next; a replay stores each frame once: 4 * 10^7 * 3888 bytes.
    with pytest.raises(ValueError, match="23,328 bytes of observations in each env.* 156 GB"):
        build(conf.compose([*TINY, *huge]))


KINDS = {
    "ppo": PPO,
    "recurrent": [*ALONE, *PPO, SEES, "modules.actor.obs_normalization=true", "data.sequence_length=4",
                  "+modules.recurrent_actor={kind: gru, hidden_dim: 8}"],
    "fast_sac": FAST_SAC,
}  # fmt: skip


@pytest.mark.full
def test_fast_sac_sees_with_settings_of_its_own(monkeypatch):
    moved = []
    monkeypatch.setattr(ShiftedPictures, "shift_", lambda _, minibatch_B: moved.append(minibatch_B))
    update = (trainer := build(conf.compose([*TINY, *FAST_SAC, "trainer.warm_up=false"]))).update
    trainer.train()
    # Both minibatches of the second iteration in one go.
    assert [minibatch_B["actor"].shape for minibatch_B in moved] == [(32, 3, 36, 36, 3)]
    assert update.replay.storage.content["actor"].shape[1:] == (36, 36, 3)
    env_states = update.replay.storage.get(torch.arange(4))
    assert env_states["next", "actor"].shape == (4, 3, 36, 36, 3)
    metrics = {name: float(value) for name, value in update.metrics().items()}
    assert metrics["replay/env_states"] == 8 and metrics["update/skipped_steps"] == 0
    assert metrics["loss/value"] > 0


@pytest.mark.full
@pytest.mark.parametrize("kind", KINDS)
def test_it_trains_with_effects_a_slow_camera_and_a_lag(kind):
    look = (
        "{_target_: ksim_rl.transforms.PictureEffects, in_keys: [actor], effects: {shift: "
        "{_target_: ksim_rl.transforms.RandomShift, pixels: 2}}}"
    )
    slow = (
        "{_target_: ksim_rl.transforms.ObservationHold, in_keys: [actor], every: 2, dropped: 0.1, "
        "fresh_key: [camera, fresh]}"
    )
    chain = [f"+task.transforms.look={look}", f"+task.transforms.slow={slow}"]
    # The flag is one more number that the policy reads, beside the features of pictures.
    where = "trunk" if kind == "ppo" else "actor"
    reads = f"modules.{where}.in_keys=[actor,[camera,fresh]]"
    trainer = build(conf.compose([*TINY, *KINDS[kind], reads, *chain]))
    before = [weight.clone() for weight in trainer.update.actor.parameters()]
    trainer.train()
    metrics = {name: float(value) for name, value in trainer.update.metrics().items()}
    assert metrics["update/skipped_steps"] == 0 and metrics["update/non_finite_env_states"] == 0
    after = list(trainer.update.actor.parameters())
    assert any(not torch.equal(a, b) for a, b in zip(before, after, strict=True))


@pytest.mark.full
def test_a_run_is_evaluated_resumed_exported_and_seen_by_mujoco(tmp_path, capsys):
    folder = tmp_path / "run"
    words = [word for word in TINY if "eval" not in word]
    words += [*PPO, "trainer.eval_episodes=2", "task.episode_length_s=0.2"]
    run("train", *words, f"hydra.run.dir={folder}")
    assert json.loads((folder / "evaluation.json").read_text())["episodes"] == 2
    assert run("resume", str(folder), "trainer.num_iterations=3") in (0, 1)
    pytest.importorskip("onnxscript", reason="needs the extra: pip install ksim_rl[export]")
    assert run("export", str(folder), "--episodes", "3", "--output", str(tmp_path / "export")) == 0
    try:
        choose_gl_platform()
    except RuntimeError as error:
        pytest.skip(f"no OpenGL here: {error}")
    capsys.readouterr()
    assert run("sim2sim", str(tmp_path / "export"), "--episodes", "3") == 0
    said = capsys.readouterr().out
    # Both renderers see the same, edges apart.
    assert float(re.search(r"camera side: ([0-9.]+)% of pixels", said)[1]) < 2.0
    assert float(re.search(r"return ratio ([0-9.]+)", said)[1]) == pytest.approx(1.0, abs=0.01)
    # A camera that differs from training's is named.
    model = tmp_path / "export" / "robot.xml"
    moved = re.sub(r'(<camera name="side"[^>]* pos=")[^"]*', r"\g<1>0 -3 4", model.read_text())
    assert moved != model.read_text()
    model.write_text(moved)
    code = run("sim2sim", str(tmp_path / "export"), "--episodes", "3")
    said = capsys.readouterr()
    assert code == 1 and "picture: camera 'side'" in said.out, said
