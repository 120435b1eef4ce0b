"""The benchmark of the off-policy gradient step times the update that training makes."""

import torch

from benchmarks.off_policy_update import compare, make_rollout
from ksim_rl import conf, envs


def test_the_update_of_a_run_is_timed():
    sizes = (
        "num_envs=4",
        "data.num_env_states_per_minibatch=8",
        "data.num_minibatches=4",
        "data.learning_starts=4",
    )
    cfg = conf.compose(["task=pendulum_swingup", "objective=fast_sac", "device=cpu", *sizes])
    env, device = envs.make("pendulum_swingup", num_envs=2, seed=0), torch.device("cpu")
    rollout_ET = make_rollout(cfg, env, device=device)
    assert rollout_ET["actor"].shape[-1] == env.observation_spec["actor"].shape[-1]
    assert rollout_ET["next", "critic"].shape[:2] == (4, cfg.data.num_steps)
    figures = compare(cfg, env, device=device, repeats=1)
    assert set(figures) == {"gradient_step_ms", "eager_ms"} and min(figures.values()) > 0.0
