"""Small models that the agreement with MuJoCo's C engine is measured on."""

CARTPOLE = """
<mujoco model="cartpole">
  <option timestep="0.01"/>
  <worldbody>
    <body name="cart" pos="0 0 1">
      <joint name="slider" type="slide" axis="1 0 0" damping="0.1"/>
      <geom name="cart" type="box" size="0.2 0.15 0.1" mass="1" contype="0" conaffinity="0"/>
      <body name="pole">
        <joint name="hinge" axis="0 1 0" damping="0.001"/>
        <geom name="pole" type="capsule" fromto="0 0 0 0 0 1" size="0.045" mass="0.1" contype="0" conaffinity="0"/>
        <site name="tip" pos="0 0 1"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="push" joint="slider" gear="10" ctrllimited="true" ctrlrange="-1 1"/>
  </actuator>
  <sensor>
    <jointpos name="slider_pos" joint="slider"/>
    <jointvel name="hinge_vel" joint="hinge"/>
    <framelinvel name="tip_vel" objtype="site" objname="tip"/>
    <actuatorfrc name="push_force" actuator="push"/>
  </sensor>
</mujoco>
"""

DOUBLE_PENDULUM = """
<mujoco model="double_pendulum">
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body name="upper" pos="0 0 2">
      <joint name="shoulder" axis="0 1 0" damping="0.05"/>
      <geom name="upper" type="capsule" fromto="0 0 0 0 0 -0.5" size="0.03" mass="1"/>
      <body name="lower" pos="0 0 -0.5">
        <joint name="elbow" axis="0 1 0" damping="0.05" armature="0.01"/>
        <geom name="lower" type="capsule" fromto="0 0 0 0 0 -0.5" size="0.03" mass="1"/>
        <site name="hand" pos="0 0 -0.5"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="servo" joint="elbow" kp="20" kv="1"/>
  </actuator>
  <sensor>
    <accelerometer name="hand_acc" site="hand"/>
    <gyro name="hand_gyro" site="hand"/>
    <framepos name="hand_pos" objtype="site" objname="hand"/>
    <actuatorpos name="servo_pos" actuator="servo"/>
    <actuatorvel name="servo_vel" actuator="servo"/>
  </sensor>
</mujoco>
"""

SPINNING_BODY = """
<mujoco model="spinning_body">
  <option timestep="0.002"/>
  <worldbody>
    <body name="rock" pos="0 0 5">
      <freejoint name="root"/>
      <geom name="rock" type="ellipsoid" size="0.1 0.2 0.3" mass="2"/>
      <site name="center"/>
    </body>
  </worldbody>
  <sensor>
    <gyro name="spin" site="center"/>
    <framequat name="pose" objtype="body" objname="rock"/>
    <subtreeangmom name="momentum" body="rock"/>
  </sensor>
</mujoco>
"""


def _leg(name: str, x: float, y: float) -> str:
    return f"""
      <body name="{name}_thigh" pos="{x} {y} 0">
        <joint name="{name}_hip" axis="0 1 0" range="-1 1"/>
        <geom name="{name}_thigh" type="capsule" fromto="0 0 0 0 0 -0.2" size="0.025" mass="0.5"/>
        <body name="{name}_shin" pos="0 0 -0.2">
          <joint name="{name}_knee" axis="0 1 0" range="-2 0.2"/>
          <geom name="{name}_shin" type="capsule" fromto="0 0 0 0 0 -0.18" size="0.015" mass="0.2"/>
          <geom name="{name}_foot" type="sphere" pos="0 0 -0.2" size="0.03" mass="0.1" friction="0.8" condim="3"/>
          <site name="{name}_foot" pos="0 0 -0.2" size="0.04"/>
        </body>
      </body>"""


LEGS = ("front_left", "front_right", "rear_left", "rear_right")
_PLACES = ((0.2, 0.12), (0.2, -0.12), (-0.2, 0.12), (-0.2, -0.12))

QUADRUPED = f"""
<mujoco model="quadruped">
  <compiler angle="radian"/>
  <option timestep="0.005" integrator="implicitfast"/>
  <default>
    <joint damping="0.5" armature="0.01" frictionloss="0.1"/>
    <position kp="30" kv="1" ctrllimited="true" ctrlrange="-1 1" forcelimited="true" forcerange="-15 15"/>
  </default>
  <worldbody>
    <geom name="floor" type="plane" size="10 10 0.1" friction="1"/>
    <body name="torso" pos="0 0 0.45">
      <freejoint name="root"/>
      <geom name="torso" type="box" size="0.25 0.1 0.05" mass="4"/>
      <site name="imu"/>{"".join(_leg(leg, x, y) for leg, (x, y) in zip(LEGS, _PLACES, strict=True))}
    </body>
  </worldbody>
  <actuator>
    {"".join(f'<position name="{leg}_{joint}" joint="{leg}_{joint}"/>' for leg in LEGS for joint in ("hip", "knee"))}
  </actuator>
  <sensor>
    <gyro name="gyro" site="imu"/>
    <velocimeter name="velocity" site="imu"/>
    <accelerometer name="acceleration" site="imu"/>
    <framezaxis name="up" objtype="site" objname="imu"/>
    <subtreeangmom name="momentum" body="torso"/>
    <jointpos name="knee_pos" joint="front_left_knee"/>
    <actuatorpos name="servo_pos" actuator="front_left_hip"/>
    <actuatorvel name="servo_vel" actuator="front_left_hip"/>
    <jointactuatorfrc name="knee_force" joint="front_left_knee"/>
    <touch name="touch" site="front_left_foot"/>
    {"".join(f'<contact name="{leg}_contact" geom1="{leg}_foot" geom2="floor" data="found force"/>' for leg in LEGS)}
  </sensor>
  <keyframe>
    <key name="stand" qpos="0 0 0.41 1 0 0 0 0.3 -0.6 0.3 -0.6 0.3 -0.6 0.3 -0.6"
      ctrl="0.3 -0.6 0.3 -0.6 0.3 -0.6 0.3 -0.6"/>
  </keyframe>
</mujoco>
"""
