"""Each off-policy objective composes to a whole config that fits itself, and is refused where it does not."""

import dataclasses

import pytest

from ksim_rl import conf
from ksim_rl.algorithms.fast_sac import FastSACCfg
from ksim_rl.algorithms.fast_td3 import FastTD3Cfg
from ksim_rl.data import DatasetCfg, ReplayCfg
from ksim_rl.modules import DeterministicActorCfg, QNetworkCfg, SquashedActorCfg
from ksim_rl.objectives import SACCfg, TD3Cfg
from ksim_rl.trainers import RunCfg, build

KINDS = {
    "sac": (SACCfg, SquashedActorCfg),
    "td3": (TD3Cfg, DeterministicActorCfg),
    "fast_sac": (FastSACCfg, SquashedActorCfg),
    "fast_td3": (FastTD3Cfg, DeterministicActorCfg),
}


@pytest.mark.parametrize("objective", list(KINDS))
def test_an_objective_brings_the_data_and_the_networks_that_it_needs(objective):
    cfg = conf.compose([f"objective={objective}", "task=pendulum_swingup"])
    kind, actor = KINDS[objective]
    assert type(cfg.objective) is kind and type(cfg.modules.actor) is actor
    assert isinstance(cfg.data, ReplayCfg) and isinstance(cfg.modules.critic, QNetworkCfg)
    assert (cfg.modules.critic.num_atoms > 1) == objective.startswith("fast")
    assert cfg.data.num_minibatches % cfg.objective.policy_delay == 0
    assert RunCfg.from_tree(cfg.to_tree()) == cfg


def test_the_command_line_goes_over_what_an_objective_chooses():
    cfg = conf.compose(
        ["task=pendulum_swingup", "objective=sac", "data=off_policy", "data.capacity=77"]
    )
    assert cfg.data.num_env_states_per_minibatch == 32768 and cfg.data.capacity == 77


@pytest.mark.parametrize(("objective", "gamma"), [("fast_sac", 0.97), ("fast_td3", 0.97)])
def test_go1_has_settings_of_its_own(objective, gamma):
    cfg = conf.compose(["task=go1_velocity_flat", f"objective={objective}"])
    assert (cfg.num_envs, cfg.data.num_steps, cfg.modules.actor.action_bound) == (4096, 4, 2.0)
    assert cfg.objective.gamma == gamma and not cfg.data.save_replay


def test_parts_that_do_not_fit_the_objective_are_refused():
    cfg = conf.compose(["task=pendulum_swingup", "objective=sac", "num_envs=2", "device=cpu"])
    on_policy = DatasetCfg(num_env_states_per_minibatch=4, num_minibatches=1)
    with pytest.raises(ValueError, match="DatasetCfg, and SACCfg needs a ReplayCfg"):
        build(dataclasses.replace(cfg, data=on_policy))
    networks = dataclasses.replace(cfg.modules, actor=DeterministicActorCfg())
    with pytest.raises(ValueError, match="modules.actor is a DeterministicActorCfg"):
        build(dataclasses.replace(cfg, modules=networks))
