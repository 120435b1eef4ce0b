"""A step that was recorded for comparisons leaves the env alone; on the CPU it is the env's own."""

import torch

from ksim_rl.collectors.graph_step import GraphStep
from tests.collectors.test_compiled_step import made


def test_making_and_comparing_leave_env_and_root_as_they_were():
    env, root_E, tensordict = made()
    before, root_before_E, draws = env.state_dict(), root_E.clone(), torch.get_rng_state()
    step = GraphStep(env, root_E, tensordict)
    assert step.differences() == []
    for name, value in env.state_dict().items():
        assert not isinstance(value, torch.Tensor) or torch.equal(value, before[name]), name
    assert (root_E == root_before_E).all() and torch.equal(torch.get_rng_state(), draws)


def test_what_the_env_gives_otherwise_than_the_graph_is_named(monkeypatch):
    env, root_E, tensordict = made()
    step = GraphStep(env, root_E, tensordict)

    factor = [2.0]

    def replayed():
        # As a replay does: the numbers of the recording, whatever Python says now.
        factor[0] = 1.0
        env_state_E = step._check.own_step()
        factor[0] = 2.0
        return env_state_E

    given = env.base_env.reward_manager.step
    monkeypatch.setattr(step, "_replayed", replayed)
    monkeypatch.setattr(
        env.base_env.reward_manager, "step", lambda finite_E: given(finite_E) * factor[0]
    )
    assert step.differences()[0].startswith("next.reward in")
