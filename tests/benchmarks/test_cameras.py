"""The benchmark of pictures measures the run that it says, and what the renderer draws."""

import pytest

from benchmarks import cameras, command_line

WORDS = (
    "task=cartpole_balance",
    "device=cpu",
    "num_envs=2",
    "logger=none",
    "trainer.eval_episodes=0",
    "data.num_env_states_per_minibatch=8",
    "data.num_minibatches=2",
)


@pytest.mark.full
@pytest.mark.parametrize(("output", "bytes_per_pixel"), [("rgb", 3), ("depth", 4)])
def test_pictures_are_timed_where_the_policy_reads_them_and_the_critic_does_not(
    output, bytes_per_pixel
):
    cfg = cameras.with_camera(
        command_line.compose(WORDS), "cartpole_balance", size=36, output=output
    )
    assert cfg.modules.actor.in_keys == ("actor", "camera")
    assert cfg.modules.critic.in_keys == ("critic",)
    figures = cameras.measure(cfg, output=output)
    speeds = {name: figures[f"{name}_frames_per_s"] for name in cameras.SPEEDS}
    assert min(speeds["renderer"], speeds["drawn"]) > speeds["rollout"] > speeds["training"] > 0.0
    # The picture before each of 8 steps of an env, beside a few numbers.
    least = 8 * 36 * 36 * bytes_per_pixel
    assert figures["rollout_bytes_per_env"] == pytest.approx(least, rel=0.05, abs=2000.0)
    assert figures["renderer_bytes_per_env"] >= 36 * 36 * 4
