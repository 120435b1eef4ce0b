"""The one kernel of a substep's smooth dynamics, against the C engine and against MuJoCo Warp's own kernels."""

import copy
import dataclasses
import functools

import mujoco
import mujoco_warp as mjw
import numpy as np
import pytest
import torch
import warp as wp

from ksim_rl.physics import SimCfg, World, load_model, prepare_spec
from ksim_rl.physics.smooth import stages
from tests.physics.models import quadruped, standing_quadrupeds

NUM_ENVS = 3
# Joints of all types, several on a body, chains that share bodies, a welded and a carried body, springs and dampers
# with and without higher orders, and actuators with and without activations, two of them on one joint.
MIXED = """
<mujoco>
  <option timestep="0.004" integrator="implicitfast" gravity="0.5 -1 -9"/>
  <compiler angle="radian"/>
  <worldbody>
    <geom type="plane" size="5 5 1" contype="0" conaffinity="0"/>
    <body name="hand" mocap="true" pos="1 0 1" quat="1 0.2 0 0">
      <geom name="carried" size="0.05" contype="0" conaffinity="0"/>
      <body pos="0.1 0 0"><joint axis="0 1 1" damping="0.2"/><geom size="0.04" mass="0.3" contype="0"/></body>
    </body>
    <body pos="0 0 2" quat="0.8 0.6 0 0">
      <freejoint name="root"/>
      <geom type="box" size="0.2 0.1 0.05" mass="3" pos="0.02 0 0.01" quat="0.9 0 0.1 0" contype="0"/>
      <site name="top" pos="0 0 0.1" quat="0.9 0.1 0.2 0"/>
      <body pos="0.2 0.1 0" quat="0.9 0 0.3 0" gravcomp="0.6">
        <joint name="wrist" type="ball" pos="0.01 0.02 0" stiffness="3" damping="0.3"/>
        <geom type="capsule" size="0.03" fromto="0 0 0 0.2 0 0" mass="0.7" contype="0"/>
        <body pos="0.2 0 0">
          <joint name="slider" type="slide" axis="1 0.2 0" ref="0.1" springref="0.2" stiffness="20" damping="1"/>
          <joint name="twist" axis="0 0 1" pos="0 0.05 0" ref="0.3" armature="0.02" stiffness="4 1 2"
            damping="0.4 0.1 0.2"/>
          <joint name="bend" axis="0 1 0" actuatorfrcrange="-2 3"/>
          <geom type="capsule" size="0.02" fromto="0 0 0 0 0.2 0" mass="0.4" contype="0"/>
          <site name="tip" pos="0 0.2 0"/>
          <body pos="0 0.2 0"><geom size="0.05" mass="0.2" contype="0"/></body>
        </body>
      </body>
      <body pos="-0.2 0 0" gravcomp="1.2">
        <joint name="tail" axis="0 1 0" pos="0.02 0 0" actuatorgravcomp="true"/>
        <geom type="capsule" size="0.02" fromto="0 0 0 -0.3 0 0" mass="0.5" contype="0"/>
      </body>
    </body>
    <body pos="3 0 1">
      <joint type="free" stiffness="2" damping="0.1"/>
      <geom type="box" size="0.1 0.3 0.05" pos="0.02 0.04 0" quat="0.9 0.2 0.1 0" contype="0"/>
    </body>
    <body pos="-1 0 1"><geom size="0.1" contype="0"/></body>
  </worldbody>
  <actuator>
    <motor joint="twist" gear="2" ctrllimited="true" ctrlrange="-0.5 0.5" damping="0.2 0.1 0.05" armature="0.01"/>
    <position joint="twist" kp="5" kv="0.3" forcelimited="true" forcerange="-1 1"/>
    <velocity joint="bend" kv="2"/>
    <intvelocity joint="tail" kp="4" actrange="-0.2 0.2"/>
    <general joint="bend" dyntype="filter" dynprm="0.05" gainprm="9" biastype="affine" biasprm="1 -2 -0.1"/>
    <general joint="slider" dyntype="filterexact" dynprm="0.03" gaintype="affine" gainprm="1 2 3" actearly="true"/>
  </actuator>
</mujoco>
"""
PER_WORLD = (
    *(
        "body_mass",
        "body_inertia",
        "body_ipos",
        "dof_damping",
        "dof_armature",
        "qpos0",
        "jnt_stiffness",
        "jnt_pos",
    ),
    *("actuator_gainprm", "site_pos", "geom_pos"),
)
WRITTEN = (
    *(
        "xpos",
        "xquat",
        "xmat",
        "xipos",
        "ximat",
        "xanchor",
        "xaxis",
        "site_xpos",
        "site_xmat",
        "subtree_com",
    ),
    *(
        "cdof",
        "cinert",
        "cvel",
        "cdof_dot",
        "M",
        "qfrc_bias",
        "qfrc_spring",
        "qfrc_damper",
        "qfrc_passive",
        "qfrc_gravcomp",
    ),
    *(
        "actuator_length",
        "actuator_velocity",
        "act_dot",
        "actuator_force",
        "qfrc_actuator",
        "qfrc_smooth",
    ),
)
GEOMS = ("geom_xpos", "geom_xmat")


@functools.cache
def mixed() -> mujoco.MjModel:
    spec = mujoco.MjSpec.from_string(MIXED)
    prepare_spec(spec, PER_WORLD)
    return spec.compile()


def moved(model: mujoco.MjModel | None = None, **kwargs) -> World:
    """Worlds in different states; nothing pushes the first."""
    kwargs.setdefault("sim", SimCfg(one_kernel_dynamics=True))
    world = World(mixed() if model is None else model, num_envs=NUM_ENVS, **kwargs)
    generator = torch.Generator().manual_seed(0)
    for name in ("qpos", "qvel", "act", "ctrl", "qfrc_applied", "xfrc_applied", "mocap_pos"):
        row = world.view(name)
        row.add_(0.5 * torch.randn(row.shape, generator=generator))
    world.xfrc_applied_EL[0] = 0.0
    return world


def launch(world: World) -> None:
    with wp.ScopedDevice("cpu"):
        stages.smooth_dynamics(world.warp_model, world.warp_data_E)()


def in_c(world: World, mj_model: mujoco.MjModel, row: int) -> mujoco.MjData:
    mj_data = mujoco.MjData(mj_model)
    for name in (
        "qpos",
        "qvel",
        "act",
        "ctrl",
        "qfrc_applied",
        "xfrc_applied",
        "mocap_pos",
        "mocap_quat",
    ):
        getattr(mj_data, name)[:] = world.view(name)[row].numpy()
    mujoco.mj_forward(mj_model, mj_data)
    return mj_data


def check_row(world: World, expected: mujoco.MjData, row: int) -> None:
    for name in (*WRITTEN, *GEOMS):
        theirs = np.asarray(getattr(expected, name)).ravel()
        ours = world.last_substep(name)[row].numpy().ravel()
        scale = 1.0 + np.abs(theirs).max()
        np.testing.assert_allclose(ours / scale, theirs / scale, atol=3e-6, err_msg=name)


def draw_parameters(world: World) -> None:
    """Give each world other parameters of its own."""
    generator = torch.Generator().manual_seed(1)
    for name in PER_WORLD:
        field = world.field(name)
        field.mul_(1.0 + 0.5 * torch.rand(field.shape, generator=generator))
    world.set_const(PER_WORLD)


def with_parameters_of(world: World, row: int) -> mujoco.MjModel:
    """Return the model with the parameters of one world."""
    own = copy.copy(mixed())
    for name in PER_WORLD:
        values = getattr(own, name)
        values[:] = world.field(name)[row].numpy().reshape(values.shape)
    mujoco.mj_setConst(own, mujoco.MjData(own))
    return own


def test_all_it_computes_is_as_in_the_c_engine():
    world = moved()
    assert world.one_kernel_dynamics_unavailable is None
    for name in WRITTEN:
        world.last_substep(name).fill_(7.0)
    launch(world)
    for row in range(NUM_ENVS):
        check_row(world, in_c(world, mixed(), row), row)


def test_its_halves_beside_collisions_compute_what_the_whole_does():
    whole, halves = moved(), moved()
    for world in (whole, halves):
        for name in (*WRITTEN, *GEOMS):
            world.last_substep(name).fill_(7.0)
    launch(whole)
    with wp.ScopedDevice("cpu"):
        dynamics = stages.smooth_dynamics(halves.warp_model, halves.warp_data_E)
        dynamics(goes_on=False)
        assert all((halves.last_substep(name) == 7.0).all() for name in WRITTEN)
        for name in GEOMS:
            assert torch.equal(halves.last_substep(name), whole.last_substep(name)), name
            halves.last_substep(name).fill_(7.0)
        dynamics(places_geoms=False)
    assert all((halves.last_substep(name) == 7.0).all() for name in GEOMS)
    for name in WRITTEN:
        assert torch.equal(halves.last_substep(name), whole.last_substep(name)), name


def test_refresh_leaves_what_belongs_to_the_last_substep():
    world = moved()
    world.step(2)
    kept = ("cacc", "cfrc_int", "qfrc_passive", "qfrc_actuator", "actuator_force", "act_dot")
    before = {name: world.view(name).clone() for name in kept}
    world.qpos_EL[:, 0] += 1.0
    world.qvel_EL.mul_(2.0)
    world.refresh()
    for name, values in before.items():
        assert torch.equal(world.view(name), values), name
    expected = in_c(world, mixed(), 1)
    for name in ("xpos", "geom_xmat", "subtree_com", "cdof", "cvel", "cdof_dot"):
        theirs = np.asarray(getattr(expected, name)).ravel()
        np.testing.assert_allclose(
            world.view(name)[1].numpy().ravel(), theirs, atol=3e-5, err_msg=name
        )


def test_refresh_sums_the_momenta_of_subtrees_if_they_are_read():
    world = moved()
    sums = {name: world.view(name) for name in ("subtree_linvel", "subtree_angmom")}
    world.refresh()
    for row in range(NUM_ENVS):
        expected = in_c(world, mixed(), row)
        mujoco.mj_subtreeVel(mixed(), expected)
        for name, found in sums.items():
            np.testing.assert_allclose(
                found[row], getattr(expected, name), atol=3e-5, rtol=3e-5, err_msg=name
            )


def test_refresh_of_rows_leaves_the_others_alone():
    world, whole = moved(), moved()
    named_E = torch.tensor([False, True, False])
    names = ("xpos", "site_xpos", "site_xmat", "subtree_com", "cdof", "cvel", "cdof_dot")
    for name in names:
        world.view(name).fill_(7.0)
    world.refresh(named_E)
    whole.refresh()
    for name in names:
        assert torch.equal(world.view(name)[named_E], whole.view(name)[named_E]), name
        assert (world.view(name)[~named_E] == 7.0).all(), name


def test_each_world_has_its_own_masses_dampers_and_springs():
    world = moved(per_world_fields=PER_WORLD)
    draw_parameters(world)
    launch(world)
    for row in range(NUM_ENVS):
        own = with_parameters_of(world, row)
        check_row(world, in_c(world, own, row), row)


def test_what_is_not_finite_stays_in_its_world():
    found = []
    for spoilt in (False, True):
        world = moved()
        if spoilt:
            world.qvel_EL[1] = torch.nan
        launch(world)
        found.append({name: world.last_substep(name).clone() for name in (*WRITTEN, *GEOMS)})
    assert found[1]["qfrc_smooth"][1].isnan().all()
    for name, clean in found[0].items():
        assert torch.equal(clean[[0, 2]], found[1][name][[0, 2]]), name


def test_steps_and_their_sensors_are_those_of_mujoco_warps_kernels():
    reached = []
    for one_kernel_dynamics in (True, False):
        sim = SimCfg(njmax=80, nconmax=40, one_kernel_dynamics=one_kernel_dynamics)
        world = standing_quadrupeds(sim=sim)
        assert (world.one_kernel_dynamics_unavailable is None) == one_kernel_dynamics
        reached.append(
            {name: world.view(name).clone() for name in ("qpos", "qvel", "sensordata", "M", "xpos")}
        )
    assert reached[0]["sensordata"].abs().max() > 1.0
    for name, ours in reached[0].items():
        torch.testing.assert_close(ours, reached[1][name], atol=2e-4, rtol=2e-4, msg=name)


BODY = '<body><joint name="a"/><geom name="g" size="0.1"/>{inside}</body>'
OUT_OF_RANGE = {
    "tendons": f"<worldbody>{BODY}</worldbody><tendon><fixed><joint joint='a' coef='1'/></fixed></tendon>",
    "fluid": f"<option density='1'/><worldbody>{BODY}</worldbody>",
    "delayed": f"<worldbody>{BODY}</worldbody><actuator><motor joint='a' nsample='2' delay='0.01'/></actuator>",
    "affine": f"<worldbody>{BODY}</worldbody><actuator><muscle joint='a' lengthrange='0 1'/></actuator>",
    "hinge or slide": "<worldbody><body><joint type='ball' name='a'/><geom size='0.1'/></body></worldbody>"
    "<actuator><motor joint='a'/></actuator>",
    "shared memory": "<worldbody>"
    + BODY
    + "<body><geom size='0.1'/></body>" * 700
    + "</worldbody>",
}


@pytest.mark.parametrize("word", OUT_OF_RANGE)
def test_models_out_of_its_range_are_told_why(word):
    model = load_model(f"<mujoco>{OUT_OF_RANGE[word].format(inside='')}</mujoco>")
    with wp.ScopedDevice("cpu"):
        assert word in str(stages.unsuited(mjw.put_model(model)))


@pytest.mark.parametrize(
    ("num_bodies", "worlds", "expected"),
    [
        (10, 4096, [(16, 32), (32, 32)]),
        (10, 32768, [(8, 64), (8, 64)]),
        (20, 32768, [(16, 64), (8, 64)]),
        (50, 32768, [(16, 64), (16, 64)]),
        (300, 32768, [(32, 64), (32, 64)]),
        (400, 32768, [(32, 32), (32, 32)]),
    ],
)
def test_few_or_large_worlds_have_more_lanes_each(num_bodies, worlds, expected):
    with wp.ScopedDevice("cpu"):
        sizes = stages._sizes(mjw.put_model(quadruped()))
    sizes |= {"num_bodies": num_bodies, "poses": 10 * num_bodies, "num_entries": 16 * num_bodies}
    assert [
        stages._block(parts, sizes, worlds) for parts in (stages.SMOOTH, stages.INTEGRATION)
    ] == expected


def test_settings_that_leave_it_out_are_told():
    with wp.ScopedDevice("cpu"):
        warp_model = mjw.put_model(quadruped())
    unavailable = stages.one_kernel_dynamics_unavailable
    sim = SimCfg(one_kernel_dynamics=True)
    assert unavailable(warp_model, sim, solver_unavailable=None) is None
    assert "not solved by one kernel" in str(
        unavailable(warp_model, sim, solver_unavailable="a reason")
    )
    off = dataclasses.replace(sim, one_kernel_dynamics=False)
    assert "one_kernel_dynamics is False" in str(
        unavailable(warp_model, off, solver_unavailable=None)
    )
