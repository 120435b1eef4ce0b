"""This module describes the terms that tasks of ours keep for themselves."""

import math
from typing import Any

from ksim_rl.envs.view import EnvView
from ksim_rl.export.describe import Node, describe, op, quantity
from ksim_rl.tasks import control_suite

CART, HINGE = (quantity("joint_pos", joints=[name]) for name in ("slider", "hinge"))


@describe.register(control_suite.CartpolePosition)
def _position(*_: Any) -> Node:
    return op("concat", CART, op("cos", HINGE), op("sin", HINGE))


@describe.register(control_suite.CartpoleReward)
def _reward(term: Any, view: EnvView) -> Node:
    def near_zero(value: Node, margin: float) -> Node:
        return op("exp", op("multiply", math.log(0.1), op("square", op("divide", value, margin))))

    def rated(one: float, value: Node, most: float) -> Node:
        return op("divide", op("add", one, value), most)

    force = op("clip", op("take", quantity("action"), indices=[0]), low=-1.0, high=1.0)
    small_control = rated(4.0, op("subtract", 1.0, op("square", force)), 5.0)
    small_velocity = rated(1.0, near_zero(quantity("joint_vel", joints=["hinge"]), 5.0), 2.0)
    upright, centered = rated(1.0, op("cos", HINGE), 2.0), rated(1.0, near_zero(CART, 2.0), 2.0)
    return op("multiply", op("multiply", upright, centered), op("multiply", small_control, small_velocity))


@describe.register(control_suite.PoleFallen)
def _fallen(term: control_suite.PoleFallen, view: EnvView) -> Node:
    return op("less", op("cos", HINGE), math.cos(term.limit))
