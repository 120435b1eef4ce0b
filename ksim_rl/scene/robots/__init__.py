"""The robots that come with this package, and how MJCF files of others are edited."""

from ksim_rl.scene.robots import edit
from ksim_rl.scene.robots.booster_t1 import BoosterT1
from ksim_rl.scene.robots.control_models import Arm, Cartpole, Cheetah, Hopper, Pendulum, Reacher, Walker
from ksim_rl.scene.robots.legged_robot import LeggedRobot, MenagerieRobot
from ksim_rl.scene.robots.own_robots import Humanoid, Quadruped
from ksim_rl.scene.robots.unitree_g1 import UnitreeG1
from ksim_rl.scene.robots.unitree_go1 import UnitreeGo1
from ksim_rl.scene.robots.unitree_go2 import UnitreeGo2

__all__ = [
    "Arm",
    "BoosterT1",
    "Cartpole",
    "Cheetah",
    "Hopper",
    "Humanoid",
    "LeggedRobot",
    "MenagerieRobot",
    "Pendulum",
    "Quadruped",
    "Reacher",
    "UnitreeG1",
    "UnitreeGo1",
    "UnitreeGo2",
    "Walker",
    "edit",
]
