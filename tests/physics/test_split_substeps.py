"""What is read, and how substeps are split into calls, never changes the state that they reach: bit for bit."""

import itertools
from typing import Literal

import mujoco
import numpy as np
import pytest
import torch

from benchmarks.agreement_models import QUADRUPED
from ksim_rl.physics import SimCfg, World, load_model

FREE_SLAB = """
<mujoco>
  <option timestep="0.005" integrator="implicitfast" gravity="0 0 0"/>
  <worldbody><body><freejoint/><geom type="box" size="0.1 0.06 0.02" mass="1"/></body></worldbody>
</mujoco>
"""
# A lone free body, a free body that carries a joint, an arm, contacts, limits and dry friction.
MIXED = """
<mujoco>
  <option timestep="0.004" integrator="{integrator}" cone="{cone}"/>
  <worldbody>
    <geom type="plane" size="5 5 1"/>
    <body pos="0 0 0.05"><freejoint/><geom type="box" size="0.1 0.06 0.05" mass="1" pos="0.01 0 0"/>
      <site name="s"/></body>
    <body pos="1 0 0.12"><freejoint/><geom size="0.1" mass="1"/>
      <body pos="0.1 0 0"><joint name="tail" axis="0 1 0" range="-20 20" limited="true" frictionloss="0.02"/>
        <geom type="capsule" size="0.03" fromto="0 0 0 0.3 0 0" mass="0.2"/><site name="tip" pos="0.3 0 0"/></body>
    </body>
    <body pos="2 0 0.5"><joint name="arm" axis="0 1 0" damping="0.1"/>
      <geom type="capsule" size="0.03" fromto="0 0 0 0.3 0 0" mass="0.4"/></body>
  </worldbody>
  <actuator><position joint="arm" kp="5" kv="0.3"/><motor joint="tail"/></actuator>
  <sensor><accelerometer site="tip"/><gyro site="s"/><framelinvel objtype="site" objname="tip"/>
    <subtreeangmom body="world"/><force site="tip"/></sensor>
</mujoco>
"""
MODELS = {
    "slab": FREE_SLAB,
    "euler": MIXED.format(integrator="Euler", cone="pyramidal"),
    "implicitfast": MIXED.format(integrator="implicitfast", cone="elliptic"),
    "implicit": MIXED.format(integrator="implicit", cone="pyramidal"),
    "quadruped": QUADRUPED,
}
SIMS = {
    "ours": SimCfg(one_kernel_dynamics=True),
    "our solver": SimCfg(),
    "theirs": SimCfg(one_kernel_solver=False),
}
# Each integrator and each kind of kernels; all their pairs run in full tests.
QUICK = (
    ("slab", "ours"),
    ("euler", "ours"),
    ("implicitfast", "ours"),
    ("implicit", "our solver"),
    ("quadruped", "our solver"),
    ("implicitfast", "theirs"),
)
LONG = [pair for pair in itertools.product(MODELS, SIMS) if pair not in QUICK]
SPIN = (10.0, 0.0, 3.0, 5.0, 30.0, 3.0)


def run(
    world: World,
    calls: list[tuple[int, Literal["last", "contacts", "every"]]],
    *,
    reads: bool = False,
) -> torch.Tensor:
    """The state that 24 substeps reach, in these calls of `step`, with a refresh and views between them or none."""
    world.reset(torch.ones(2, dtype=torch.bool))
    generator = np.random.default_rng(5)
    speeds = generator.uniform(-2.0, 2.0, world.mj_model.nv)
    world.qvel_EL.copy_(torch.from_numpy(speeds).float())
    world.ctrl_EL.fill_(0.1)
    if reads:
        for name in ("M", "qfrc_bias", "cacc", "subtree_linvel"):
            world.view(name)
    for substeps, sensors in calls:
        world.step(substeps, sensors=sensors)
        if reads:
            world.refresh()
    return torch.cat([world.qpos_EL, world.qvel_EL], dim=-1)


@pytest.mark.parametrize(
    ("name", "sim"), [*QUICK, *(pytest.param(*pair, marks=pytest.mark.full) for pair in LONG)]
)
def test_no_substep_depends_on_what_was_read_before_it(name: str, sim: str) -> None:
    mj_model = load_model(MODELS[name])
    world = World(mj_model, num_envs=2, sim=SIMS[sim])
    at_once = run(world, [(24, "last")])
    assert torch.isfinite(at_once).all()
    assert torch.equal(run(world, [(4, "last")] * 6), at_once)
    assert torch.equal(run(world, [(1, "last")] * 24), at_once)
    assert torch.equal(run(world, [(8, "every")] * 3), at_once)
    assert torch.equal(run(world, [(8, "contacts")] * 3), at_once)
    assert torch.equal(run(world, [(4, "last")] * 6, reads=True), at_once)


@pytest.mark.parametrize("substeps", (1, 4, 10))
def test_a_slab_spins_as_in_the_c_engine(substeps: int) -> None:
    mj_model = load_model(FREE_SLAB)
    world = World(mj_model, num_envs=1, sim=SimCfg(one_kernel_dynamics=True))
    world.qvel_EL.copy_(torch.tensor(SPIN))
    mj_data = mujoco.MjData(mj_model)
    mj_data.qvel[:] = SPIN
    for _ in range(100 // substeps):
        world.step(substeps)
    for _ in range(100):
        mujoco.mj_step(mj_model, mj_data)
    np.testing.assert_allclose(mj_data.qvel[3:], (6.92, -26.93, 4.20), atol=0.005)
    np.testing.assert_allclose(world.qvel_EL[0].numpy(), mj_data.qvel, atol=2e-3)


@pytest.mark.parametrize("sim", SIMS)
def test_forces_of_bodies_survive_a_refresh_that_computes_bias_forces(sim: str) -> None:
    mj_model = load_model(MODELS["euler"])
    world = World(mj_model, num_envs=1, sim=SIMS[sim])
    names = ("cacc", "cfrc_ext", "cfrc_int")
    for name in (*names, "qfrc_bias"):
        world.view(name)
    mj_data = mujoco.MjData(mj_model)
    mj_data.qvel[:] = np.linspace(-1.0, 1.0, mj_model.nv)
    world.qvel_EL.copy_(torch.from_numpy(mj_data.qvel).float())
    world.step(1)
    world.refresh()
    mujoco.mj_forward(mj_model, mj_data)
    mujoco.mj_rnePostConstraint(mj_model, mj_data)
    for name in names:
        expected = getattr(mj_data, name)
        scale = np.abs(expected).max()
        np.testing.assert_allclose(
            world.view(name)[0].numpy(), expected, atol=1e-3 * scale, err_msg=name
        )


def test_a_model_without_degrees_of_freedom_steps() -> None:
    xml = (
        '<mujoco><worldbody><geom type="plane" size="1 1 1"/>'
        '<body mocap="true" pos="0 0 1"><geom size="0.1"/></body></worldbody></mujoco>'
    )
    world = World(load_model(xml), num_envs=2)
    world.step(2)
    world.refresh()
    assert world.view("geom_xpos")[1, 1].tolist() == [0.0, 0.0, 1.0]
