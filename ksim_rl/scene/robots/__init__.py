"""The robots that come with this package, and how MJCF files of others are edited."""

from ksim_rl.scene.robots import edit
from ksim_rl.scene.robots.arm import Arm
from ksim_rl.scene.robots.booster_t1 import BoosterT1
from ksim_rl.scene.robots.cartpole import Cartpole
from ksim_rl.scene.robots.cheetah import Cheetah
from ksim_rl.scene.robots.hopper import Hopper
from ksim_rl.scene.robots.humanoid import Humanoid
from ksim_rl.scene.robots.legged_robot import LeggedRobot
from ksim_rl.scene.robots.pendulum import Pendulum
from ksim_rl.scene.robots.quadruped import Quadruped
from ksim_rl.scene.robots.reacher import Reacher
from ksim_rl.scene.robots.unitree_g1 import UnitreeG1
from ksim_rl.scene.robots.unitree_go1 import UnitreeGo1
from ksim_rl.scene.robots.unitree_go2 import UnitreeGo2
from ksim_rl.scene.robots.walker import Walker

__all__ = [
    "Arm",
    "BoosterT1",
    "Cartpole",
    "Cheetah",
    "Hopper",
    "Humanoid",
    "LeggedRobot",
    "Pendulum",
    "Quadruped",
    "Reacher",
    "UnitreeG1",
    "UnitreeGo1",
    "UnitreeGo2",
    "Walker",
    "edit",
]
