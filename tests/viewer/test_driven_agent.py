"""Actions that a person drives: by request, by the panel's sliders, and by keys."""

import dataclasses
from types import SimpleNamespace
from unittest.mock import MagicMock

import pytest
import torch

from ksim_rl.cli.main import main
from ksim_rl.data import read_episodes
from ksim_rl.viewer.drive_recorder import recording
from ksim_rl.viewer.driven_agent import HAND
from ksim_rl.viewer.play_command import session_of
from ksim_rl.viewer.played import find

TASK = ["task=arm_reach", "task.sim.engine=c"]


@pytest.fixture(scope="module")
def played():
    return find(TASK, agent=HAND, device="cpu")


@pytest.fixture
def session(played):
    made = session_of(played, num_envs=2, seed=0)
    yield made
    made.close()


def test_an_action_is_what_is_driven_in_all_envs_also_in_a_rebuilt_one(session):
    assert session.title == "arm_reach, driven by hand"
    assert session.driver.ranges == {f"joints.{column}": (-2.5, 2.5) for column in range(4)}
    session.step_once()
    assert torch.equal(session.ours.view.action_EL, torch.zeros(2, 4))
    session.drive({0: 0.5, 3: -2.0})
    session.step_once()
    wanted = torch.tensor([0.5, 0.0, 0.0, -2.0]).expand(2, 4)
    assert torch.equal(session.ours.view.action_EL, wanted)
    session.change(dataclasses.replace(session.conditions, noise=False))
    session.step_once()
    assert torch.equal(session.ours.view.action_EL, wanted)


def test_sliders_and_keys_drive_the_action_and_not_the_command(session):
    pytest.importorskip("viser", reason="viser is not installed (the extra `viewer`)")
    from ksim_rl.viewer.panel import Panel

    gui = MagicMock()
    made = {}

    def add(label, low, high, step, value):
        made[label] = SimpleNamespace(min=low, max=high, value=value, on_update=MagicMock())
        return made[label]

    gui.add_slider.side_effect = add
    panel = Panel(gui, session)
    # A key that is held: a share of the range; one that was released is 0 again.
    panel.drive({0: 1.0, 1: -0.5, 9: 1.0})
    session.play(False)
    session.advance()
    session.step_once()
    assert session.ours.view.action_EL[0].tolist() == [2.5, -1.25, 0.0, 0.0]
    panel.drive({0: 0.0})
    made["joints.2"].value = 1.0
    (moved,) = made["joints.2"].on_update.call_args.args
    # What the program has set asks for nothing by itself.
    for client in (None, 1):
        moved(SimpleNamespace(client=client))
    session.advance()
    session.step_once()
    assert session.ours.view.action_EL[1].tolist() == [0.0, -1.25, 1.0, 0.0]


@pytest.mark.full
def test_driven_actions_are_in_the_recorded_episodes(tmp_path):
    played = find([*TASK, "task.episode_length_s=0.06"], agent=HAND, device="cpu")
    session = session_of(played, num_envs=1, seed=0)
    with recording(session, played, tmp_path / "driven", note=lambda _: None):
        for value in (0.1, 0.2, 0.3):
            session.drive({1: value})
            session.step_once()
    session.close()
    found = read_episodes(tmp_path / "driven").env_states_D
    assert found["action"][:, 1].tolist() == pytest.approx([0.1, 0.2, 0.3])


def test_other_agents_are_not_driven_and_a_video_has_no_driver(capsys):
    session = session_of(find(TASK, agent="zero", device="cpu"), num_envs=1, seed=0)
    assert session.driver is None
    with pytest.raises(ValueError, match='only the agent "hand"'):
        session.drive({0: 1.0})
    session.close()
    for words in ([], ["--viewer", "native"]):
        with pytest.raises(SystemExit, match="2"):
            main(["play", "task=arm_reach", "--agent", "hand", *words])
        assert "--agent hand: actions are driven in the browser viewer" in capsys.readouterr().err
