import torch
from torchrl.envs.utils import check_env_specs

from ksim_rl.testing import CounterEnv


def test_it_is_a_good_torchrl_env_with_and_without_a_batch():
    check_env_specs(CounterEnv())
    check_env_specs(CounterEnv(()))


def test_answers_are_in_closed_form():
    env = CounterEnv((2, 3), action_size=1)
    rollout_ET = env.rollout(6, break_when_any_done=False)
    assert rollout_ET["count"][..., 0].tolist() == [[0, 1, 0, 1, 0, 1], [0, 1, 2, 0, 1, 2]]
    assert rollout_ET["episode"][..., 0].tolist() == [[1, 1, 2, 2, 3, 3], [1, 1, 1, 2, 2, 2]]
    ended = [[0, 1, 0, 1, 0, 1], [0, 0, 1, 0, 0, 1]]
    assert rollout_ET["next", "done"][..., 0].int().tolist() == ended
    assert rollout_ET["next", "terminated"][..., 0].int().tolist() == [ended[0], [0] * 6]
    assert rollout_ET["next", "truncated"][..., 0].int().tolist() == [[0] * 6, ended[1]]
    assert torch.equal(rollout_ET["next", "reward"], rollout_ET["action"])


def test_the_drawn_number_is_a_function_of_seed_row_and_episode():
    first, second = CounterEnv(), CounterEnv((1, 1, 1))
    for env in (first, second):
        env.set_seed(4)
    drawn = first.reset()["drawn"]
    assert torch.equal(drawn, second.reset()["drawn"])
    assert len(set(drawn.flatten().tolist())) == 3
    assert not (first.reset()["drawn"] == drawn).any()
