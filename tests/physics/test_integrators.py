"""MuJoCo Warp's integrators as `physics.integrators` and `physics.runge_kutta` launch them, beside the C engine."""

import mujoco
import pytest

from tests.physics.beside_c import KERNELS, THEIRS, check, started, step_and_check

IMPLICIT = ("implicit", "implicitfast")
DAMPED = """
<mujoco>
  <option timestep="0.01" integrator="{integrator}"><flag {flags}/></option>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <body><joint name="a" axis="0 1 0" damping="0.5" stiffness="2"/>
      <geom type="capsule" size="0.03" fromto="0 0 0 0 0 -0.3" mass="0.3"/>
      <body pos="0 0 -0.3"><joint name="b" axis="1 0 0" damping="0.3"/>
        <geom size="0.05" pos="0.1 0 0" mass="0.2"/></body>
    </body>
    <body pos="1 0 1"><freejoint/><geom type="box" size="0.1 0.06 0.02" mass="1"/></body>
  </worldbody>
  <actuator><position joint="a" kp="20" kv="2"/><motor joint="b" gear="2"/></actuator>
</mujoco>
"""
DISABLED = (
    'actuation="disable"',
    'damper="disable"',
    'actuation="disable" damper="disable"',
    'actuation="disable" spring="disable" damper="disable"',
)
HINGE = '<body><joint name="h" axis="0 1 0" damping="0.1"/><geom size="0.05" pos="0 0 -0.3" mass="0.5"/></body>'
SLOWED = '<general joint="h" gaintype="affine" gainprm="1 0 -3" ctrllimited="true" ctrlrange="-0.05 0.05"/>'

# Inertia matrices of such bodies are diagonal, and what acts on them couples their degrees of freedom.
SIMPLE_BODY = """
<mujoco>
  <option timestep="0.01" integrator="{integrator}"/>
  <worldbody>
    <body>{joints}<geom type="box" size="0.1 0.05 0.03" mass="1"/><site name="grip" pos="0.1 0.05 0.02"/></body>
    <site name="post" pos="0.3 0.2 0.5"/>
  </worldbody>
  {acts}
</mujoco>
"""
JOINTS_OF_SIMPLE_BODIES = {
    "free": '<freejoint name="x"/>',
    "slides": '<joint name="x" type="slide" axis="1 0 0"/><joint type="slide" axis="0 1 0"/>',
}
ACTS_ON_BODIES = {
    "tendon": '<tendon><spatial damping="10"><site site="grip"/><site site="post"/></spatial></tendon>',
    "site": (
        '<actuator><position site="grip" refsite="post" kp="6" kv="3" gear="1 0.5 0.7 0.3 0.4 0.2"/></actuator>'
    ),
    "joint": '<actuator><position joint="x" kp="6" kv="3" gear="1 0.5 0.7 0.3 0.4 0.2"/></actuator>',
    "gain": (
        '<actuator><general joint="x" gaintype="affine" gainprm="1 0.3 -3" gear="1 0.5 0.7 0.3 0.4 0.2" '
        'ctrlrange="-0.5 0.5"/></actuator>'
    ),
}
WITH_ACTUATORS = (
    '<mujoco><option timestep="0.01" integrator="{integrator}"/><worldbody>'
    + HINGE
    + "</worldbody><actuator>{actuators}</actuator></mujoco>"
)


@pytest.mark.parametrize("flags", DISABLED)
@pytest.mark.parametrize("integrator", IMPLICIT)
def test_what_is_disabled_leaves_the_other_derivatives(integrator: str, flags: str) -> None:
    step_and_check(DAMPED.format(integrator=integrator, flags=flags), KERNELS["our solver"])


@pytest.mark.parametrize("flags", DISABLED)
def test_so_it_does_without_our_solver(flags: str) -> None:
    step_and_check(DAMPED.format(integrator="implicitfast", flags=flags), KERNELS["theirs"])


@pytest.mark.parametrize("integrator", IMPLICIT)
def test_a_gain_that_depends_on_velocity_has_its_control_within_its_range(integrator: str) -> None:
    xml = WITH_ACTUATORS.format(integrator=integrator, actuators=SLOWED)
    step_and_check(xml, KERNELS["our solver"], substeps=6)


def test_such_a_gain_beside_a_motor_of_several_controls_is_refused() -> None:
    motor = '<dcmotor joint="h" motorconst="0.1" resistance="1" input="pos vel"/>'
    xml = WITH_ACTUATORS.format(integrator="implicitfast", actuators=motor + SLOWED)
    with pytest.raises(
        ValueError, match="DC motor has several controls.*choose integrator='euler'"
    ):
        started(xml, KERNELS["our solver"])
    step_and_check(xml.replace("implicitfast", "Euler"), KERNELS["our solver"])


@pytest.mark.parametrize("kernels", ("our solver", THEIRS))
@pytest.mark.parametrize("integrator", IMPLICIT)
@pytest.mark.parametrize("acts", ACTS_ON_BODIES)
@pytest.mark.parametrize("joints", JOINTS_OF_SIMPLE_BODIES)
def test_what_acts_on_a_body_as_a_whole_is_implicit(
    joints: str, acts: str, integrator: str, kernels: str
) -> None:
    xml = SIMPLE_BODY.format(
        integrator=integrator, joints=JOINTS_OF_SIMPLE_BODIES[joints], acts=ACTS_ON_BODIES[acts]
    )
    step_and_check(xml, KERNELS[kernels], speed=3.0)


@pytest.mark.parametrize(
    "flag", ("", pytest.param('<flag sleep="enable"/>', marks=pytest.mark.full))
)
@pytest.mark.parametrize("kind", ("filter", "filterexact"))
def test_runge_kutta_leaves_the_rates_of_its_last_stage(kind: str, flag: str) -> None:
    xml = (
        f'<mujoco><option timestep="0.01" integrator="RK4">{flag}</option><worldbody>{HINGE}</worldbody><actuator>'
        f'<general joint="h" dyntype="{kind}" dynprm="0.05" gainprm="2"/></actuator></mujoco>'
    )
    step_and_check(xml, KERNELS["ours"], names=("qpos", "qvel", "act", "act_dot"))


def test_runge_kutta_leaves_the_forces_on_bodies_of_its_start() -> None:
    world, mj_data, in_c = started(
        f'<mujoco><option timestep="0.01" integrator="RK4"/><worldbody>{HINGE}</worldbody></mujoco>',
        KERNELS["ours"],
        speed=8.0,
    )
    names = ("cacc", "cfrc_int")
    for name in names:
        world.view(name)
    world.step(1)
    mujoco.mj_forward(in_c, mj_data)
    mujoco.mj_rnePostConstraint(in_c, mj_data)
    check(world, mj_data, names)


WRAPPED = (
    '<mujoco><option timestep="0.01" integrator="RK4">{flag}</option><worldbody>'
    + HINGE
    + '</worldbody><tendon><fixed name="t" damping="0.2"><joint joint="h" coef="0.3"/></fixed></tendon>'
    "<actuator>{actuator}</actuator></mujoco>"
)
READ_BY_STAGES = {
    "tendon": '<general tendon="t" dyntype="filter" dynprm="0.05" gainprm="2"/>',
    "velocity": '<velocity joint="h" kv="0.3"/>',
}


@pytest.mark.parametrize("kernels", ("our solver", THEIRS))
@pytest.mark.parametrize(
    "flag",
    ("", '<flag sleep="enable"/>', '<flag sleep="enable" spring="disable" damper="disable"/>'),
)
@pytest.mark.parametrize("actuator", READ_BY_STAGES)
def test_runge_kutta_leaves_the_readings_of_its_last_stage(
    actuator: str, flag: str, kernels: str
) -> None:
    xml = WRAPPED.format(flag=flag, actuator=READ_BY_STAGES[actuator])
    names = (
        "qpos",
        "qvel",
        "actuator_length",
        "actuator_velocity",
        "actuator_force",
        "qfrc_passive",
    )
    step_and_check(xml, KERNELS[kernels], names=names, substeps=2, speed=8.0)


@pytest.mark.parametrize(
    "flag", ("", '<flag spring="disable" damper="disable" actuation="disable"/>')
)
def test_time_passes_as_ever_where_sensors_are_delayed(flag: str) -> None:
    xml = (
        f'<mujoco><option timestep="0.01" integrator="RK4">{flag}</option><worldbody>{HINGE}</worldbody>'
        '<sensor><jointpos joint="h" delay="0.02" nsample="4"/></sensor></mujoco>'
    )
    step_and_check(xml, KERNELS["ours"], names=("time", "qpos", "qvel"), refreshes=False)


@pytest.mark.parametrize(
    "actuators", (SLOWED, SLOWED.replace("<general", '<general forcerange="1 2"'))
)
def test_runge_kutta_leaves_out_what_is_disabled(actuators: str) -> None:
    flag = '<flag spring="disable" damper="disable" actuation="disable"/>'
    xml = WITH_ACTUATORS.format(integrator="RK4", actuators=actuators)
    xml = xml.replace('integrator="RK4"/>', f'integrator="RK4">{flag}</option>')
    names = ("qpos", "qvel", "qacc", "actuator_force", "actuator_length", "actuator_velocity")
    step_and_check(xml, KERNELS["our solver"], names=names)


@pytest.mark.parametrize("integrator", ("Euler", "implicitfast", "RK4"))
def test_controls_are_delayed_by_the_time_of_each_stage(integrator: str) -> None:
    xml = (
        f'<mujoco><option timestep="0.004" integrator="{integrator}"/><worldbody>{HINGE}</worldbody><actuator>'
        '<position joint="h" kp="5" kv="0.2" delay="0.008" nsample="4"/></actuator></mujoco>'
    )
    step_and_check(
        xml, KERNELS["ours"], substeps=6, names=("qpos", "qvel", "qacc", "actuator_force")
    )


def test_ellipsoids_in_a_fluid_are_refused_with_the_integrator_that_has_them_wrong() -> None:
    geom = '<geom type="ellipsoid" size="0.1 0.05 0.03" mass="0.5" fluidshape="ellipsoid"/>'
    lone = f'<body pos="1 0 0"><freejoint/>{geom}</body>'
    jointed = f'<body name="fin"><joint axis="0 1 0"/>{geom}</body>'
    xml = '<mujoco><option density="1000" viscosity="0.1" integrator="{}"/><worldbody>{}</worldbody></mujoco>'
    with pytest.raises(
        ValueError, match="fluidshape='ellipsoid'.*choose integrator='implicitfast'"
    ):
        started(xml.format("implicit", jointed), KERNELS["ours"])
    step_and_check(xml.format("implicit", lone), KERNELS["ours"])
    step_and_check(xml.format("implicitfast", jointed), KERNELS["ours"])


def test_motors_with_activations_are_refused_with_runge_kutta() -> None:
    motor = '<dcmotor joint="h" motorconst="0.1" resistance="1"{}/>'
    with_current = motor.format(' inductance="0.1"')
    with pytest.raises(
        ValueError, match="DC motor with activations.*choose integrator='implicitfast'"
    ):
        started(WITH_ACTUATORS.format(integrator="RK4", actuators=with_current), KERNELS["ours"])
    step_and_check(
        WITH_ACTUATORS.format(integrator="RK4", actuators=motor.format("")), KERNELS["ours"]
    )
    step_and_check(
        WITH_ACTUATORS.format(integrator="implicitfast", actuators=with_current), KERNELS["ours"]
    )
