"""The commanded speed is computed once per command, and never stale."""

from dataclasses import dataclass

import torch
from torch import Tensor

from ksim_rl.envs import EnvView, ObservationGroupCfg, ObservationTermCfg
from ksim_rl.envs.term import CommandTerm, ObservationTerm, RewardTerm
from ksim_rl.mdp.fields import commanded_speed, is_commanded
from tests.envs.probe_env import DT, puck_env_in_c, push


@dataclass(frozen=True, kw_only=True)
class Faster(CommandTerm):
    """(3, 4, -k) with a `k` that grows by 1 at each resampling: a commanded speed of 5 + k."""

    def resample(self, view: EnvView, mask_E: Tensor) -> None:
        view.buffer("k_E").add_(mask_E.float())

    def __call__(self, view: EnvView) -> Tensor:
        k_E = view.buffer("k_E")
        return torch.stack((torch.full_like(k_E, 3.0), torch.full_like(k_E, 4.0), -k_E), dim=-1)


@dataclass(frozen=True, kw_only=True)
class SpeedSeen(ObservationTerm):
    """The commanded speed, and whether it exceeds 7.5."""

    def __call__(self, view: EnvView) -> Tensor:
        speed_E, is_fast_E = commanded_speed(view, "twist"), is_commanded(view, "twist", 7.5)
        assert (
            commanded_speed(view, "twist") is speed_E
            and is_commanded(view, "twist", 7.5) is is_fast_E
        )
        return torch.stack((speed_E, is_fast_E), dim=-1)


@dataclass(frozen=True, kw_only=True)
class SpeedPaid(RewardTerm):
    """The commanded speed."""

    def __call__(self, view: EnvView) -> Tensor:
        return commanded_speed(view, "twist")


def test_rewards_see_the_old_command_and_observations_the_new_one():
    group = ObservationGroupCfg(terms={"speed": ObservationTermCfg(term=SpeedSeen())})
    env = puck_env_in_c(
        limit=None,
        commands={"twist": Faster(resampling_time_range_s=(DT, DT))},
        observations={"actor": group, "critic": group},
        rewards={"speed": SpeedPaid()},
        scale_rewards_by_dt=False,
    )
    root_E = env.reset()
    assert root_E["obs", "speed"].tolist() == [[6.0, 0.0]] * 3
    for speed in (6.0, 7.0, 8.0):
        step_E = push(env, root_E)
        assert step_E["next", "reward"].tolist() == [[speed]] * 3
        assert (
            step_E["next", "obs", "speed"].tolist() == [[speed + 1.0, float(speed + 1.0 > 7.5)]] * 3
        )
        root_E = step_E["next"].exclude("reward")
