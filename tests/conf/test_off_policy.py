"""Each off-policy objective composes to a whole config that fits itself, and is refused where it does not."""

import dataclasses
from importlib.resources import files

import pytest
from omegaconf import OmegaConf

from ksim_rl import conf
from ksim_rl.data import DatasetCfg, ReplayCfg
from ksim_rl.envs import to_tree
from ksim_rl.modules import DeterministicActorCfg, QNetworkCfg, SquashedActorCfg
from ksim_rl.objectives import SACCfg, TD3Cfg
from ksim_rl.trainers import RunCfg, build

FOLDER = files("ksim_rl.conf")
KINDS = {
    "sac": (SACCfg, SquashedActorCfg),
    "fast_sac": (SACCfg, SquashedActorCfg),
    "fast_td3": (TD3Cfg, DeterministicActorCfg),
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


@pytest.mark.parametrize("objective", list(KINDS))
def test_the_yaml_files_list_every_field(objective):
    cfg = conf.compose([f"objective={objective}", "task=go1_velocity_rough", "num_envs=4"])
    for group, part in (("objective", cfg.objective), ("modules", cfg.modules), ("data", cfg.data)):
        names = [objective] if group != "data" else ["off_policy"]
        names += ["sac"] if group != "data" and objective == "fast_sac" else []
        trees = [
            OmegaConf.to_container(OmegaConf.create((FOLDER / group / f"{name}.yaml").read_text()))
            for name in names
        ]
        known = set().union(*trees) - {"defaults", "_target_"}
        fields = set(to_tree(part)) - {"_target_"}
        if group == "modules":
            known = {f"{role}.{key}" for role in ("actor", "critic") for tree in trees for key in tree[role]}
            fields = {
                f"{role}.{field.name}"
                for role in ("actor", "critic")
                for field in dataclasses.fields(getattr(part, role))
            }
            known -= {"actor._target_", "critic._target_"}
        assert known == fields, group


def test_the_command_line_goes_over_what_an_objective_chooses():
    cfg = conf.compose(["task=pendulum_swingup", "objective=sac", "data=off_policy", "data.capacity=77"])
    assert cfg.data.num_env_states_per_minibatch == 32768 and cfg.data.capacity == 77


@pytest.mark.parametrize(("objective", "gamma"), [("fast_sac", 0.98), ("fast_td3", 0.97)])
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
