"""The 25 tasks of the DeepMind Control Suite that MuJoCo Playground reports, each in two variants.

`dm_control_<domain>_<task>` is the task as dm_control has it, `playground_<domain>_<task>` as Playground changes it.
Episodes have 1000 control steps and rewards lie in [0, 1], so that returns lie in [0, 1000]; only time ends an episode.
"""

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import get_args

from ksim_rl import mdp
from ksim_rl.envs.manager_based_rl_env_cfg import ManagerBasedRlEnvCfg
from ksim_rl.envs.task import Task
from ksim_rl.envs.term import EventTerm, ObservationTerm
from ksim_rl.scene.scene import SceneCfg
from ksim_rl.suites.dm_control import training
from ksim_rl.suites.dm_control.domains import DOMAINS
from ksim_rl.suites.dm_control.models import DmControlModel, Variant
from ksim_rl.suites.dm_control.quantities import (
    BodyAxes,
    Control,
    Distance,
    Factor,
    Offset,
    Readings,
    ToleranceProduct,
)
from ksim_rl.suites.dm_control.targets import BoxTarget, RingTarget, Target
from ksim_rl.transforms.groups.group_cfg import ObservationGroupCfg, ObservationTermCfg

EPISODE_STEPS = 1000
# Env states of the tasks that take long: of PPO, and of FastSAC.
LONG = 100e6
FAST_SAC_LONG = 10e6
# s of a control step.
CONTROL_S = {
    "acrobot": 0.01, "ball_in_cup": 0.02, "cartpole": 0.01, "cheetah": 0.01, "finger": 0.02, "fish": 0.04,
    "hopper": 0.02, "humanoid": 0.025, "pendulum": 0.02, "point_mass": 0.02, "reacher": 0.02, "swimmer": 0.03,
    "walker": 0.025,
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class SuiteTask:
    """A task of a domain, with its additions to the domain; its rewards are summed with their weights."""

    description: str
    rewards: Mapping[str, ToleranceProduct]
    target: Target | None = None
    observations: Mapping[str, ObservationTerm] = field(default_factory=dict)
    events: Mapping[str, EventTerm] | None = None
    damping: Mapping[str, float] = field(default_factory=dict)
    gamma: float = 0.995
    ppo_states: float = training.PPO_STATES
    fast_sac_states: float = 5e6


def _product(weight: float = 1.0, /, **factors: Factor) -> ToleranceProduct:
    # The factors' names are for logs and messages only.
    return ToleranceProduct(weight=weight, factors=factors)


def _reward(**factors: Factor) -> dict[str, ToleranceProduct]:
    return {"task": _product(**factors)}


def _speed(low: float, *, margin: float, value_at_margin: float, floor: float = 0.0) -> Factor:
    # Along x, of the whole robot's centre of mass.
    speed = Readings(sensors=("torso_subtreelinvel.x",))
    return Factor(
        of=speed,
        low=low,
        margin=margin,
        value_at_margin=value_at_margin,
        shape="linear",
        floor=floor,
    )


# -- factors that several tasks share ----------------------------------------------------------------------------

_SMALL_CONTROL = Factor(
    # A floor of 0.8: control changes the reward by a fifth at most.
    of=Control(),
    low=0.0,
    high=0.0,
    margin=1.0,
    value_at_margin=0.0,
    shape="quadratic",
    floor=0.8,
)


def _upright(body: str, **tolerance: float) -> Factor:
    """Return (1 + cos) / 2 of the angle from upright, unless `tolerance` says otherwise."""
    fields = {"low": 1.0, "margin": 2.0, "value_at_margin": 0.0} | tolerance
    return Factor(of=BodyAxes(bodies=body, entries=("zz",)), shape="linear", **fields)


# -- the tasks -----------------------------------------------------------------------------------------------------


def _acrobot(margin: float) -> dict[str, ToleranceProduct]:
    # 0.2 m is the target's radius.
    to_target = Distance(of=Offset(ends=("site:target",), start="site:tip"))
    return _reward(near=Factor(of=to_target, high=0.2, margin=margin))


_CART = mdp.JointPos(joints="slider")
_CARTPOLE = _reward(
    upright=_upright("pole_1"),
    small_control=_SMALL_CONTROL,
    small_velocity=Factor(
        of=mdp.JointVel(joints="hinge_1"), low=0.0, high=0.0, margin=5.0, floor=0.5
    ),
    centered=Factor(of=_CART, low=0.0, high=0.0, margin=2.0, floor=0.5),
)
_CARTPOLE_SPARSE = _reward(
    # Without a margin a factor is 1 inside its bounds and 0 outside: a sparse reward.
    centered=Factor(of=_CART, low=-0.25, high=0.25),
    upright=Factor(of=BodyAxes(bodies="pole_1", entries=("zz",)), low=0.995),
)
# Position and velocity of each joint: normal with these means, std 0.01.
_HANGING: Mapping[str, EventTerm] = {
    joint: mdp.ResetJoints(
        joints=joint,
        position_range=(mean, 0.01),
        velocity_range=(0.0, 0.01),
        distribution="gaussian",
    )
    for joint, mean in (("slider", 0.0), ("hinge_1", math.pi))
}


def _turn(radius: float) -> SuiteTask:
    target = Offset(ends=("command:target",), start="body:spinner", axes="xz")
    # The radius is part of the distance, so that 0 is its surface.
    distance = Distance(
        of=Offset(ends=("command:target",), start="site:tip", axes="xz"), radius=radius
    )
    return SuiteTask(
        description=f"turn a free body to a target of {100 * radius:g} cm",
        rewards=_reward(inside=Factor(of=distance, high=0.0)),
        # A circle about the spinner, where the tip can be brought by turning.
        target=RingTarget(center=(0.2, 0.0, 0.4), radius=(0.13, 0.13), plane="xz", size=radius),
        observations={"target_position": target, "dist_to_target": distance},
    )


_HOPPER_UP = Factor(of=Offset(ends=("com:torso",), start="com:foot", axes="z"), low=0.6, high=2.0)


def _humanoid(move: Factor) -> dict[str, ToleranceProduct]:
    return _reward(
        standing=Factor(of=Offset(ends=("body:head",), axes="z"), low=1.4, margin=0.35),
        upright=_upright("torso", low=0.9, margin=1.9),
        small_control=_SMALL_CONTROL,
        move=move,
    )


_HUMANOID_VELOCITY = Readings(sensors=("torso_subtreelinvel.xy",))
_HUMANOID_STILL = Factor(of=_HUMANOID_VELOCITY, low=0.0, high=0.0, margin=2.0)


def _humanoid_speed(low: float) -> Factor:
    speed = Distance(of=_HUMANOID_VELOCITY)
    # The floor keeps standing worth a sixth, for a robot that does not move yet.
    return Factor(
        of=speed, low=low, margin=low, value_at_margin=0.0, shape="linear", floor=1.0 / 6.0
    )


def _reach(radius: float) -> SuiteTask:
    distance = Distance(of=Offset(ends=("command:target",), start="geom:finger", axes="xy"))
    return SuiteTask(
        description=f"a planar arm reaches a ball of {100 * radius:g} cm",
        # 1 cm is the finger's radius.
        rewards=_reward(inside=Factor(of=distance, high=radius + 0.01)),
        target=RingTarget(center=(0.0, 0.0, 0.01), radius=(0.05, 0.2), size=radius),
        # Easy and hard came to 983 and 977 after 60 M env states; with 0.995 to 980 and 972 after 88 M.
        gamma=0.97,
    )


def _walker(*speeds: float) -> dict[str, ToleranceProduct]:
    standing = Factor(of=Offset(ends=("body:torso",), axes="z"), low=1.2, margin=0.6)
    factors = {
        # Half the speed counts as half.
        f"move_{number}": _speed(low, margin=low / 2.0, value_at_margin=0.5, floor=1.0 / 6.0)
        for number, low in enumerate(speeds)
    }
    return {
        # The sum (3 standing + upright) / 4 of dm_control, times the speed, as two weighted products.
        "standing": _product(0.75, standing=standing, **factors),
        "upright": _product(0.25, upright=_upright("torso"), **factors),
    }


_BALL_OFFSET = {axis: Offset(ends=("site:target",), start="body:ball", axes=axis) for axis in "xz"}
_FISH_TO_TARGET = Distance(of=Offset(ends=("command:target",), start="geom:mouth"))
_SWIMMER_TO_TARGET = Distance(
    of=Offset(ends=("command:target",), start="geom:nose", frame="body:head", axes="xy")
)
_POINT_MASS_TO_TARGET = Distance(of=Offset(ends=("geom:target",), start="geom:pointmass"))

SUITE_TASKS: Mapping[str, SuiteTask] = {
    "acrobot_swingup": SuiteTask(
        description="swing two links up, the motor between them",
        rewards=_acrobot(1.0),
        ppo_states=LONG,
        fast_sac_states=FAST_SAC_LONG,
    ),
    "acrobot_swingup_sparse": SuiteTask(
        description="the same, with a reward at the target only",
        rewards=_acrobot(0.0),
        ppo_states=LONG,
        fast_sac_states=FAST_SAC_LONG,
    ),
    "ball_in_cup_catch": SuiteTask(
        description="catch a ball on a string in the cup",
        # Half the cup less the ball's radius.
        rewards=_reward(
            **{a: Factor(of=offset, low=-0.025, high=0.025) for a, offset in _BALL_OFFSET.items()}
        ),
        gamma=0.95,
    ),
    "cartpole_balance": SuiteTask(description="keep a pole upright on a cart", rewards=_CARTPOLE),
    "cartpole_balance_sparse": SuiteTask(
        description="the same, with a reward near upright and the middle only",
        rewards=_CARTPOLE_SPARSE,
    ),
    "cartpole_swingup": SuiteTask(
        description="swing a hanging pole up and keep it upright",
        rewards=_CARTPOLE,
        events=_HANGING,
    ),
    "cartpole_swingup_sparse": SuiteTask(
        description="the same, with a reward near upright and the middle only",
        rewards=_CARTPOLE_SPARSE,
        events=_HANGING,
    ),
    "cheetah_run": SuiteTask(
        description="a planar cheetah runs at 10 m/s",
        rewards=_reward(fast=_speed(10.0, margin=10.0, value_at_margin=0.0)),
    ),
    "finger_spin": SuiteTask(
        description="spin a free body at 15 rad/s",
        rewards=_reward(spinning=Factor(of=Readings(sensors=("hinge_velocity",)), high=-15.0)),
        damping={"hinge": 0.03},
        gamma=0.95,
    ),
    "finger_turn_easy": _turn(0.07),
    "finger_turn_hard": _turn(0.03),
    "fish_swim": SuiteTask(
        description="a fish swims to a target",
        rewards={
            # Both radii.
            "in_target": _product(
                7.0 / 8.0, near=Factor(of=_FISH_TO_TARGET, high=0.045, margin=0.09)
            ),
            "upright": _product(1.0 / 8.0, upright=_upright("torso")),
        },
        target=BoxTarget(low=(-0.4, -0.4, 0.1), high=(0.4, 0.4, 0.3), size=0.04),
    ),
    "hopper_hop": SuiteTask(
        description="a planar hopper hops at 2 m/s",
        rewards=_reward(standing=_HOPPER_UP, hopping=_speed(2.0, margin=1.0, value_at_margin=0.5)),
        fast_sac_states=FAST_SAC_LONG,
    ),
    "hopper_stand": SuiteTask(
        description="a planar hopper stands",
        rewards=_reward(standing=_HOPPER_UP, small_control=_SMALL_CONTROL),
        fast_sac_states=FAST_SAC_LONG,
    ),
    "humanoid_stand": SuiteTask(
        description="a humanoid stands up and stays there",
        rewards=_humanoid(_HUMANOID_STILL),
        fast_sac_states=FAST_SAC_LONG,
    ),
    "humanoid_walk": SuiteTask(
        description="a humanoid walks at 1 m/s",
        rewards=_humanoid(_humanoid_speed(1.0)),
        fast_sac_states=FAST_SAC_LONG,
    ),
    "humanoid_run": SuiteTask(
        description="a humanoid runs at 10 m/s",
        rewards=_humanoid(_humanoid_speed(10.0)),
        fast_sac_states=FAST_SAC_LONG,
    ),
    "pendulum_swingup": SuiteTask(
        description="swing a pendulum up with little torque; a reward within 8 degrees of upright only",
        rewards=_reward(
            upright=Factor(
                of=BodyAxes(bodies="pole", entries=("zz",)), low=math.cos(math.radians(8.0))
            )
        ),
        fast_sac_states=FAST_SAC_LONG,
    ),
    "point_mass_easy": SuiteTask(
        description="move a mass to the middle",
        rewards=_reward(
            near=Factor(of=_POINT_MASS_TO_TARGET, high=0.015, margin=0.015),
            small_control=_SMALL_CONTROL,
        ),
    ),
    "reacher_easy": _reach(0.05),
    "reacher_hard": _reach(0.015),
    "swimmer_swimmer6": SuiteTask(
        description="a chain of six links swims to a target",
        rewards=_reward(
            near=Factor(of=_SWIMMER_TO_TARGET, high=0.1, margin=0.5, shape="long_tail")
        ),
        # One of five targets is near.
        target=BoxTarget(
            low=(-2.0, -2.0, 0.05),
            high=(2.0, 2.0, 0.05),
            near_share=0.2,
            near_scale=(0.15, 0.15, 1.0),
            size=0.1,
        ),
        ppo_states=LONG,
    ),
    "walker_stand": SuiteTask(description="a planar walker stands", rewards=_walker()),
    "walker_walk": SuiteTask(description="a planar walker walks at 1 m/s", rewards=_walker(1.0)),
    "walker_run": SuiteTask(
        description="a planar walker runs at 8 m/s", rewards=_walker(8.0), ppo_states=LONG
    ),
}
"""The tasks by `<domain>_<task>`."""


def domain_of(name: str) -> str:
    """Return the domain of a task of `SUITE_TASKS`."""
    # The first domain that fits: no domain's name begins another's.
    return next(domain for domain in DOMAINS if name.startswith(f"{domain}_"))


def make_cfg(name: str, variant: Variant) -> ManagerBasedRlEnvCfg:
    """Return the config of a task of `SUITE_TASKS`."""
    task = SUITE_TASKS[name]
    domain = DOMAINS[domain_of(name)]
    if variant == "playground":
        # Playground changes some fields of a domain, and keeps the others.
        domain = dataclasses.replace(domain, **domain.playground)
    terms = {
        key: ObservationTermCfg(term=term)
        # The domain's observations come first, in dm_control's order.
        for key, term in {**domain.observations, **task.observations}.items()
    }
    model = DmControlModel(domain=domain_of(name), variant=variant, damping=task.damping)
    return ManagerBasedRlEnvCfg(
        decimation=domain.decimation,
        scene=SceneCfg(robots={domain_of(name): model}, num_envs=training.NUM_ENVS),
        sim=domain.sim,
        observations=dict.fromkeys(("actor", "critic"), ObservationGroupCfg(terms=terms)),
        actions={"controls": mdp.ActuatorAction(actuators=".*")},
        # Tasks with targets draw them at each reset.
        commands={} if task.target is None else {"target": task.target},
        # Some tasks start elsewhere than their domain does.
        events=domain.events if task.events is None else task.events,
        rewards=task.rewards,
        terminations={"time_out": mdp.TimeOut(time_out=True)},
        episode_length_s=EPISODE_STEPS * CONTROL_S[domain_of(name)],
        # Rewards lie in [0, 1] per step: a return is out of 1000.
        scale_rewards_by_dt=False,
        viewer=domain.viewer,
    )


def _task(name: str, variant: Variant) -> Task:
    task = SUITE_TASKS[name]
    return Task(
        name=f"{variant}_{name}",
        suite="dm_control",
        description=task.description,
        cfg=partial(make_cfg, name, variant),
        training=training.ppo(gamma=task.gamma, env_states=task.ppo_states),
        other_trainings=(training.fast_sac_training(env_states=task.fast_sac_states),),
    )


TASKS = tuple(_task(name, variant) for variant in get_args(Variant) for name in SUITE_TASKS)
"""All tasks in both variants, for the registry."""
