"""The tasks PandaPickCube and LeapCubeReorient of MuJoCo Playground, on the models that a package of assets ships."""

from ksim_rl.suites.manipulation.bodies import LeavesBox, PlaceFreeBody, PlaygroundModel
from ksim_rl.suites.manipulation.leap import (
    ActuatorPower,
    GoalAngle,
    GoalOrientation,
    GoalsReached,
    GoalTurn,
)
from ksim_rl.suites.manipulation.panda import CarryToTarget, OneMinusTanh, TurnFromUpright
from ksim_rl.suites.manipulation.targets import JointTarget, MoveTargets, TargetsAtJoints
from ksim_rl.suites.manipulation.tasks import TASKS
