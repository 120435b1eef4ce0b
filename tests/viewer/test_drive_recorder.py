"""What is driven in a viewer becomes whole episodes, with the env states that were seen."""

import pytest
import torch

from ksim_rl.data import read_episodes
from ksim_rl.viewer.drive_recorder import recording
from ksim_rl.viewer.play_command import session_of
from ksim_rl.viewer.played import find

TASK = ["task=cartpole_swingup", "task.sim.engine=c", "task.episode_length_s=0.03"]


@pytest.mark.full
def test_whole_episodes_are_those_that_were_driven(tmp_path):
    played = find(TASK, agent="random", device="cpu")
    session = session_of(played, num_envs=1, seed=0)
    seen = []
    said = []
    with recording(session, played, tmp_path / "driven", note=said.append):
        # Three steps are an episode. One that is reset after two of them has no end, and is left out.
        for is_kept in (True, False, True):
            for _ in range(3 if is_kept else 2):
                before = session.root_E["actor"].clone()
                session.step_once()
                if is_kept:
                    seen.append(before)
            if not is_kept:
                session.reset()
    session.close()
    found = read_episodes(tmp_path / "driven")
    assert found.contents.num_episodes == 2 and said == [
        f"2 whole episodes are in {tmp_path / 'driven'}"
    ]
    assert torch.equal(found.env_states_D["actor"], torch.cat(seen))
    assert found.env_states_D["next", "done"][:, 0].tolist() == [False, False, True] * 2
    assert found.contents.origin.task == "cartpole_swingup"
