"""Worlds that differ in their model, beside the C engine with each world's model."""

import copy
from collections.abc import Sequence

import mujoco
import numpy as np
import torch

from ksim_rl.envs.driver import EnvDriver
from ksim_rl.envs.term import EventTerm
from ksim_rl.physics import SimCfg, World, load_model, prepare_spec

RUNNER = """
<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.002" integrator="implicitfast" cone="elliptic"/>
  <default><geom friction="0.8 0.01 0.001" condim="6"/></default>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 0.01" friction="0.1 0.001 0.0001"/>
    <body name="trunk" pos="0 0 0.3">
      <freejoint name="root"/>
      <inertial pos="0.02 0 0.01" mass="3" diaginertia="0.02 0.03 0.04"/>
      <geom name="belly" type="box" size="0.2 0.1 0.05"/>
      <body name="left_leg" pos="0.1 0.15 0">
        <joint name="left_hip" axis="0 1 0" range="-0.3 0.3" limited="true" damping="0.2" armature="0.01"
          frictionloss="0.3" stiffness="5" springref="0.2"/>
        <geom name="left_shank" type="capsule" fromto="0 0 0 0 0 -0.25" size="0.02" mass="0.3" contype="0"
          conaffinity="0"/>
        <geom name="left_foot" type="sphere" pos="0 0 -0.27" size="0.03" mass="0.1"/>
      </body>
      <body name="right_leg" pos="-0.1 -0.15 0">
        <joint name="right_hip" axis="0 1 0"/>
        <geom name="right_shank" type="capsule" fromto="0 0 0 0 0 -0.25" size="0.02" mass="0.3" contype="0"
          conaffinity="0"/>
        <geom name="right_foot" type="ellipsoid" pos="0 0 -0.27" size="0.06 0.03 0.03" mass="0.1"/>
      </body>
      <body name="tail" pos="-0.25 0 0">
        <joint name="tail" type="slide" axis="1 0 0.2"/>
        <geom name="tail" type="capsule" fromto="0 0 0 -0.1 0 0" size="0.02" mass="0.2" contype="0" conaffinity="0"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="left_hip" joint="left_hip" kp="20" kv="0.5" forcelimited="true" forcerange="-4 5"/>
    <motor name="right_hip" joint="right_hip" gear="2" forcelimited="true" forcerange="-0.2 0.2"/>
    <velocity name="tail" joint="tail" kv="3"/>
  </actuator>
  <keyframe><key name="stand" qpos="0 0 0.3 1 0 0 0 0.1 -0.1 0.05"/></keyframe>
</mujoco>
"""
"""A sliding trunk: a sprung, limited leg with a servo; a free leg with a motor; a tail with a velocity servo."""

RICH = (
    RUNNER.replace(
        "<worldbody>",
        """<asset><material name="paint" rgba="0.8 0.2 0.1 1"/></asset>
        <worldbody>
          <light name="lamp" pos="0.5 0 2" dir="0.1 0 -1"/>
          <camera name="onlooker" pos="0 -2 1" mode="targetbody" target="trunk"/>""",
    )
    .replace(
        '<geom name="belly" type="box"',
        """<site name="nozzle" pos="0.1 0.02 0.05" euler="0.1 0.2 0"/>
        <camera name="eye" pos="0.2 0 0.1" euler="0.3 0 0" fovy="60"/>
        <camera name="lens" pos="-0.2 0 0.1" sensorsize="0.004 0.003" focal="0.003 0.003" resolution="8 8"/>
        <light name="torch" pos="0.1 0.1 0" dir="1 0 -0.5" diffuse="0.5 0.5 0.5"/>
        <geom name="belly" type="box" material="paint\"""",
    )
    .replace(
        '<body name="tail" pos="-0.25 0 0">', '<body name="tail" pos="-0.25 0 0" euler="0.1 0 0.2">'
    )
    .replace(
        "<actuator>",
        """<contact><pair name="sole" geom1="floor" geom2="right_foot" condim="6" friction="0.5 0.5 0.01 0.001 0.001"/>
        </contact>
        <tendon>
          <fixed name="strap" stiffness="20" springlength="0.1" damping="0.5" frictionloss="0.1" armature="0.01">
            <joint joint="left_hip" coef="1"/><joint joint="right_hip" coef="-0.7"/>
          </fixed>
        </tendon>
        <actuator><general name="thruster" site="nozzle" gear="3 0 2 0 0.5 0"/>""",
    )
)
"""The same with a tendon between the hips, a contact pair, a thruster on a site, cameras, lights and paint."""

START_QPOS = (0, 0, 0.29, 1, 0.02, 0.03, 0.1, 0.05, 0.1, 0.02)
START_QVEL = (0.8, 0.3, -0.3, 0.2, 0.4, 1.0, 0.5, -1.0, 0.3)
CTRL = (2.0, 0.25, 0.5, 0.4)
INERTIAL = ("body_mass", "body_inertia", "body_ipos", "body_iquat")
GEOMS = ("geom_friction", "geom_size", "geom_pos", "geom_quat")
JOINTS = (
    "dof_damping",
    "dof_armature",
    "dof_frictionloss",
    "jnt_stiffness",
    "jnt_range",
    "jnt_actfrcrange",
    "qpos0",
)
ACTUATORS = ("actuator_gainprm", "actuator_biasprm", "actuator_forcerange")
# A graph of as many substeps is recorded once, and replayed.
RECORDED = 10
FIELDS = (*GEOMS, *INERTIAL, *JOINTS, *ACTUATORS, "gravity")
RICH_FIELDS = (
    *("body_pos", "body_quat", "site_pos", "site_quat", "pair_friction"),
    *("tendon_stiffness", "tendon_damping", "tendon_frictionloss", "tendon_armature"),
    *("cam_pos", "cam_quat", "cam_fovy", "cam_intrinsic", "light_pos", "light_dir"),
    *("light_ambient", "light_diffuse", "light_specular", "geom_rgba"),
    *("mat_rgba", "mat_emission", "mat_specular", "mat_shininess"),
)


class Runners:
    """Worlds of RUNNER or RICH whose fields an event may change; `restart` gives them back the model's own."""

    def __init__(self, num_envs: int, device: str = "cpu", *, rich: bool = False) -> None:
        spec, fields = (
            mujoco.MjSpec.from_string(RICH if rich else RUNNER),
            RICH_FIELDS if rich else FIELDS,
        )
        prepare_spec(spec, fields)
        self.world = World(
            load_model(spec),
            num_envs=num_envs,
            device=device,
            per_world_fields=fields,
            sim=SimCfg(njmax=60, nconmax=20),
        )
        self.driver = EnvDriver(self.world, step_dt=0.02)
        self.view = self.driver.view
        self.everybody_E = torch.ones(num_envs, dtype=torch.bool, device=device)
        self.own = self.world.state_dict()

    def restart(self) -> None:
        self.world.load_state_dict(self.own)
        self.view.default_joint_pos_EL.copy_(
            torch.tensor((0.1, -0.1, 0.05)).expand(self.world.num_envs, 3)
        )
        for counter in (self.view.seed, self.view.step_count, self.view.reset_count_E):
            counter.zero_()

    def fire(
        self, event: EventTerm, mask_E: torch.Tensor | None = None, scope: str = "events/x"
    ) -> None:
        """Run an event for some rows (all by default), and recompute what follows from it, as the env does."""
        mask_E = self.everybody_E if mask_E is None else mask_E
        with self.driver.scope(scope, self.view.reset_count_E):
            event(self.view, mask_E)
        self.world.set_const(event.per_world_fields, mask_E)

    def place(self) -> None:
        """Start all worlds alike."""
        self.world.qpos_EL.copy_(torch.tensor(START_QPOS).expand_as(self.world.qpos_EL))
        self.world.qpos_EL[:, 3:7] /= self.world.qpos_EL[:, 3:7].norm(dim=-1, keepdim=True)
        self.world.qvel_EL.copy_(torch.tensor(START_QVEL).expand_as(self.world.qvel_EL))
        self.world.ctrl_EL.copy_(
            torch.tensor(CTRL[-self.world.mj_model.nu :]).expand_as(self.world.ctrl_EL)
        )

    def run(self, substeps: int) -> np.ndarray:
        """Start all worlds alike and return where they end, qpos and qvel, [E, nq + nv]."""
        self.place()
        assert substeps % RECORDED == 0
        for _ in range(substeps // RECORDED):
            self.world.step(RECORDED)
        return torch.cat((self.world.qpos_EL, self.world.qvel_EL), dim=-1).cpu().numpy()

    def c_model(self, row: int, fields: Sequence[str]) -> mujoco.MjModel:
        """The C engine's model with the fields of one world, and all that follows from them."""
        model = copy.copy(self.world.mj_model)
        for field in fields:
            target = model.opt.gravity if field == "gravity" else getattr(model, field)
            target[:] = self.world.field(field)[row].cpu().numpy().reshape(target.shape)
        mujoco.mj_setConst(model, mujoco.MjData(model))
        return model

    def c_placed(self, model: mujoco.MjModel) -> mujoco.MjData:
        """The C engine's data at the start, with cameras and lights."""
        data = mujoco.MjData(model)
        data.qpos[:] = START_QPOS
        data.qpos[3:7] /= np.linalg.norm(data.qpos[3:7])
        for place in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_camlight):
            place(model, data)
        return data

    def c_run(self, model: mujoco.MjModel, substeps: int) -> np.ndarray:
        """The C engine's answer to `run`, [nq + nv]."""
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:], data.ctrl[:] = START_QPOS, START_QVEL, CTRL[-model.nu :]
        data.qpos[3:7] /= np.linalg.norm(data.qpos[3:7])
        mujoco.mj_step(model, data, substeps)
        return np.concatenate((data.qpos, data.qvel))
