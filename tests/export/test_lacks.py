"""What an export cannot do is said before a training."""

from dataclasses import dataclass, replace

from torch import Tensor

from ksim_rl import envs, mdp
from ksim_rl.envs.term import ObservationTerm, RewardTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.export.lacks import say_lacks
from ksim_rl.trainers.build import build_env
from ksim_rl.trainers.run_cfg import RunCfg
from ksim_rl.transforms import ObservationTermCfg


@dataclass(frozen=True, kw_only=True)
class OwnReward(RewardTerm):
    """It is drawn, which other software cannot repeat."""

    def __call__(self, view: EnvView) -> Tensor:
        return view.uniform(1)[:, 0]


@dataclass(frozen=True, kw_only=True)
class OwnSignal(ObservationTerm):
    """It is drawn, which no robot can do."""

    def __call__(self, view: EnvView) -> Tensor:
        return view.uniform(1)


def lines(change) -> list[str]:
    task = envs.task("cartpole_balance")
    settings = {name: getattr(task.training, name) for name in task.training.__dataclass_fields__}
    cfg = RunCfg(**settings, task_name="cartpole_balance", task=change(task.cfg()), device="cpu")
    said: list[str] = []
    say_lacks(cfg, build_env(cfg, num_envs=2, seed=0), said.append)
    return said


def observing(cfg):
    actor = cfg.observations["actor"]
    terms = {**actor.terms, "own": ObservationTermCfg(term=OwnSignal())}
    return replace(cfg, observations={**cfg.observations, "actor": replace(actor, terms=terms)})


def test_a_task_of_the_package_lacks_nothing():
    assert lines(lambda cfg: cfg) == []


def test_a_reward_that_is_left_out_is_said():
    (line,) = lines(lambda cfg: replace(cfg, rewards={**cfg.rewards, "own": OwnReward(weight=1.0)}))
    assert line.startswith("task.rewards.own is left out of sim2sim: ")


def test_an_observation_that_no_export_can_take_is_said():
    (line,) = lines(observing)
    assert line.startswith(
        "`ksim-rl export` will refuse this run: task.observations.actor.terms.own: "
    )


def test_an_actuator_without_a_name_is_no_obstacle():
    robot = envs.MjcfRobot(
        source="""<mujoco><worldbody><body><joint name="slide" type="slide" axis="1 0 0"/><geom size="0.1"/></body>
        </worldbody><actuator><motor joint="slide"/><motor joint="slide" gear="2"/></actuator></mujoco>"""
    )
    env = envs.ManagerBasedRlEnv(
        envs.ManagerBasedRlEnvCfg(
            decimation=1,
            scene=envs.SceneCfg(robots={"cart": robot}),
            observations={},
            actions={"push": mdp.ActuatorAction(actuators=".*")},
            rewards={},
            terminations={},
        )
    )
    assert env.view.resolver.names("actuator") == ["slide", "actuator1"]
    assert env.action_manager.size == 2
