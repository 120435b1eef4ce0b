"""Planar robots stand, walk, run and hop in the xz plane, rated by posture and speed, or as a recorded walk does.

The tasks are from dm_control's suite (Tassa et al., "DeepMind Control Suite", 2018) on robots of our own:
rewards in [0, 1], 1000 steps per episode, no early end. Unlike there, episodes start standing; who falls has to get up.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from jaxtyping import Float
from torch import Tensor

from ksim_rl import mdp
from ksim_rl.checked import NonNegative
from ksim_rl.data import DatasetCfg
from ksim_rl.envs.manager_based_rl_env_cfg import ManagerBasedRlEnvCfg
from ksim_rl.envs.task import Task
from ksim_rl.envs.term import MetricTerm, RewardTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.rewards.tracking import tolerance
from ksim_rl.modules import ActorCfg, CriticCfg
from ksim_rl.objectives import AMPCfg, PPOCfg
from ksim_rl.physics import SimCfg
from ksim_rl.scene.robots.control_models import WALKER_SERVOS, Cheetah, Hopper, Walker
from ksim_rl.scene.scene import SceneCfg
from ksim_rl.scene.terrains import PlaneTerrain
from ksim_rl.scene.viewer_cfg import ViewerCfg
from ksim_rl.trainers import ModulesCfg, TrainerCfg, TrainingCfg
from ksim_rl.transforms.groups.group_cfg import ObservationGroupCfg, ObservationTermCfg

STEPS_PER_EPISODE = 1000
SIM = SimCfg(iterations=10, ls_iterations=20)


def height(view: EnvView) -> Float[Tensor, " E"]:
    """Return the torso's height, m, [E]; position stage."""
    return view.joints("root_z").pos_EL[:, 0]


def upright(view: EnvView) -> Float[Tensor, " E"]:
    """Return 1 where the torso is upright, 0 where it is upside down, linear in the cosine between, [E]."""
    # Gravity's z in the torso's frame is -cos of the tilt.
    return (1.0 - view.projected_gravity_EL[:, 2]) / 2.0


def forward_speed(view: EnvView) -> Float[Tensor, " E"]:
    """Return the velocity of the centre of mass along x, m/s, [E]; velocity stage."""
    return view.sensor("com_velocity")[:, 0]


def small_effort(view: EnvView) -> Float[Tensor, " E"]:
    """Return 1 without any action, 0 where each is at or beyond its limit, [E]."""
    # Raw actions may leave [-1, 1]; the motors clamp them there.
    return (1.0 - view.action_EL.clamp(-1.0, 1.0).square()).mean(-1)


def _fast(
    view: EnvView, speed: float, *, margin: float, value_at_margin: float = 0.0
) -> Float[Tensor, " E"]:
    """Return 1 from a forward speed (m/s) on, falling linearly to `value_at_margin` a margin below it."""
    forward_E = forward_speed(view)
    return tolerance(
        forward_E, low=speed, margin=margin, value_at_margin=value_at_margin, shape="linear"
    )


@dataclass(frozen=True, kw_only=True)
class ForwardSpeed(MetricTerm):
    """Velocity of the centre of mass along x, m/s, [E]; velocity stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        return forward_speed(view)


def _own_state(motors: str) -> dict[str, ObservationTermCfg]:
    """Return each planar robot's observations of itself."""
    return {
        "gravity": ObservationTermCfg(term=mdp.ProjectedGravity()),
        # Without `root_x`: how far it has run must not matter.
        "joint_pos": ObservationTermCfg(term=mdp.JointPos(joints=("root_z", motors))),
        "joint_vel": ObservationTermCfg(term=mdp.JointVel()),
    }


def planar_cfg(
    robot: Cheetah | Hopper | Walker,
    *,
    reward: RewardTerm,
    decimation: int,
    step_dt: float,
    distance: float,
) -> ManagerBasedRlEnvCfg:
    """Put a planar task together; an env step lasts `step_dt`, s, and the camera's `distance` is in m."""
    motors = robot.joints
    # Actor and critic see the same.
    seen = ObservationGroupCfg(terms=_own_state(motors))
    return ManagerBasedRlEnvCfg(
        decimation=decimation,
        scene=SceneCfg(robots={"robot": robot}, terrain=PlaneTerrain(), num_envs=2048),
        sim=SIM,
        observations={"actor": seen, "critic": seen},
        actions={"torque": mdp.JointEffortAction(joints=motors)},
        events={
            # A little above the ground, so that no foot starts inside of it.
            "height": mdp.ResetJoints(joints="root_z", position_range=(0.02, 0.08)),
            "pitch": mdp.ResetJoints(joints="root_y", position_range=(-0.1, 0.1)),
            "legs": mdp.ResetJoints(
                joints=motors, position_range=(-0.1, 0.1), velocity_range=(-0.1, 0.1)
            ),
        },
        rewards={"task": reward},
        terminations={"time_out": mdp.TimeOut(time_out=True)},
        metrics={"forward_speed": ForwardSpeed()},
        # Measured in steps, since the control rates differ.
        episode_length_s=STEPS_PER_EPISODE * step_dt,
        # Rewards lie in [0, 1] per step, so that a perfect episode gives 1000.
        scale_rewards_by_dt=False,
        viewer=ViewerCfg(body="torso", distance=distance, elevation=-10.0, azimuth=90.0),
    )


OBJECTIVE: dict[str, Any] = {"entropy_coeff": 0.002, "clip_value": False}


def training(*, num_iterations: int = 500, objective: PPOCfg | None = None) -> TrainingCfg:
    """Return the training settings of a planar runner."""
    return TrainingCfg(
        num_envs=2048,
        objective=objective or PPOCfg(**OBJECTIVE),
        data=DatasetCfg(num_env_states_per_minibatch=16384, num_minibatches=4),
        modules=ModulesCfg(
            actor=ActorCfg(hidden_dims=(256, 128), init_std=0.6),
            critic=CriticCfg(hidden_dims=(256, 128)),
        ),
        trainer=TrainerCfg(num_iterations=num_iterations, eval_interval=50),
    )


def _task(
    name: str,
    cfg: Callable[[], ManagerBasedRlEnvCfg],
    what: str,
    num_iterations: int = 500,
    solved_at: float | None = None,
) -> Task:
    settings = training(num_iterations=num_iterations)
    return Task(name=name, description=what, cfg=cfg, training=settings, solved_at=solved_at)


# -- a hind and a fore leg ---------------------------------------------------------------------------------------

CHEETAH_SPEED = 8.0


@dataclass(frozen=True, kw_only=True)
class CheetahReward(RewardTerm):
    """Forward speed over `CHEETAH_SPEED`, clipped to [0, 1]; velocity stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        # From a stand the reward rises in proportion to the speed.
        return _fast(view, CHEETAH_SPEED, margin=CHEETAH_SPEED)


def cheetah_run() -> ManagerBasedRlEnvCfg:
    """Return the config of running as fast as 8 m/s."""
    return planar_cfg(Cheetah(), reward=CheetahReward(), decimation=2, step_dt=0.01, distance=3.5)


# 5.9 m/s from 1 s on (5.9 / 8 in 900 of 1000 steps), after a start that is uniformly faster (half of that in 100).
CHEETAH_RUN = _task("cheetah_run", cheetah_run, "a planar quadruped runs at 8 m/s", solved_at=700.0)

# -- one leg -----------------------------------------------------------------------------------------------------

HOPPER_HEIGHT = 0.7
"""m from the foot to the torso; standing at rest gives 0.81."""


@dataclass(frozen=True, kw_only=True)
class HopperReward(RewardTerm):
    """tall * fast, or tall * (4 + small effort) / 5 without a speed, in [0, 1]; position and velocity stage.

    "tall" is 1 where the torso is `HOPPER_HEIGHT` above the foot, which holds in flight too, and where it is upright;
    "fast" rates the forward speed against `speed`, m/s; 0 only asks the robot to stand.
    """

    speed: NonNegative = 0.0

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        # Height above the foot, so that jumping alone gives nothing.
        foot_E = view.body("foot").pos_EL[:, 2]
        tall_E = tolerance(height(view) - foot_E, low=HOPPER_HEIGHT, margin=HOPPER_HEIGHT / 2)
        stand_E = tall_E * upright(view)
        if self.speed == 0.0:
            return stand_E * (4.0 + small_effort(view)) / 5.0
        return stand_E * _fast(view, self.speed, margin=self.speed)


def hopper(speed: float) -> ManagerBasedRlEnvCfg:
    """Return the config of hopping forward at `speed`, m/s, or faster; at 0, of balancing on one leg."""
    reward = HopperReward(speed=speed)
    return planar_cfg(Hopper(), reward=reward, decimation=4, step_dt=0.02, distance=3.5)


# Tall and upright in all 1000 steps, with half of the effort saved: (4 + 0.5) / 5 each.
HOPPER_STAND = _task(
    "hopper_stand", partial(hopper, 0.0), "a one-legged planar robot balances", solved_at=900.0
)
HOPPER_HOP = _task(
    "hopper_hop", partial(hopper, 1.5), "a one-legged planar robot hops forward at 1.5 m/s", 1000
)

# -- two legs ----------------------------------------------------------------------------------------------------

WALKER_HEIGHT = 1.15
"""m of the torso above the ground."""


@dataclass(frozen=True, kw_only=True)
class WalkerReward(RewardTerm):
    """(3 tall + upright) / 4 * (5 fast + 1) / 6, in [0, 1]; position and velocity stage.

    "tall" rates the torso's height against `WALKER_HEIGHT`, "fast" the forward speed against `speed`, m/s. Standing
    alone gives 1 where no speed is asked, else 1/6.
    """

    speed: NonNegative = 0.0

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        tall_E = tolerance(height(view), low=WALKER_HEIGHT, margin=WALKER_HEIGHT / 2)
        stand_E = (3.0 * tall_E + upright(view)) / 4.0
        if self.speed == 0.0:
            return stand_E
        # Half of "fast" is left at half the speed; the factor below keeps standing worth something.
        fast_E = _fast(view, self.speed, margin=self.speed / 2, value_at_margin=0.5)
        return stand_E * (5.0 * fast_E + 1.0) / 6.0


def walker(speed: float) -> ManagerBasedRlEnvCfg:
    """Return the config of walking at `speed`, m/s, or faster; at 0, of standing upright."""
    reward = WalkerReward(speed=speed)
    return planar_cfg(Walker(), reward=reward, decimation=5, step_dt=0.025, distance=4.0)


# Upright from 1.25 s on (950 of 1000 steps), with nothing before that.
WALKER_STAND = _task(
    "walker_stand", partial(walker, 0.0), "a planar biped stands upright", solved_at=950.0
)
# At full speed from 3 s on (880 of 1000 steps), and standing before that (1 / 6 in 120).
WALKER_WALK = _task(
    "walker_walk", partial(walker, 1.0), "a planar biped walks at 1 m/s", solved_at=900.0
)
WALKER_RUN = _task("walker_run", partial(walker, 5.0), "a planar biped runs at 5 m/s", 1000)

# -- a recorded walk ---------------------------------------------------------------------------------------------

# `walker_track` follows the walk (Peng et al., "DeepMimic", 2018): episodes start anywhere in the motion, in its state
# there, and end when the robot strays from it. The reward's parts are theirs; the robot's own root stands in for the
# centre of mass. The reward of `walker_amp` asks for the speed alone (Peng et al., "AMP", arXiv 2104.02180): how to
# walk is learned from the motion, as `objective=amp` compares the group "style"; the policy never sees the motion, nor
# where in it it should be.

MOTION = "walker_walk"
SPEED = 0.8
CYCLE_S = 1.0
"""m/s, and s of one stride, of that motion."""
FEET = ("right_foot", "left_foot")


@dataclass(frozen=True, kw_only=True)
class WalkAt(RewardTerm):
    """1 at a forward speed within 0.1 m/s of `speed`, 0.1 where it is off by as much again as `speed` (m/s)."""

    speed: float

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        low = self.speed - 0.1
        high = self.speed + 0.1
        return tolerance(forward_speed(view), low=low, high=high, margin=self.speed)


def _motion_cfg(
    terms: Mapping[str, ObservationTermCfg],
    groups: Sequence[str] = ("actor", "critic"),
    **parts: Any,
) -> ManagerBasedRlEnvCfg:
    """Put together the parts that both tasks share: the robot, its servos, and its observations with `terms`."""
    robot = Walker(actuators=WALKER_SERVOS)
    seen = {**_own_state(Walker.joints), **terms}
    return ManagerBasedRlEnvCfg(
        decimation=4,
        scene=SceneCfg(robots={"walker": robot}, terrain=PlaneTerrain(), num_envs=2048),
        sim=SIM,
        observations=dict.fromkeys(groups, ObservationGroupCfg(terms=seen)),
        actions={"legs": mdp.JointPositionAction(joints=Walker.joints, scale=0.5)},
        episode_length_s=8.0,
        viewer=ViewerCfg(body="torso", distance=4.0, elevation=-10.0, azimuth=90.0),
        **parts,
    )


def walker_amp() -> ManagerBasedRlEnvCfg:
    """Return the config of walking at the speed of the motion `walker_walk`."""
    return _motion_cfg(
        {},
        # The group "style" is the one that AMP compares with the motion.
        ("actor", "critic", "style"),
        events={"reset": mdp.ResetToMotion(file=MOTION)},
        rewards={"walk": WalkAt(speed=SPEED)},
        terminations={"time_out": mdp.TimeOut(), "fallen": mdp.RootHeightBelow(minimum_height=0.8)},
        metrics={
            "forward_speed": ForwardSpeed(),
            "pose_distance": mdp.PoseDistance(file=MOTION, joints=Walker.joints),
        },
        # One per step at most, as in the other planar tasks.
        scale_rewards_by_dt=False,
    )


def walker_track() -> ManagerBasedRlEnvCfg:
    """Return the config of walking as the motion `walker_walk` does."""
    terms = {
        "phase": ObservationTermCfg(term=mdp.MotionPhase(file=MOTION, cycle_s=CYCLE_S)),
        "reference": ObservationTermCfg(term=mdp.MotionJoints(file=MOTION, joints=Walker.joints)),
        "drift": ObservationTermCfg(term=mdp.MotionBodyOffset(file=MOTION, bodies="torso")),
    }
    return _motion_cfg(
        terms,
        # The last tenth is left out, so that an episode has something to follow.
        events={"reset": mdp.ResetToMotion(file=MOTION, start_range=(0.0, 0.9))},
        rewards={
            "joint_pos": mdp.TrackMotionJointPos(
                file=MOTION, joints=Walker.joints, std=0.7, weight=0.65
            ),
            "joint_vel": mdp.TrackMotionJointVel(
                file=MOTION, joints=Walker.joints, std=3.2, weight=0.1
            ),
            "feet": mdp.TrackMotionBodyPos(file=MOTION, bodies=FEET, std=0.16, weight=0.15),
            "root": mdp.TrackMotionBodyPos(file=MOTION, bodies="torso", std=0.32, weight=0.05),
            "root_rotation": mdp.TrackMotionBodyQuat(
                file=MOTION, bodies="torso", std=0.32, weight=0.05
            ),
            "action_rate": mdp.ActionRateL2(weight=-0.001),
        },
        terminations={
            "finished": mdp.MotionFinished(file=MOTION),
            # Early termination: a robot that has strayed sees states that the motion never has.
            "strayed": mdp.FarFromMotion(file=MOTION, bodies="torso", distance=0.4),
        },
    )


AS_RECORDED = AMPCfg(motions=(MOTION,), **OBJECTIVE)
# At its speed from 1 s on, in 350 of 400 steps.
AMP = Task(
    name="walker_amp",
    description="a planar biped walks at 0.8 m/s, with objective=amp as a recorded walk does",
    cfg=walker_amp,
    training=training(num_iterations=400),
    other_trainings=(training(num_iterations=400, objective=AS_RECORDED),),
    solved_at=350.0,
)
# Nine tenths of the rewards, which are 1 together, in the 4.4 s that are left of the walk where an episode starts.
TRACK = _task("walker_track", walker_track, "a planar biped follows a walk", 400, 3.9)
