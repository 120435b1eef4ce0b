"""An exported folder of a body with two driven joints, made by hand: no training, no tracing, in milliseconds."""

import json

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from ksim_rl.export.folder import loop_source, runner_source

MODEL = """
<mujoco model="toy">
  <compiler angle="radian"/>
  <option timestep="0.005" integrator="implicitfast"/>
  <default>
    <default class="geared">
      <general gear="2" biastype="affine" gainprm="15" biasprm="0 -7.5 -0.25" forcerange="-9 9"/>
    </default>
    <default class="plain">
      <general biastype="affine" gainprm="20" biasprm="0 -20 -1" forcerange="-18 18"/>
    </default>
  </default>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 0.1"/>
    <body name="trunk" pos="0 0 0.4">
      <freejoint name="root"/>
      <geom type="box" size="0.2 0.15 0.05" mass="4"/>
      <site name="imu" pos="0.05 0 0" euler="0 0 0.5"/>
      <body name="left" pos="0 0.15 0">
        <joint name="left" axis="0 1 0" range="-2 1.5" damping="0.1" armature="0.02"/>
        <geom type="capsule" size="0.03" fromto="0 0 0 0 0 -0.3" mass="0.5"/>
      </body>
      <body name="right" pos="0 -0.15 0">
        <joint name="right" axis="0 1 0" range="-2 1.5" damping="0.1" armature="0.02"/>
        <geom type="capsule" size="0.03" fromto="0 0 0 0 0 -0.3" mass="0.5"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <general name="right" joint="right" class="geared"/>
    <general name="left" joint="left" class="plain"/>
  </actuator>
  <sensor><gyro name="imu_ang_vel" site="imu"/></sensor>
  <keyframe><key qpos="0 0 0.4 1 0 0 0 0.3 -0.2" ctrl="-0.1 0.3"/></keyframe>
</mujoco>
"""
JOINTS = ["right", "left"]
DEFAULT = [-0.2, 0.3]
# Each quantity that follows from joints, attitude and the loop itself, and one that only a robot can know.
READ = {
    "joint_pos": {"joints": ["left", "right"]},
    "joint_pos_rel": {"joints": JOINTS},
    "joint_vel": {"joints": ["left"]},
    "joint_effort": {"joints": JOINTS},
    "default_joint_pos": {"joints": JOINTS},
    "encoder_bias": {"joints": JOINTS},
    "joint_pos_target": {"joints": JOINTS},
    "root_quat": {"body": "trunk"},
    "projected_gravity": {"body": "trunk"},
    "root_ang_vel": {"body": "trunk", "frame": "world"},
    "sensor": {"sensor": "imu_ang_vel"},
    "action": {},
    "last_action": {},
    "command": {"command": "twist"},
    "time": {},
}
SIZES = {
    "joint_vel": 1,
    "root_quat": 4,
    "projected_gravity": 3,
    "root_ang_vel": 3,
    "sensor": 3,
    "time": 1,
}


def toy_folder(folder):
    """Write the folder, and return it; its policy is a random matrix."""
    folder.mkdir(parents=True, exist_ok=True)
    sizes = {name: SIZES.get(name, 2) for name in READ}
    inputs = []
    for name, size in sizes.items():
        inputs.append(helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, size]))
    length = sum(sizes.values())
    obs = helper.make_tensor_value_info("obs", TensorProto.FLOAT, [1, length])
    actions = helper.make_tensor_value_info("actions", TensorProto.FLOAT, [1, 2])
    _save(
        folder / "obs.onnx", [helper.make_node("Concat", list(sizes), ["obs"], axis=1)], inputs, obs
    )
    draws = np.random.default_rng(5)
    weights = numpy_helper.from_array(
        draws.normal(0.0, 0.3, (length, 2)).astype(np.float32), "weights"
    )
    node = helper.make_node("MatMul", ["obs", "weights"], ["actions"])
    _save(folder / "policy.onnx", [node], [obs], actions, [weights])
    (folder / "robot.xml").write_text(MODEL)
    (folder / "export.json").write_text(json.dumps(_meta(sizes)))
    (folder / "runner.py").write_text(runner_source())
    (folder / "loop.py").write_text(loop_source())
    return folder


def _save(path, nodes, inputs, output, weights=()):
    graph = helper.make_graph(nodes, "toy", inputs, [output], list(weights))
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)
    onnx.save(model, path)


def _meta(sizes):
    measurements = []
    observations = []
    for name, node in READ.items():
        measurements.append({"input": name, "quantity": name, **node})
        term = {"name": name, "size": sizes[name], "clip": [-1.5, None], "scale": 0.7}
        observations.append({**term, "noise": None, "delay": None})
    action = {
        "name": "targets",
        "kind": "pos",
        "columns": [0, 2],
        "names": JOINTS,
        "limits": [-1e30, 1e30],
        "clip": [-2.0, 2.0],
        "tanh": False,
        "scale": [0.3, 0.4],
        "offset": DEFAULT,
        "alpha": 0.6,
        "relative": False,
        "from_default": True,
    }
    servo = {"kind": "builtin", "takes": ["pos"], "numbers": {}, "delay": None}
    gears = {"scale": [1.0, 1.0], "offset": [0.0, 0.0]}
    return {
        "format": 2,
        "task": "toy",
        "joint_names": JOINTS,
        "joints": {
            "names": JOINTS,
            "default_pos": DEFAULT,
            # Behind the gear: 15 / 2 * 2 ** 2.
            "stiffness": [30.0, 20.0],
            "damping": [1.0, 1.0],
            "effort_scale": [1.0, 1.0],
            "limits": {
                "position": [[-1.8, 1.3], [-1.8, None]],
                "effort": [18.0, 18.0],
                "velocity": [None, 20.0],
            },
        },
        "observations": observations,
        "actions": [action],
        "action_chain": [
            {"kind": "clip", "low": -3.0, "high": 3.0},
            {"kind": "low_pass", "alpha": 0.8, "initial": None},
        ],
        "actuators": [{"joints": JOINTS, "actuators": JOINTS, **servo, **gears}],
        "commands": {"twist": {"size": 2, "kind": "toy", "low": [-1.0, -0.5], "high": [2.0, 1.0]}},
        "contacts": {},
        "obs": {"output": "obs", "measurements": measurements, "states": []},
        "scores": None,
        "policy": {"states": [], "num_actions": 2},
        "rewards": {},
        "terminations": {},
        "metrics": [],
        "scale_rewards_by_dt": False,
        "decimation": 4,
        "step_dt": 0.02,
        "episode_steps": 0,
    }
