"""A world of an env that fails is cleared at once, and what led there is saved all the same."""

import numpy as np
import torch

from ksim_rl.physics import NanGuardCfg, SimCfg
from ksim_rl.physics.nan_guard import failures as nan_file
from ksim_rl.physics.nan_guard import replay
from tests.envs.probe_env import DECIMATION, puck_env, push


def test_a_failed_env_ends_and_leaves_its_last_substeps(tmp_path):
    env = puck_env(limit=None, sim=SimCfg(nan_guard=NanGuardCfg(folder=str(tmp_path))))
    root_E = push(env, env.reset())["next"]
    assert env.world.nan_report().ok
    # Puck 1 is of 1 kg: the force overflows its velocity within the step.
    action_EL = torch.zeros(env.num_envs, 1)
    action_EL[1] = 3e38
    env.world.qvel_EL[1] = 3.3e38
    after_E = env.step(root_E.set("action", action_EL))["next"]
    assert after_E["terminated"].flatten().tolist() == [False, True, False]
    assert torch.isfinite(env.world.qpos_EL).all(), "cleared at once"

    (path,) = env.world.nan_report().files
    failure = nan_file.read(path)
    assert failure.world == 1 and DECIMATION < failure.substep <= 2 * DECIMATION
    assert failure.states["ctrl"][-1] == np.float32(3e38)
    found = replay.replay(failure)
    assert replay.dof_name(failure.mj_model, found.first) == "rail"
    env.close()
