"""Motor models and substep hooks on the GPU: eager, between Warp graphs, and inside a captured step."""

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from ksim_rl.physics import Captured
from tests.gpu.no_syncs import no_syncs
from tests.physics.models import standing_quadrupeds
from tests.scene.actuators.chain import one_of_each
from tests.scene.actuators.test_joint_drives import FILTERED, E, actions, chain_env, run_by_hand

STEPS, RESET_AT, RESET_ROW = 10, 5, 2


@pytest.mark.gpu
def test_hooked_substeps_equal_themselves_in_a_captured_graph():
    by_itself, captured = (standing_quadrupeds(16, device="cuda") for _ in range(2))
    seen = {}

    def body_of(world):
        times_E = seen[id(world)] = torch.zeros(16, device="cuda")
        before = [lambda: world.ctrl_EL.mul_(0.99)]
        after = [lambda: times_E.add_(world.time_E)]
        return lambda: world.step(4, before=before, after=after)

    by_itself_body = body_of(by_itself)
    graph = Captured(body_of(captured), device="cuda", warmup=2, require_graphs=True)
    for _ in range(6):
        by_itself_body()
        graph()
    assert graph.ready
    torch.testing.assert_close(captured.ctrl_EL, by_itself.ctrl_EL)
    torch.testing.assert_close(captured.qpos_EL, by_itself.qpos_EL, rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(seen[id(captured)], seen[id(by_itself)])


@pytest.mark.gpu
def test_all_motor_models_captured_move_the_joints_as_in_the_c_engine(tmp_path):
    """With a reset of one row in the middle, and without any sync of a replay."""
    actions_TEL = actions(STEPS)
    env = chain_env(one_of_each(tmp_path), FILTERED, device="cuda")
    env.seed(5)
    env.reset()
    action_EL = torch.zeros(E, 6, device="cuda")
    mask_E1 = torch.zeros(E, 1, dtype=torch.bool, device="cuda")
    start_EL, reached_EL = torch.zeros(E, 12, device="cuda"), torch.zeros(E, 12, device="cuda")
    lags = [buffer for name, buffer in env.view.buffers.by_name().items() if name.endswith("lag_E")]

    def joint_states() -> torch.Tensor:
        return torch.cat((env.world.qpos_EL, env.world.qvel_EL), dim=-1)

    def body() -> None:
        env._reset(TensorDict({"_reset": mask_E1}, batch_size=[E], device=env.device))
        start_EL.copy_(joint_states())
        env._step(TensorDict({"action": action_EL}, batch_size=[E], device=env.device))
        reached_EL.copy_(joint_states())

    step = Captured(body, device="cuda", warmup=2, require_graphs=True)
    starts, states, lags_TE2 = [], [], []
    for t, given_EL in enumerate(actions_TEL.cuda()):
        action_EL.copy_(given_EL)
        mask_E1[RESET_ROW] = t == RESET_AT
        with no_syncs(on=step.ready):
            step()
        starts.append(start_EL.tolist())
        states.append(reached_EL.tolist())
        lags_TE2.append(torch.stack(lags, dim=-1).tolist())
    assert step.ready
    start_TEL, reached_TEL = np.array(starts), np.array(states)
    assert np.abs(start_TEL[RESET_AT, RESET_ROW] - reached_TEL[RESET_AT - 1, RESET_ROW]).max() > 0.1
    episodes = [(row, 0, STEPS) for row in range(E) if row != RESET_ROW]
    episodes += [(RESET_ROW, 0, RESET_AT), (RESET_ROW, RESET_AT, STEPS)]
    for row, begin, end in episodes:
        ankle_lag, neck_lag = lags_TE2[begin][row]
        actions_TL = actions_TEL[begin:end, row].double().numpy()
        expected_TL, _ = run_by_hand(
            env.world.mj_model, start_TEL[begin, row], (ankle_lag, neck_lag), actions_TL
        )
        actual_TL = reached_TEL[begin:end, row]
        np.testing.assert_allclose(actual_TL[:, :6], expected_TL[:, :6], atol=1e-4)
        np.testing.assert_allclose(actual_TL[:, 6:], expected_TL[:, 6:], atol=5e-3, rtol=5e-3)
