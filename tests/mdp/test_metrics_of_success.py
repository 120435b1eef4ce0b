import pytest
import torch

from ksim_rl import mdp
from tests.envs.probe_env import DT, Beyond, puck_env_in_c


def finished(env, steps):
    root_E = env.reset()
    for _ in range(steps):
        _, root_E = env.step_and_maybe_reset(root_E.set("action", torch.zeros(env.num_envs, 1)))
    return env.episode_log()


def racing(*terminations, **fields):
    """Pucks of 1, 2 and 3 m/s; the goal is 0.11 m away, and the episode ends after five steps."""
    return puck_env_in_c(
        terminations={
            "goal": Beyond(limit=0.11),
            "time_out": mdp.TimeOut(),
            "far": Beyond(limit=0.15),
        },
        episode_length_s=5 * DT,
        metrics={"success": mdp.Success(terminations=terminations)},
        **fields,
    )


def test_success_is_an_end_by_the_named_terminations_and_by_no_other():
    # In five steps: 0 ends once by time at 0.10 m; 1 at 0.12 m in step 3; 2 at 0.12 m in steps 2 and 4.
    for names, successes in (
        (("goal",), 3),
        (("time_out",), 1),
        (("goal", "time_out"), 4),
        (("far",), 0),
    ):
        log = finished(racing(*names), 5)
        assert log["episodes"] == 4 and log["metric/success"] == successes, names


def test_an_end_for_two_reasons_is_none():
    env = puck_env_in_c(
        terminations={"goal": Beyond(limit=0.05), "far": Beyond(limit=0.05)},
        metrics={"success": mdp.Success(terminations=("goal",))},
    )
    assert finished(env, 3)["metric/success"] == 0.0


def test_a_failed_world_is_no_success():
    env = racing("goal", "time_out")
    root_E = env.reset()
    env.world.qvel_EL[0] = torch.nan
    env.step_and_maybe_reset(root_E.set("action", torch.zeros(3, 1)))
    log = env.episode_log()
    assert log["episodes"] == 1 and log["metric/success"] == 0.0


def test_an_unknown_termination_is_refused_at_construction():
    with pytest.raises(ValueError, match="unknown termination 'gaol': did you mean 'goal'"):
        racing("gaol")
    with pytest.raises(ValueError, match=r"terminations=\(\)"):
        mdp.Success(terminations=())


def test_a_target_is_reached_within_the_tolerance(free_body):
    free_body.place(qpos=(0, 0, 1, 1, 0, 0, 0, 0, 0))
    # The site "imu" is 0.3 m ahead of the trunk's frame.
    free_body.driver.readings.commands["reach"] = torch.tensor(
        [[0.3, 0.0, 0.0], [0.3, 0.09, 0.0], [0.3, 0.11, 0.0]]
    )
    term = mdp.TargetReached(command="reach", tolerance=0.1, site="imu")
    assert free_body.read(term, "metrics/x").tolist() == [1.0, 1.0, 0.0]
    free_body.view.commands["reach"].add_(torch.tensor([0.0, 0.0, 1.0]))
    assert free_body.read(term, "metrics/x").tolist() == [0.0] * 3
    world = mdp.TargetReached(command="reach", tolerance=0.1, site="imu", frame="world")
    assert free_body.read(world, "metrics/x").tolist() == [1.0, 1.0, 0.0]


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"tolerance": 0.0, "site": "imu"}, r"tolerance=0\.0"),
        ({"tolerance": 0.1}, "body=None, site=None: name exactly one"),
        ({"tolerance": 0.1, "body": "a", "site": "b"}, "name exactly one"),
        ({"tolerance": 0.1, "site": "imu", "frame": "wrld"}, "frame='wrld': did you mean 'world'"),
    ],
)
def test_what_names_no_target_is_refused(fields, message):
    with pytest.raises(ValueError, match=message):
        mdp.TargetReached(command="reach", **fields)
