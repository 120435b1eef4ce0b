"""Motor models and substep hooks on the GPU: eager, between Warp graphs, and inside a captured step."""

import pytest
import torch
from tensordict import TensorDict

from ksim_rl.physics import Captured
from tests.envs.actuators.chain import one_of_each
from tests.envs.actuators.test_joint_drives import FILTERED, E, actions, chain_env
from tests.physics.models import standing_quadrupeds


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
def test_all_motor_models_captured_equal_those_on_the_cpu(tmp_path):
    """With a reset of one row in the middle, and without any sync of a replay."""
    actuators, actions_TEL = one_of_each(tmp_path), actions(10)
    reached = {}
    for device in ("cpu", "cuda"):
        env = chain_env(actuators, FILTERED, device=device)
        env.seed(5)
        env.reset()
        action_EL = torch.zeros(E, 6, device=device)
        mask_E1 = torch.zeros(E, 1, dtype=torch.bool, device=device)

        def body(env=env, action_EL=action_EL, mask_E1=mask_E1) -> None:
            env._reset(TensorDict({"_reset": mask_E1}, batch_size=[E], device=env.device))
            env._step(TensorDict({"action": action_EL}, batch_size=[E], device=env.device))

        step = Captured(body, device=device, warmup=2)
        states = []
        for t, given_EL in enumerate(actions_TEL.to(device)):
            action_EL.copy_(given_EL)
            mask_E1[2] = t == 5
            torch.cuda.synchronize()
            torch.cuda.set_sync_debug_mode("error" if step.ready else "default")
            try:
                step()
            finally:
                torch.cuda.set_sync_debug_mode("default")
            states.append(env.world.qpos_EL.cpu())
        reached[device] = torch.stack(states)
        lags = [b.tolist() for name, b in env.view.memories.buffers().items() if name.endswith("lag_E")]
        reached[f"{device} lags"] = lags
    assert reached["cuda lags"] == reached["cpu lags"]
    torch.testing.assert_close(reached["cuda"], reached["cpu"], rtol=1e-3, atol=1e-3)
