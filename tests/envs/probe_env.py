"""Envs whose answers are known in closed form: a puck that glides on a rail without friction or gravity.

With velocity v the puck's position after k env steps of DT seconds is x0 + k v DT, in float32 additions of one per
physics substep. The action is a force on a mass of 1 kg.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from ksim_rl.envs import (
    EnvView,
    ManagerBasedRlEnv,
    ManagerBasedRlEnvCfg,
    MjcfRobot,
    ObservationGroupCfg,
    ObservationTermCfg,
    SceneCfg,
)
from ksim_rl.envs.term import CommandTerm, EventTerm, MetricTerm, RewardTerm, TerminationTerm
from ksim_rl.mdp import (
    JointEffortAction,
    JointPos,
    JointVel,
    LastAction,
    TimeOut,
)
from ksim_rl.physics import SimCfg

SUBSTEP_S = 0.005
DECIMATION = 4
DT = SUBSTEP_S * DECIMATION

PUCK_XML = f"""
<mujoco model="puck">
  <option timestep="{SUBSTEP_S}" gravity="0 0 0" integrator="implicitfast"/>
  <worldbody>
    <body name="puck">
      <joint name="rail" type="slide" axis="1 0 0"/>
      <geom name="puck" type="sphere" size="0.1" mass="1" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  <actuator><motor name="push" joint="rail"/></actuator>
</mujoco>
"""


@dataclass(frozen=True, kw_only=True)
class Launch(EventTerm):
    """Start at x = 0; env e starts with velocity `speed * (e + 1)` m/s."""

    speed: float = 1.0

    def __call__(self, view: EnvView, mask_E: Tensor) -> None:
        speed_E1 = (
            self.speed * torch.arange(1, view.num_envs + 1, device=view.device).float()[:, None]
        )
        view.joints().write_pos(mask_E, torch.zeros_like(speed_E1))
        view.joints().write_vel(mask_E, speed_E1)


@dataclass(frozen=True, kw_only=True)
class RandomLaunch(EventTerm):
    """Start at x = 0 with a random velocity in [0, 1) m/s."""

    def __call__(self, view: EnvView, mask_E: Tensor) -> None:
        view.joints().write_pos(mask_E, torch.zeros(view.num_envs, 1, device=view.device))
        view.joints().write_vel(mask_E, view.uniform(1))


@dataclass(frozen=True, kw_only=True)
class Kick(EventTerm):
    """Add 1 m/s."""

    def __call__(self, view: EnvView, mask_E: Tensor) -> None:
        view.joints().write_vel(mask_E, view.joint_vel_EL + 1.0)


@dataclass(frozen=True, kw_only=True)
class Beyond(TerminationTerm):
    """Ends when x exceeds `limit` m."""

    limit: float = 0.1

    def __call__(self, view: EnvView) -> Tensor:
        return view.joint_pos_EL[:, 0] > self.limit


@dataclass(frozen=True, kw_only=True)
class Position(RewardTerm):
    """The position, m."""

    def __call__(self, view: EnvView) -> Tensor:
        return view.joint_pos_EL[:, 0]


@dataclass(frozen=True, kw_only=True)
class Speed(MetricTerm):
    """The velocity, m/s."""

    def __call__(self, view: EnvView) -> Tensor:
        return view.joint_vel_EL[:, 0]


@dataclass(frozen=True, kw_only=True)
class Target(CommandTerm):
    """A uniform number in [0, 1)."""

    def resample(self, view: EnvView, mask_E: Tensor) -> None:
        target_E1 = view.buffer("target_E1", 1)
        target_E1.copy_(torch.where(mask_E[:, None], view.uniform(1), target_E1))

    def __call__(self, view: EnvView) -> Tensor:
        return view.buffer("target_E1", 1).clone()


def puck_cfg(
    *,
    num_envs: int = 3,
    events: Mapping[str, EventTerm] | None = None,
    episode_length_s: float = 0.0,
    limit: float | None = 0.1,
    seed: int = 0,
    **fields: object,
) -> ManagerBasedRlEnvCfg:
    """Return the config of the puck env; a time-out comes with a positive `episode_length_s`.

    `fields` are fields of `ManagerBasedRlEnvCfg`.
    """
    terminations: dict[str, TerminationTerm] = {}
    if limit is not None:
        terminations["beyond"] = Beyond(limit=limit)
    if episode_length_s:
        terminations["time_out"] = TimeOut(time_out=True)
    terms = {
        "position": ObservationTermCfg(term=JointPos()),
        "velocity": ObservationTermCfg(term=JointVel()),
        "last_action": ObservationTermCfg(term=LastAction()),
    }
    defaults: dict[str, object] = {
        "decimation": DECIMATION,
        "scene": SceneCfg(robots={"puck": MjcfRobot(source=PUCK_XML)}, num_envs=num_envs),
        "observations": {
            "actor": ObservationGroupCfg(terms=terms),
            "critic": ObservationGroupCfg(terms=terms),
        },
        "actions": {"push": JointEffortAction()},
        "rewards": {"position": Position()},
        "terminations": terminations,
    }
    return ManagerBasedRlEnvCfg(
        events={"launch": Launch()} if events is None else events,
        episode_length_s=episode_length_s,
        seed=seed,
        **(defaults | fields),  # pyright: ignore[reportArgumentType]
    )


def puck_env(**fields: object) -> ManagerBasedRlEnv:
    """Build the bare puck env on the CPU."""
    return ManagerBasedRlEnv(puck_cfg(**fields))  # pyright: ignore[reportArgumentType]


def puck_env_in_c(**fields: object) -> ManagerBasedRlEnv:
    """Build it on MuJoCo's C engine, which compiles and records nothing, where physics is no matter."""
    return puck_env(sim=SimCfg(engine="c"), **fields)


def push(env: ManagerBasedRlEnv, root_E: object, force: float = 0.0) -> object:
    """Step with the same force in all envs; return what `step` returns."""
    return env.step(root_E.set("action", torch.full((env.num_envs, 1), force)))  # pyright: ignore
