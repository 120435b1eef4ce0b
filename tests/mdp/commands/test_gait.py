import math

import pytest
import torch

from ksim_rl import mdp
from tests.envs.probe_env import DT, puck_env_in_c, push
from tests.mdp.recorder import Recorder

TROT = (0.0, 0.5, 0.5, 0.0)


def phases(env, steps):
    """Return each foot's phase in cycles after each step, [steps + 1, E, F]."""
    root_E, seen = env.reset(), []
    for step in range(steps + 1):
        sine_EF, cosine_EF = root_E["command", "gait"].chunk(2, dim=-1)
        seen.append(torch.atan2(sine_EF, cosine_EF).div(2 * math.pi).remainder(1.0))
        if step < steps:
            root_E = push(env, root_E)["next"].clone()
    return torch.stack(seen)


def turned(cycles):
    """How far a phase has moved, in (-0.5, 0.5] cycles."""
    return (cycles + 0.5).remainder(1.0) - 0.5


def gait_env(**fields):
    return puck_env_in_c(
        limit=None,
        commands={"gait": mdp.SinusoidalGaitCommand(offsets=TROT, **fields)},
        episode_length_s=4.0,
    )


def test_feet_keep_their_offsets_and_the_pace():
    cycles = phases(gait_env(frequency=(1.5, 1.5)), 30)
    expected = torch.arange(31)[:, None, None] * (1.5 * DT) + torch.tensor(TROT)
    assert turned(cycles - expected).abs().max() < 1e-5


def test_each_env_has_a_pace_of_its_own_for_the_episode():
    cycles = phases(gait_env(frequency=(1.0, 3.0)), 20)
    pace_E = turned(cycles[1:, :, 0] - cycles[:-1, :, 0]) / DT
    torch.testing.assert_close(pace_E, pace_E[:1].expand(20, 3), atol=1e-3, rtol=0)
    assert (
        len(pace_E[0].unique()) == 3 and pace_E.min() >= 1.0 - 1e-3 and pace_E.max() <= 3.0 + 1e-3
    )


def test_a_new_pace_makes_no_jump():
    env = gait_env(frequency=(0.5, 4.0), resampling_time_range_s=(3 * DT, 3 * DT))
    cycles = phases(env, 30)
    pace = turned(cycles[1:, 0, 0] - cycles[:-1, 0, 0]) / DT
    assert pace.min() >= 0.5 - 1e-3 and pace.max() <= 4.0 + 1e-3
    assert len(pace.round(decimals=2).unique()) > 5, "it changes every three steps"


def test_a_reset_begins_the_rhythm_anew_in_its_rows_only():
    env = gait_env(frequency=(1.0, 3.0))
    phases(env, 7)
    before = env.last_root["command", "gait"].clone() if env.last_root is not None else None
    after = env.reset(env_ids=[1])["command", "gait"]
    torch.testing.assert_close(
        after[1], torch.tensor([0.0, 0.0, 0.0, 0.0, 1.0, -1.0, -1.0, 1.0]), atol=1e-5, rtol=0
    )
    assert before is not None and torch.equal(after[[0, 2]], before[[0, 2]])


def test_a_reset_without_events_begins_the_rhythm_anew():
    env = puck_env_in_c(
        limit=None,
        events={},
        commands={"gait": mdp.SinusoidalGaitCommand(offsets=TROT, frequency=(1.5, 1.5))},
    )
    first = phases(env, 5)
    assert turned(phases(env, 5) - first).abs().max() < 1e-5


def test_it_says_which_feet_should_be_in_the_air():
    env, recorder = gait_env(frequency=(1.0, 1.0)), Recorder()
    phases(env, 3)
    with env.driver.scope("commands/gait"):
        env.cfg.commands["gait"].draw_debug(env.view, recorder, 0)
    assert [(kind, what[-1]) for kind, *what in recorder.drawn] == [("text", "in the air: 1 0 0 1")]


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"frequency": (-1.0, 1.0), "offsets": TROT}, r"frequency\[0\]=-1.0"),
        ({"frequency": (1.0, 1.0), "offsets": ()}, r"offsets=\(\)"),
    ],
)
def test_what_does_not_fit_is_refused(fields, message):
    with pytest.raises(ValueError, match=message):
        mdp.SinusoidalGaitCommand(**fields)
