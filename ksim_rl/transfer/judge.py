"""Runs a policy's episodes under one condition in MuJoCo's C engine, and measures the load on a robot."""

import dataclasses
import math
import warnings
from dataclasses import dataclass

import torch
from jaxtyping import Float
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase

from ksim_rl.envs.contract import part
from ksim_rl.envs.manager_based_rl_env import ManagerBasedRlEnv
from ksim_rl.mdp.metrics import AngularVelocityError, LinearVelocityError
from ksim_rl.scene.names import actuators_of_joint
from ksim_rl.scene.sensors import ContactSensor
from ksim_rl.tasks.velocity import FEET
from ksim_rl.trainers import RunCfg
from ksim_rl.trainers.build import build_evaluator
from ksim_rl.trainers.evaluation import Evaluator
from ksim_rl.trainers.other_physics import in_c_engine
from ksim_rl.transfer.conditions import Condition

TRACKING = (LinearVelocityError, AngularVelocityError)
PERCENTILE = 0.99
MOST_SECONDS = 10.0
"""Of an episode: who stands then under a condition stands later, too, and a card takes half the time."""


@dataclass(frozen=True, kw_only=True)
class Judged:
    """Figures of episodes under a condition; those that the task has none of are NaN.

    Attributes:
        return_mean: of the episodes.
        upright: the share of episodes that did not end but by time.
        errors: the means of the task's errors of tracking, by name, m/s and rad/s.
        effort: the 99th percentile of joints' efforts, as shares of the limits that the robot's files have.
        speed: the 99th percentile of joints' speeds, rad/s or m/s.
        power: mean mechanical power of all joints, W.
        jerk: root mean square of the third derivative of joints' positions, rad/s^3 or m/s^3.
        impact: the 99th percentile of contact forces on feet, N.
    """

    return_mean: float
    upright: float
    errors: dict[str, float]
    effort: float
    speed: float
    power: float
    jerk: float
    impact: float


def judge(
    cfg: RunCfg,
    actor: TensorDictModuleBase,
    condition: Condition,
    *,
    episodes: int,
    seconds: float = MOST_SECONDS,
) -> Judged:
    """Run the first `seconds` of episodes under a condition, with the same starts and commands under each.

    A ValueError says why the condition cannot apply.
    """
    task = condition.change(cfg.task)
    # Changes of actuators would keep Warp's own settings, which C has none of.
    task = dataclasses.replace(task, sim=in_c_engine(task.sim))
    changed = dataclasses.replace(cfg, task=task, device="cpu")
    with warnings.catch_warnings():
        # A condition changes more geoms or joints than matter in this task.
        warnings.filterwarnings("ignore", message="events.card: ")
        built = build_evaluator(changed, actor, episodes=episodes)
    built.env.train(condition.noise)
    base = part(built.env, ManagerBasedRlEnv)
    assert base is not None  # the env of a config is ours
    steps = min(built.max_steps, math.ceil(seconds / base.step_dt))
    judging = JudgingEvaluator(base, built.env, actor, max_steps=steps, seed=built.seed)
    found = judging.figures()
    built.env.close(raise_if_closed=False)
    return found


class JudgingEvaluator(Evaluator):
    """Runs one episode in each env, and reads what its joints and feet do at each step."""

    def __init__(
        self,
        base: ManagerBasedRlEnv,
        env: EnvBase,
        policy: TensorDictModuleBase,
        *,
        max_steps: int,
        seed: int,
    ) -> None:
        super().__init__(env, policy, max_steps=max_steps, seed=seed)
        self._base = base
        self._limited, self._limit_L = _limits(base)
        self._last_vel: list[Tensor] = []
        self._read: dict[str, list[Tensor]] = {}
        self._has_feet = isinstance(base.cfg.scene.sensors.get(FEET), ContactSensor)
        # Of the metrics those that depend on the present state alone can be asked here once more.
        metrics = base.cfg.metrics.items()
        self._tracking = {name: term for name, term in metrics if isinstance(term, TRACKING)}

    def figures(self) -> Judged:
        """Run the episodes and return their figures."""
        self()
        return Judged(
            return_mean=float(self.return_E.mean()),
            upright=1.0 - float(self.terminated_E.double().mean()),
            errors={name: _mean(self._all(f"error/{name}")) for name in self._tracking},
            effort=_percentile(self._all("effort")),
            speed=_percentile(self._all("speed")),
            power=_mean(self._all("power")),
            jerk=math.sqrt(_mean(self._all("jerk").square())),
            impact=_percentile(self._all("impact")),
        )

    def _start(self) -> None:
        super()._start()
        self._last_vel.clear()
        self._read.clear()

    def _count_one_step(self) -> None:
        super()._count_one_step()
        view = self._base.view
        # The row of an episode that ended shows the next one's start already.
        runs_E = self._running_E
        joints = view.joints()
        limited_EL = joints.effort_EL[:, self._limited]
        self._gather("effort", (limited_EL.abs() / self._limit_L)[runs_E])
        self._gather("speed", joints.vel_EL.abs()[runs_E])
        self._gather("power", (joints.effort_EL * joints.vel_EL).abs().sum(-1)[runs_E])
        self._last_vel.append(joints.vel_EL.clone())
        if len(self._last_vel) == 3:
            first_EL, second_EL, third_EL = self._last_vel
            step_s = self._base.step_dt
            jerk_EL = (third_EL - 2.0 * second_EL + first_EL) / step_s**2
            self._gather("jerk", jerk_EL[runs_E])
            self._last_vel.pop(0)
        if self._has_feet:
            force_EN = torch.linalg.vector_norm(view.contact(FEET).force_EN3, dim=-1)
            self._gather("impact", force_EN[runs_E])
        for name, term in self._tracking.items():
            self._gather(f"error/{name}", term(view)[runs_E])

    def _gather(self, name: str, values: Tensor) -> None:
        self._read.setdefault(name, []).append(values.flatten().float())

    def _all(self, name: str) -> Float[Tensor, " K"]:
        read = self._read.get(name, [])
        if not read:
            return torch.zeros(0)
        return torch.cat(read)


def _limits(base: ManagerBasedRlEnv) -> tuple[list[int], Float[Tensor, " L"]]:
    """Return the columns of joints whose effort is limited, and the limits, N m or N."""
    mj_model = base.world.mj_model
    columns = []
    limits = []
    for column, name in enumerate(base.view.joints().names):
        for actuator in actuators_of_joint(mj_model, mj_model.joint(name).id):
            gear = abs(float(mj_model.actuator_gear[actuator, 0]))
            if mj_model.actuator_forcelimited[actuator]:
                limit = gear * float(mj_model.actuator_forcerange[actuator, 1])
            elif column in base.view.actuator_params.joints("effort_limit", finite=True):
                limit = float(base.view.actuator_params.nominal("effort_limit")[column])
            else:
                continue
            columns.append(column)
            limits.append(limit)
    return columns, torch.tensor(limits)


def _mean(values_K: Float[Tensor, " K"]) -> float:
    return float(values_K.double().mean()) if values_K.numel() else math.nan


def _percentile(values_K: Float[Tensor, " K"]) -> float:
    if not values_K.numel():
        return math.nan
    # Not `torch.quantile`, which takes no more than 16 million numbers.
    rank = max(1, math.ceil(PERCENTILE * values_K.numel()))
    return float(values_K.kthvalue(rank).values)
