import functools
import math

import mujoco
import numpy as np
import pytest
import torch

from ksim_rl.physics import SimCfg, World, capacity, load_model, poses
from ksim_rl.physics.collision.candidate_pairs import CandidatePairs
from tests.physics.models import cartpole, quadruped

GROUNDS = ('<geom type="plane" size="9 9 1"/>', '<geom type="box" size="9 9 0.5" pos="0 0 -0.5"/>')


def test_probed_capacities_hold_for_robots_thrown_about():
    mj_model = quadruped()
    rng = np.random.default_rng(7)
    world = World(mj_model, num_envs=64)
    world.qpos_EL.copy_(torch.from_numpy(poses.random_qpos(mj_model, 64, rng)))
    world.qpos_EL[:, 2] = 0.25
    for _ in range(20):
        world.ctrl_EL.uniform_(-1.0, 1.0)
        world.step(4)
    report = world.overflow_report()
    assert report.ok, report.messages
    assert report.ncon > 64


def test_candidate_pairs_cover_warps_broadphase():
    mj_model = quadruped()
    rng = np.random.default_rng(3)
    pairs = CandidatePairs(mj_model)
    world = World(mj_model, num_envs=1, sim=SimCfg(njmax=200, nconmax=100))
    mj_data = mujoco.MjData(mj_model)
    for qpos in poses.random_qpos(mj_model, 20, rng):
        mj_data.qpos[:] = qpos
        poses.put_in_ground(mj_model, mj_data, depth=0.01)
        mujoco.mj_fwdPosition(mj_model, mj_data)
        world.qpos_EL[0] = torch.from_numpy(mj_data.qpos)
        world.qvel_EL.zero_()
        world.step(1)
        assert world.last_substep("ncollision").item() <= pairs.count(mj_data)
        assert world.last_substep("nacon").item() >= mj_data.ncon > 0


@functools.cache
def spider(ground: str) -> mujoco.MjModel:
    """Return a robot of eight legs with flat feet, whose joints are all limited and strongly driven."""
    spec = mujoco.MjSpec.from_string(
        f"<mujoco><option timestep='0.004'/><worldbody>{ground}</worldbody></mujoco>"
    )
    body = spec.worldbody.add_body(pos=[0.0, 0.0, 0.3])
    body.add_freejoint()
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_CYLINDER, size=[0.2, 0.05, 0.0])
    for leg in range(8):
        angle = leg * math.pi / 4.0
        part, pos = body, [0.2 * math.cos(angle), 0.2 * math.sin(angle), 0.0]
        for segment, axis in enumerate(([0, 0, 1], [0, 1, 0], [0, 1, 0])):
            quat = (
                [math.cos(angle / 2.0), 0.0, 0.0, math.sin(angle / 2.0)]
                if segment == 0
                else [1.0, 0.0, 0.0, 0.0]
            )
            part = part.add_body(pos=pos, quat=quat)
            name = f"joint_{leg}_{segment}"
            part.add_joint(
                name=name, axis=axis, limited=1, range=[-0.6, 0.6], damping=0.2, armature=0.01
            )
            rod = mujoco.mjtGeom.mjGEOM_CAPSULE
            part.add_geom(type=rod, fromto=[0.0, 0.0, 0.0, 0.15, 0.0, 0.0], size=[0.02, 0.0, 0.0])
            actuator = spec.add_actuator(target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
            actuator.ctrllimited, actuator.ctrlrange = 1, [-8.0, 8.0]
            pos = [0.15, 0.0, 0.0]
        part.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.04, 0.03, 0.02], pos=[0.15, 0.0, 0.0])
    return spec.compile()


def most_needed(mj_model: mujoco.MjModel, *, seed: int) -> tuple[int, int]:
    """Return the most rows and contacts of falls from all heights up to 0.3 m, under extreme controls."""
    rng = np.random.default_rng(seed)
    mj_data = mujoco.MjData(mj_model)
    rows = contacts = 0
    for qpos in poses.random_qpos(mj_model, 24, rng):
        mujoco.mj_resetData(mj_model, mj_data)
        mj_data.qpos[3:7] = qpos[3:7]
        poses.put_in_ground(mj_model, mj_data, depth=-rng.uniform(0.0, 0.3))
        for step in range(250):
            if step % 5 == 0:
                mj_data.ctrl[:] = poses.extreme_ctrl(mj_model, rng)
            mujoco.mj_step(mj_model, mj_data)
            rows, contacts = max(rows, mj_data.nefc), max(contacts, mj_data.ncon)
    return rows, contacts


@pytest.mark.parametrize("ground", GROUNDS, ids=("plane", "box"))
def test_a_robot_of_many_legs_has_room_for_falls_that_the_probe_has_not_seen(ground):
    mj_model = spider(ground)
    njmax, nconmax = capacity.probe(mj_model)
    rows, contacts = most_needed(mj_model, seed=21)
    # Poses alone came to 64 and 48 on a plane, and to 40 rows on a box.
    assert 100 < rows <= njmax < 2.5 * rows
    assert 20 < contacts <= nconmax


def test_equalities_that_are_off_have_room_for_their_rows():
    bodies = "".join(
        f"<body name='{name}' pos='{x} 0 0'><joint name='{name}' type='slide'/><geom size='0.1'/></body>"
        for name, x in (("a", 0), ("b", 1))
    )
    ties = (
        "<weld body1='a' body2='b' {0}/><connect body1='a' body2='b' anchor='0 0 0' {0}/>"
        "<joint joint1='a' joint2='b' {0}/>"
    )
    rooms = [
        capacity.probe(
            load_model(
                f"<mujoco><worldbody>{bodies}</worldbody><equality>{ties.format(state)}</equality></mujoco>"
            )
        )[0]
        for state in ("active='true'", "active='false'")
    ]
    assert all(room >= 6 + 3 + 1 for room in rooms), rooms


def test_all_limits_at_once_have_room():
    joints = "".join(
        f"<body pos='{x} 0 0'><joint type='slide' limited='true' range='-1 1'/><geom size='0.1'/></body>"
        for x in range(20)
    )
    world = World(load_model(f"<mujoco><worldbody>{joints}</worldbody></mujoco>"), num_envs=2)
    world.qpos_EL.fill_(1.1)
    world.step(1)
    report = world.overflow_report()
    assert report.ok and report.nefc == 20


def test_put_in_ground_puts_a_body_on_what_is_fixed_below_it():
    mj_model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><geom type='plane' size='1 1 1'/>"
        "<geom type='box' size='0.2 0.2 0.25' pos='0 0 0.25'/>"
        "<geom type='box' size='0.1 0.1 0.1' pos='0 0 3' contype='0' conaffinity='0'/>"
        "<body pos='0 0 2'><freejoint/><geom size='0.1'/></body>"
        "<body pos='0.6 0 2'><freejoint/><geom size='0.1'/></body>"
        "</worldbody></mujoco>"
    )
    mj_data = mujoco.MjData(mj_model)
    poses.put_in_ground(mj_model, mj_data, depth=0.01)
    assert mj_data.qpos[[2, 9]] == pytest.approx([0.59, 0.09], abs=1e-6)


def test_a_model_without_contacts_gets_a_small_room():
    njmax, nconmax = capacity.probe(cartpole())
    assert njmax == nconmax == 8


def test_the_settings_win_over_the_probe():
    assert capacity.capacities(quadruped(), SimCfg(njmax=33, nconmax=11)) == (33, 11)
    njmax, nconmax = capacity.capacities(quadruped(), SimCfg(nconmax=11))
    assert (njmax, nconmax) == (capacity.probe(quadruped())[0], 11)


@pytest.mark.parametrize(
    ("field", "number", "most"), [("njmax", 2**31, 2**31 - 1), ("nconmax", 10**9, (2**31 - 1) // 4)]
)
def test_more_than_warp_can_count_is_refused_by_name(field, number, most):
    capacity.check_countable(**{"njmax": 1, "nconmax": 1, field: most}, num_envs=4)
    with pytest.raises(
        ValueError, match=f"sim.{field}={number}: expected at most {most} for num_envs=4"
    ):
        capacity.check_countable(**{"njmax": 1, "nconmax": 1, field: number}, num_envs=4)


def test_a_world_of_more_contacts_than_warp_can_count_is_refused():
    sim = SimCfg(njmax=1, nconmax=10**9, engine="warp")
    with pytest.raises(
        ValueError, match=r"sim.nconmax=1000000000: expected at most \d+ for num_envs=4"
    ):
        World(cartpole(), num_envs=4, device="cpu", sim=sim)


def test_put_in_ground_lets_the_lowest_geom_touch():
    mj_model = quadruped()
    mj_data = mujoco.MjData(mj_model)
    mj_data.qpos[2] = 3.0
    poses.put_in_ground(mj_model, mj_data, depth=0.005)
    mujoco.mj_forward(mj_model, mj_data)
    assert min(contact.dist for contact in mj_data.contact) == pytest.approx(-0.005, abs=1e-6)
