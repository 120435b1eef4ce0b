"""`ksim-rl play` refuses what it cannot show before anything compiles, and shows agents without a policy."""

import pytest
import torch

from ksim_rl.cli.main import main
from ksim_rl.envs import ManagerBasedRlEnv, make_cfg
from ksim_rl.viewer.play_command import addresses
from ksim_rl.viewer.session import showing_motion


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["task=cartpole_swingup"], "task=NAME with --agent zero or random"),
        (["num_envs=4", "--agent", "zero"], "'num_envs=4': expected a run folder, or task=NAME"),
        (["task=cartpole_swingupp", "--agent", "zero"], "did you mean 'cartpole_swingup'"),
        (["RUN", "--live", "--seconds", "3"], "--seconds: of a video"),
        (["RUN", "--live", "--fps", "3", "--output", "a.mp4"], "--fps, --output: of a video"),
        (["RUN", "--fps", "0"], "--fps=0.0: expected a finite number in (0.0, inf)"),
        (["RUN", "--seconds", "-1"], "--seconds=-1.0: expected a finite number in (0.0, inf)"),
        (["RUN", "--num-envs", "0"], "--num-envs=0: expected a whole number >= 1"),
        (
            ["num_envs=2", "--motion", "walker_walk"],
            "--motion walker_walk: name a task with the motion's robot",
        ),
        (
            ["task=walker_track", "--motion", "walker_walk", "--agent", "zero"],
            "nothing acts in a motion",
        ),
        (["RUN", "--motion", "g1_walk", "--agent", "zero"], "nothing acts in a motion"),
        (["RUN", "--record", "driven"], "--record: of a viewer, in which one drives: add --live"),
        (["RUN", "--live", "--record", "tests"], "--record tests: it holds something"),
        (["RUN", "--live", "--record", "x", "--num-envs", "2"], "one env is driven"),
        (
            ["task=walker_track", "--motion", "walker_walk", "--live", "--record", "x"],
            "--record with --motion walker_walk: nothing acts in a motion",
        ),
        (["RUN", "--output", "clip.avi"], "ends in .mp4 or .gif"),
    ],
)
def test_what_cannot_be_shown_is_refused_in_one_line(words, said, capsys):
    with pytest.raises(SystemExit) as ended:
        main(["play", *words])
    assert ended.value.code == 2
    assert said in capsys.readouterr().err


def test_the_window_is_refused_without_a_display(monkeypatch, capsys):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(SystemExit) as ended:
        main(["play", "task=cartpole_swingup", "--agent", "zero", "--viewer", "native"])
    assert ended.value.code == 2
    assert "--viewer native: no display to open a window on" in capsys.readouterr().err


def test_both_ports_are_forwarded():
    lines = addresses("http://127.0.0.1:8090", "http://127.0.0.1:8092")
    assert "ssh -N -L 8090:127.0.0.1:8090 -L 8092:127.0.0.1:8092 THIS_MACHINE" in lines[1]


@pytest.mark.parametrize("task", ["walker_track", "walker_walk"])
def test_a_motion_is_shown_exactly_from_frame_to_frame(task):
    cfg = make_cfg(task, ["task.scene.num_envs=2", "task.sim.engine=c"])
    env = ManagerBasedRlEnv(showing_motion(cfg, "walker_walk"))
    motion = env.view.motion("walker_walk")
    root_E = env.reset()
    for step in range(4):
        qpos_EL, qvel_EL = motion.sample(torch.full((2,), step * env.step_dt))
        torch.testing.assert_close(env.world.qpos_EL, qpos_EL)
        torch.testing.assert_close(env.world.qvel_EL, qvel_EL)
        torch.testing.assert_close(
            env.view.bodies("torso").pos_EN3[:, 0, 0], qpos_EL[:, 0], atol=1e-5, rtol=0
        )
        _, root_E = env.step_and_maybe_reset(root_E.set("action", env.action_spec.rand()))
