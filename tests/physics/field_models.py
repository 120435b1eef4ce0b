"""Models in which every field that may differ between worlds has an effect, and how a test changes each field."""

import mujoco
import numpy as np

from ksim_rl.physics import prepare_spec

# All that one kernel computes: joints, contacts, a tie of joints, affine actuators.
PLAIN = """
<mujoco>
  <option timestep="0.004" integrator="implicitfast" cone="elliptic" impratio="2"/>
  <default><geom friction="0.9 0.02 0.01"/></default>
  <worldbody>
    <light name="sun" pos="0 0 3" dir="0 .1 -1"/>
    <camera name="outside" mode="trackcom" pos="0 -2 1"/>
    <geom name="floor" type="plane" size="5 5 1" solref=".03 1" solmix="2"/>
    <body name="table" pos="0 0 .2" quat="1 0 .02 0">
      <geom name="top" type="box" size=".4 .4 .05" condim="4"/><site name="mark" pos=".1 .2 .05" quat="1 0 .1 0"/>
    </body>
    <body name="hand" mocap="true" pos="2 0 1"><geom name="palm" size=".1" contype="0" conaffinity="0"/></body>
    <body name="ball" pos="0 0 .345">
      <freejoint/><geom name="skin" size=".1" mass="1" condim="6" margin=".02" gap=".005" pos=".01 0 0"/>
      <site name="eye" pos=".1 0 0"/>
    </body>
    <body name="box" pos="1 0 .098">
      <freejoint/><geom name="crate" type="box" size=".1 .12 .1" mass="2" condim="3" pos="0 .01 0"/>
      <camera name="inside" pos=".1 .2 0" mode="track"/><light pos=".1 0 .2" mode="track"/>
      <light pos=".1 0 .2" mode="trackcom"/>
    </body>
    <body name="glider" pos="1 1 .112"><freejoint/><geom name="hull" size=".1" mass="1" margin=".01"/></body>
    <body name="arm" pos="-1 0 .5">
      <joint name="swing" axis="0 1 0" pos="0 .05 0" range="-.5 .5" limited="true" margin=".1" stiffness="3"
        springref=".2" damping=".2" frictionloss="2" armature=".02"/>
      <geom name="upper" type="capsule" size=".03" fromto="0 0 0 .3 0 0" mass="1"/>
      <body name="fore" pos=".3 0 0">
        <joint name="knee" type="ball" range="0 .3" limited="true" margin=".05" stiffness="2" damping=".1"
          frictionloss=".02"/>
        <geom name="lower" type="capsule" size=".03" fromto="0 0 0 .2 0 -.1" mass=".5"/>
        <body name="tip" pos=".2 0 -.1">
          <joint name="rail" type="slide" axis="1 0 .3" range="-.05 .05" limited="true" damping="1" stiffness="20"
            actuatorfrclimited="true" actuatorfrcrange="-.5 .5"/>
          <geom name="bulb" size=".04" mass=".2" pos="0 .02 0"/>
        </body>
      </body>
    </body>
    <body name="puck" pos="-1 1 .09">
      <joint name="px" type="slide" axis="1 0 0" armature=".1"/><joint name="pz" type="slide" axis="0 0 1"/>
      <geom name="disc" size=".1" mass="1"/>
    </body>
    <body pos="-1 2 .113"><joint type="slide" axis="0 0 1"/><geom name="plate" size=".1" mass="1"/></body>
    <body name="pole" pos="-1 -1 1">
      <joint name="hinge" axis="1 0 0" damping=".1"/><joint name="twin" axis="0 0 1"/>
      <geom name="rod" type="capsule" size=".03 .2" mass="1" pos="0 0 -.2"/>
    </body>
  </worldbody>
  <contact>
    <pair geom1="floor" geom2="disc" condim="3" friction=".5 .4 .01 .01 .01" margin=".01" solreffriction=".03 1.1"/>
    <pair geom1="floor" geom2="plate" condim="3" margin=".008" gap=".002"/>
  </contact>
  <equality><joint joint1="hinge" joint2="twin" polycoef=".01 .5 .1 0 0"/></equality>
  <actuator>
    <position name="servo" joint="swing" kp="5" kv=".3" gear="1.5" ctrlrange="-.2 .2"/>
    <general name="filtered" joint="rail" dyntype="filterexact" dynprm=".05" gainprm="3" biastype="affine"
      biasprm="0 -2 -.1" actlimited="true" actrange="-.25 .25"/>
    <motor name="pusher" joint="px" gear="2" armature=".05" damping=".2"/>
    <motor name="weak" joint="hinge" forcerange="-.1 .1"/>
  </actuator>
  <sensor><framepos objtype="site" objname="eye"/><jointpos joint="swing"/></sensor>
</mujoco>
"""
# Tendons, ties of bodies, and actuators of all kinds.
RICH = """
<mujoco>
  <option timestep="0.004" integrator="implicitfast" cone="elliptic" jacobian="sparse"/>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <site name="anchor" pos="0 0 1.2"/><site name="side" pos=".15 0 1.3"/>
    <geom name="peg" type="cylinder" size=".05 .2" pos=".15 0 1.1" euler="90 0 0"/>
    <body name="arm" pos="0 0 1">
      <joint name="swing" axis="0 1 0" range="-20 20" damping=".1"/>
      <geom name="upper" type="capsule" size=".03" fromto="0 0 0 .3 0 0" mass="1"/>
      <site name="wrist" pos=".3 0 .05" quat="1 .1 .2 0"/>
      <body name="fore" pos=".3 0 0">
        <joint name="knee" axis="0 1 0" range="-20 20" damping=".1"/>
        <geom name="lower" type="capsule" size=".03" fromto="0 0 0 .2 0 0" mass=".5"/>
        <body name="tool" pos=".25 0 0"><geom name="blade" size=".02" mass=".05"/><site name="tip"/></body>
      </body>
    </body>
    <body name="slider" pos="0 .5 1">
      <joint name="rail" type="slide" axis="1 0 0" damping=".5"/>
      <geom name="block" type="box" size=".05 .05 .05" mass=".4"/>
      <site name="crank" pos=".05 0 0"/>
    </body>
    <body name="wheel" pos="-.2 .5 1">
      <joint name="axle" axis="0 1 0" damping=".1" stiffness="20" springyield=".1"/>
      <geom name="rim" type="cylinder" size=".1 .02" mass="1" euler="90 0 0"/><site name="pin" pos="0 0 .1"/>
    </body>
    <body name="load" pos=".55 .02 1">
      <freejoint/><geom name="ball" size=".05" mass=".3"/>
      <body name="grip" pos="0 0 .1"><geom name="hook" size=".02" mass=".02"/></body>
    </body>
    <body name="twin" pos="0 -.5 1">
      <joint name="bj" type="ball" damping=".05"/>
      <geom name="lump" type="box" size=".1 .05 .05" mass=".5" pos=".1 0 0"/>
    </body>
  </worldbody>
  <tendon>
    <fixed name="strap" limited="true" range="-.01 .01" margin=".005" stiffness="2" damping=".3" armature=".1">
      <joint joint="swing" coef="1"/><joint joint="knee" coef="-.8"/>
    </fixed>
    <spatial name="cable" limited="true" range="0 .3" stiffness="5" damping=".2" springlength=".1" springyield=".05">
      <site site="anchor"/><geom geom="peg" sidesite="side"/><site site="wrist"/>
    </spatial>
    <spatial name="rope" actuatorfrclimited="true" actuatorfrcrange="-.2 .2">
      <site site="tip"/><site site="crank"/></spatial>
    <fixed name="link" frictionloss="3"><joint joint="rail" coef="1"/><joint joint="axle" coef=".1"/></fixed>
  </tendon>
  <equality>
    <connect body1="tool" body2="grip" anchor="0 0 0"/>
    <weld body1="twin" relpose="0 -.5 1 1 .1 0 0" torquescale=".5"/>
    <tendon tendon1="strap" polycoef=".01 0 0 0 0" active="false"/>
  </equality>
  <actuator>
    <muscle name="muscle" tendon="cable" lengthrange=".1 .5"/>
    <position name="pull" tendon="rope" kp="4"/>
    <motor name="thrust" site="tip" gear="0 0 1 0 .2 0"/>
    <general name="turn" joint="bj" gear="1 .5 0" gainprm="2"/>
    <motor name="crankshaft" cranksite="pin" slidersite="crank" cranklength=".3"/>
    <motor name="late" joint="swing" delay=".01" nsample="8"/>
    <damper name="damp" joint="knee" kv=".4" ctrlrange="0 1"/>
  </actuator>
  <sensor>
    <tendonpos tendon="cable"/><jointpos joint="swing" delay=".006" nsample="8"/>
    <jointvel joint="knee" interval=".01" nsample="4"/>
  </sensor>
</mujoco>
"""
# Boxes and, in one body, an ellipsoid that a fluid moves.
FLUID = """
<mujoco>
  <option timestep="0.004" {density} viscosity=".3" wind="1 .2 0" integrator="implicitfast"/>
  <worldbody>
    <body name="fish" pos="0 0 1">
      <freejoint/><geom name="hull" type="ellipsoid" size=".1 .2 .15" mass="1" fluidshape="ellipsoid"/>
      <body name="fin" pos="0 .3 0"><joint axis="1 0 0"/>
        <geom name="blade" type="box" size=".02 .1 .08" mass=".2" fluidshape="ellipsoid" fluidcoef=".4 .3 1.2 .9 1.1"/>
      </body>
    </body>
    <body name="stone" pos="2 0 1"><freejoint/><geom name="rock" type="box" size=".1 .1 .2" mass="3"/></body>
  </worldbody>
</mujoco>
"""
# Surfaces that move and stick, if their fields say so.
STICKY = """
<mujoco>
  <option timestep="0.004" cone="elliptic"/>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 1"/>
    <body name="ball" pos="0 0 .099"><freejoint/><geom name="skin" size=".1" mass="1"/></body>
    <body name="moth" pos="0 1 .104"><freejoint/><geom size=".1" mass="1"/></body>
    <body name="disc" pos="1 0 .099"><freejoint/><geom name="plate" size=".1" mass="1"/></body>
  </worldbody>
  <contact><pair geom1="floor" geom2="plate" condim="3"/></contact>
</mujoco>
"""
MODELS = {
    "plain": PLAIN,
    "rich": RICH,
    "fluid": FLUID.format(density='density="50"'),
    "viscous": FLUID.format(density=""),
    "sticky": STICKY,
}
# The fields that have an effect in each; some have one in several.
_FIELDS = {
    "plain": (
        "qpos0 qpos_spring body_pos body_quat body_ipos body_iquat body_mass body_inertia body_invweight0 "
        "body_gravcomp body_subtreemass jnt_solref jnt_solimp jnt_pos jnt_axis jnt_stiffness jnt_stiffnesspoly "
        "jnt_range jnt_actfrcrange jnt_margin dof_solref dof_solimp dof_frictionloss dof_armature dof_damping "
        "dof_dampingpoly "
        "dof_invweight0 geom_solmix geom_solref geom_solimp geom_size geom_rbound geom_pos geom_quat geom_friction "
        "geom_margin geom_gap site_pos site_quat cam_pos cam_quat cam_poscom0 cam_pos0 cam_mat0 light_pos light_dir "
        "light_poscom0 light_pos0 light_dir0 pair_solref pair_solreffriction pair_solimp pair_margin pair_gap "
        "pair_friction eq_solref eq_solimp eq_data actuator_dynprm actuator_gainprm actuator_biasprm actuator_actrange "
        "actuator_damping actuator_dampingpoly actuator_armature actuator_forcerange actuator_ctrlrange actuator_gear"
    ),
    "rich": (
        "qpos0 body_pos body_quat body_ipos body_iquat body_mass body_inertia jnt_pos jnt_axis jnt_springyield "
        "dof_armature geom_size geom_pos geom_quat site_pos site_quat eq_solref eq_solimp eq_data tendon_solref_lim "
        "tendon_solimp_lim tendon_solref_fri tendon_solimp_fri tendon_range tendon_actfrcrange tendon_margin "
        "tendon_stiffness tendon_stiffnesspoly tendon_damping tendon_dampingpoly tendon_armature tendon_frictionloss "
        "tendon_lengthspring tendon_springyield tendon_invweight0 actuator_cranklength actuator_gainprm "
        "actuator_biasprm actuator_delay actuator_damping actuator_armature actuator_gear actuator_acc0 "
        "actuator_lengthrange sensor_delay sensor_interval"
    ),
    "fluid": "body_mass body_inertia body_ipos geom_pos geom_quat body_gravcomp",
    "viscous": "geom_size",
    "sticky": "geom_surfacevel geom_adhesion pair_adhesion body_gravcomp geom_margin geom_gap",
}
FIELDS = {model: tuple(names.split()) for model, names in _FIELDS.items()}
# Pictures alone show them.
_OF_PICTURES = (
    "geom_matid geom_rgba cam_fovy cam_intrinsic light_type light_castshadow light_active light_attenuation "
    "light_cutoff light_exponent light_ambient light_diffuse light_specular mat_texid mat_texuniform mat_texrepeat "
    "mat_emission mat_specular mat_shininess mat_rgba"
)
OF_PICTURES = _OF_PICTURES.split()
# Which mesh or field of heights a geom is goes with its bounds (tests/scene/terrains); no force depends on the other.
OF_OTHER_TESTS = ("geom_dataid", "geom_aabb", "tendon_length0")

_MOVES = "pos ipos quat iquat axis dir dir0 qpos0 qpos_spring pos0 poscom0 mat0 data"
_MOVED = _MOVES.split()
_ADDED = {
    "jnt_stiffnesspoly": 40.0,
    "tendon_stiffnesspoly": 40.0,
    "geom_gap": 0.01,
    "pair_gap": 0.01,
    "geom_margin": 0.01,
}
_ADDED |= {"actuator_delay": 0.016, "sensor_delay": 0.016}


def compiled(name: str, fields: tuple[str, ...] = ()) -> mujoco.MjModel:
    """Return one of the models, prepared for its fields and `fields`."""
    spec = mujoco.MjSpec.from_string(MODELS[name])
    prepare_spec(spec, FIELDS[name] + fields)
    return spec.compile()


def changed(mj_model: mujoco.MjModel, field: str) -> np.ndarray:
    """Return other values of a field than the model's, in its layout."""
    rng = np.random.default_rng(0)
    values = np.array(getattr(mj_model, field), dtype=float)
    if field.rpartition("_")[2] in _MOVED or field in _MOVED:
        values += 0.02 * rng.normal(size=values.shape) * ((values != 0.0) | (field != "eq_data"))
        if field == "body_ipos":
            values[0] = 0.0  # of the world, which has no inertia
        if field in ("qpos0", "qpos_spring"):
            mujoco.mj_normalizeQuat(mj_model, values)
        if field.endswith(("quat", "axis", "_dir", "dir0")):
            values /= np.linalg.norm(values, axis=-1, keepdims=True)
    elif "solimp" in field:
        values *= rng.uniform(0.8, 0.95, size=values.shape)
    elif field.endswith(("range", "rbound")):
        values *= 0.6
    elif field in _ADDED or not values.any():
        values += _ADDED.get(field, 0.1) * rng.uniform(0.5, 1.0, size=values.shape)
    elif field == "tendon_lengthspring":
        values *= 1.3
    else:
        values *= rng.uniform(1.2, 1.45, size=values.shape)
    if field == "actuator_armature":
        # C has none of tendons that bend around geoms.
        values[mj_model.actuator_trntype == mujoco.mjtTrn.mjTRN_TENDON] = 0.0
    return values
