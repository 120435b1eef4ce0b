"""What a motion looks like to an env, against the motion's own numbers and MuJoCo's C engine."""

import dataclasses

import mujoco
import numpy as np
import pytest
import torch

from ksim_rl import envs
from ksim_rl.mdp import ResetToMotion, motion_observations
from ksim_rl.mdp.motion_observations import observe_motion
from ksim_rl.scene.motions import MotionSet, motion_path
from ksim_rl.scene.robots.control_models import Walker
from ksim_rl.transforms.innermost import innermost


@pytest.fixture(scope="module")
def env():
    return envs.make("walker_amp", num_envs=2, seed=0, overrides=["task.sim.engine=c"])


def test_each_row_is_the_motion_one_env_step_later(env):
    (seen_FL,) = observe_motion(env, group="style", file="walker_walk")
    motion = np.load(motion_path("walker_walk"))
    model = Walker().spec().compile()
    data = mujoco.MjData(model)
    # An env step lasts as long as a frame.
    assert innermost(env).step_dt == pytest.approx(1.0 / motion["fps"])
    assert seen_FL.shape == (len(motion["qpos"]), 19)
    names = [model.joint(i).name for i in range(model.njnt)]
    shown = [i for i, name in enumerate(names) if name == "root_z" or not name.startswith("root")]
    torso = model.body("torso").id
    for row, qpos, qvel in zip(
        seen_FL.double().numpy(), motion["qpos"], motion["qvel"], strict=True
    ):
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        gravity = data.xmat[torso].reshape(3, 3).T @ [0.0, 0.0, -1.0]
        expected = np.concatenate([gravity, qpos[shown], qvel])
        # The times of later frames are rounded to some microseconds.
        np.testing.assert_allclose(row, expected, atol=5e-4)


def test_the_env_stays_as_it_was(env):
    env.reset()
    before = {
        name: torch.as_tensor(value).clone() for name, value in env.base_env.state_dict().items()
    }
    observe_motion(env, group="style", file="walker_walk")
    after = env.base_env.state_dict()
    assert all(torch.equal(value, torch.as_tensor(after[name])) for name, value in before.items())


def test_each_clip_that_is_not_held_out_is_observed_by_itself(env, tmp_path, monkeypatch):
    (whole_FL,) = observe_motion(env, group="style", file="walker_walk")
    motion = dict(np.load(motion_path("walker_walk")))
    # In float32 the 0.78 s of the first are no 39 steps of 0.02 s.
    places = {"a": slice(0, 40), "b": slice(50, 63), "c": slice(100, 104)}
    for name, place in places.items():
        cut = {key: motion[key][place] for key in ("qpos", "qvel")}
        np.savez(tmp_path / f"{name}.npz", **{**motion, **cut})
    # Two rounds of env steps, the second of which begins inside of a clip.
    monkeypatch.setattr(motion_observations, "MOST_ENVS", 16)
    seen = observe_motion(env, group="style", file=str(tmp_path))
    assert [len(seen_FL) for seen_FL in seen] == [40, 13, 4]
    for place, seen_FL in zip(places.values(), seen, strict=True):
        torch.testing.assert_close(seen_FL, whole_FL[place], atol=1e-3, rtol=0)
    cfg = innermost(env).cfg
    motions = {"clips": MotionSet(sources=(str(tmp_path),), held_out=("b",))}
    scene = dataclasses.replace(cfg.scene, motions=motions)
    reads = {"reset": ResetToMotion(file="clips")}
    sim = dataclasses.replace(cfg.sim, engine="c")
    ours = envs.build(dataclasses.replace(cfg, scene=scene, events=reads, sim=sim))
    first_FL, last_FL = observe_motion(ours, group="style", file="clips")
    torch.testing.assert_close(first_FL, seen[0], atol=1e-5, rtol=0)
    torch.testing.assert_close(last_FL, seen[2], atol=1e-5, rtol=0)


def test_a_motion_must_last_an_env_step(env, tmp_path):
    motion = dict(np.load(motion_path("walker_walk")))
    motion |= {"qpos": motion["qpos"][:2], "qvel": motion["qvel"][:2], "fps": np.array(500.0)}
    np.savez(tmp_path / "short.npz", **motion)
    with pytest.raises(ValueError, match="short lasts 0.002 s, less than an env step of 0.02 s"):
        observe_motion(env, group="style", file=str(tmp_path / "short.npz"))
