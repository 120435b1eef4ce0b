"""The robots that come with this package, and how MJCF files of others are edited."""

from ksim_rl.scene.robots import edit
from ksim_rl.scene.robots.analysis import JointAnalysis, RobotAnalysis, analyse
from ksim_rl.scene.robots.booster_t1 import BoosterT1, GrippingT1
from ksim_rl.scene.robots.control_models import (
    Arm,
    Cartpole,
    Cheetah,
    Hopper,
    Pendulum,
    Reacher,
    Walker,
)
from ksim_rl.scene.robots.legged_robot import LeggedRobot, MenagerieRobot, ModelRobot
from ksim_rl.scene.robots.own_robots import Humanoid, Quadruped
from ksim_rl.scene.robots.unitree_g1 import UnitreeG1
from ksim_rl.scene.robots.unitree_go import UnitreeGo1, UnitreeGo2

__all__ = [
    "analyse",
    "edit",
    *sorted(name for name, value in vars().items() if isinstance(value, type)),
]  # pyright: ignore
