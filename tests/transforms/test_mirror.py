"""The mirror image of a robot, against MuJoCo's kinematics."""

import mujoco
import numpy as np
import pytest
import torch
from tensordict import TensorDict

from ksim_rl.envs.masked_transformed_env import MaskedTransformedEnv
from ksim_rl.physics.model_files.menagerie import model_path
from ksim_rl.scene.robots.own_robots import Humanoid
from ksim_rl.testing import CounterEnv
from ksim_rl.transforms import (
    AXIAL,
    PLANAR_VELOCITY,
    POLAR,
    QUATERNION,
    GroupSpec,
    Mirror,
    MirrorMap,
    mirror_by_name,
    mirror_group,
    mirror_joints,
    mirror_name,
    mirrored,
)
from tests.absent_models import skipped_without_models
from tests.transforms.chains import VECTOR, actions, fixed_rollout

ROBOTS = {
    "humanoid": lambda: Humanoid().spec().compile(),
    "unitree_go1": lambda: mujoco.MjModel.from_xml_path(str(model_path("unitree_go1/go1"))),
    "unitree_g1": lambda: mujoco.MjModel.from_xml_path(str(model_path("unitree_g1/g1"))),
    "booster_t1": lambda: mujoco.MjModel.from_xml_path(str(model_path("booster_t1/t1"))),
}


@pytest.mark.parametrize("robot", ROBOTS)
def test_mirrored_joints_put_the_bodies_where_the_mirror_shows_them(robot):
    with skipped_without_models():
        model = ROBOTS[robot]()
    joints = mirror_joints(model)
    generator = np.random.default_rng(0)
    data, image = mujoco.MjData(model), mujoco.MjData(model)
    quat = generator.normal(size=4)
    data.qpos[:] = np.concatenate(
        (
            generator.normal(size=3),
            quat / np.linalg.norm(quat),
            generator.uniform(-0.5, 0.5, model.nq - 7),
        )
    )
    data.qvel[:] = generator.normal(size=model.nv)
    qpos, qvel = torch.tensor(data.qpos), torch.tensor(data.qvel)
    image.qpos[:] = torch.cat((POLAR(qpos[:3]), QUATERNION(qpos[3:7]), joints(qpos[7:]))).numpy()
    # MuJoCo gives the root's linear velocity in the world frame and its angular velocity in the body frame.
    image.qvel[:] = torch.cat((POLAR(qvel[:3]), AXIAL(qvel[3:6]), joints(qvel[6:]))).numpy()
    for state in (data, image):
        mujoco.mj_forward(model, state)
    names = [model.body(body).name for body in range(1, model.nbody)]
    places = mirror_by_name(names, POLAR)
    for quantity in ("xpos", "cvel"):
        seen, shown = getattr(data, quantity)[1:], getattr(image, quantity)[1:]
        each = (
            POLAR
            if quantity == "xpos"
            else MirrorMap(source=range(6), signs=AXIAL.signs + POLAR.signs)
        )
        places = mirror_by_name(names, each)
        expected = places(torch.tensor(seen.reshape(-1))).numpy().reshape(seen.shape)
        # The centers of mass, about which cvel is, are symmetric to some millimeters only.
        np.testing.assert_allclose(shown, expected, atol=1e-4 if quantity == "xpos" else 0.1)
    assert np.abs(image.xpos - data.xpos).max() > 0.1


HUMANOID = mirror_joints(Humanoid().spec().compile())


@pytest.mark.parametrize(
    "mirror",
    [POLAR, AXIAL, PLANAR_VELOCITY, QUATERNION, HUMANOID, MirrorMap(source=(1, 0, 3, 2, 5, 4))],
)
def test_twice_is_the_vector_itself(mirror):
    vector = torch.randn(4, mirror.size)
    assert torch.equal(mirror(mirror(vector)), vector)
    assert not torch.equal(mirror(vector), vector)


@pytest.mark.parametrize(
    ("name", "image"),
    [
        ("left_hip_pitch", "right_hip_pitch"), ("FL_calf", "FR_calf"), ("RR_thigh_joint", "RL_thigh_joint"),
        ("RH_KFE", "LH_KFE"), ("l_knee", "r_knee"), ("LeftFoot", "RightFoot"), ("FLHip", "FRHip"), ("AL1", "AR1"),
        ("dog/front_right_roll", "dog/front_left_roll"), ("waist", "waist"), ("upright", "upright"),
        ("left_toe_left", "right_toe_right"), ("AR_tag", "AR_tag"),
    ],
)  # fmt: skip
def test_names(name, image):
    assert mirror_name(name, [name, image, "other"]) == image
    assert mirror_name(image, [name, image, "other"]) == name


def test_joints_that_are_no_mirror_images_are_refused():
    xml = """<mujoco><worldbody><body name="{a}" pos="0 {y} 0"><joint name="{a}" axis="0 1 0"/><geom size=".1"/></body>
      <body name="right_leg" pos="0 -1 0"><joint name="right_leg" axis="{axis}"/><geom size=".1"/></body>
      </worldbody></mujoco>"""
    good = mujoco.MjModel.from_xml_string(xml.format(a="left_leg", y=1, axis="0 -1 0"))
    assert mirror_joints(good).signs == (-1.0, -1.0)
    for wrong in ({"y": 0.5, "axis": "0 1 0"}, {"y": 1, "axis": "1 0 0"}):
        model = mujoco.MjModel.from_xml_string(xml.format(a="left_leg", **wrong))
        with pytest.raises(ValueError, match="no mirror images"):
            mirror_joints(model)
    alone = mujoco.MjModel.from_xml_string(xml.format(a="left_log", y=1, axis="0 1 0"))
    with pytest.raises(ValueError, match="did you mean 'right_leg'"):
        mirror_joints(alone)
    with pytest.raises(ValueError, match="did you mean 'left_leg'"):
        mirror_joints(good, ["left_lag", "right_leg"])


def test_a_group_vector_by_the_slices_of_its_terms():
    joints = MirrorMap(source=(1, 0), signs=(-1, -1))
    group = GroupSpec(name="actor", terms=("gravity", ("obs", "joint_pos")), sizes=(3, 6))
    mirror = mirror_group(group, {"gravity": POLAR, "joint_pos": joints})
    vector = torch.randn(2, 9)
    assert torch.equal(mirror(vector)[:, group.slice("gravity")], POLAR(vector[:, :3]))
    for frame in range(3):
        columns = slice(3 + 2 * frame, 5 + 2 * frame)
        assert torch.equal(mirror(vector)[:, columns], joints(vector[:, columns]))
    with pytest.raises(ValueError, match="'joint_pos'"):
        mirror_group(group, {"gravity": POLAR})
    with pytest.raises(ValueError, match="expected a multiple"):
        mirror_group(group, {"gravity": QUATERNION, "joint_pos": joints})


SWAP = MirrorMap(source=(1, 0), signs=(-1, -1))


def mirror_env(probability, lengths=(3, 5, 4)):
    maps = {VECTOR: POLAR, "action": SWAP}
    env = MaskedTransformedEnv(
        CounterEnv(lengths), [Mirror(VECTOR, "seen", maps=maps, probability=probability)]
    )
    env.set_seed(0)
    return env


@pytest.mark.parametrize("probability", [0.0, 1.0])
def test_episodes_in_a_mirror(probability):
    rollout_ET = fixed_rollout(mirror_env(probability), 8)
    image = POLAR(rollout_ET[VECTOR])
    assert torch.equal(rollout_ET["seen"], image if probability else rollout_ET[VECTOR])
    # The env is paid for the sum of the action, whose mirror image has the other sign.
    paid = rollout_ET["action"].sum(-1, keepdim=True)
    torch.testing.assert_close(rollout_ET["next", "reward"], -paid if probability else paid)


def test_a_share_of_episodes_is_mirrored_from_start_to_end():
    env = mirror_env(0.25, lengths=(5,) * 1000)
    rollout_ET = fixed_rollout(env, 10)
    is_mirrored = (rollout_ET["seen"][..., 1] == -rollout_ET[VECTOR][..., 1]).reshape(1000, 2, 5)
    assert bool((is_mirrored == is_mirrored[..., :1]).all())
    share = is_mirrored[..., 0].float()
    assert abs(float(share.mean()) - 0.25) < 4 * (0.25 * 0.75 / 2000) ** 0.5
    both = float((share[:, 0] * share[:, 1]).mean())
    assert abs(both - 0.0625) < 4 * (0.0625 * 0.9375 / 1000) ** 0.5, "episodes are drawn apart"
    sums = rollout_ET["action"].sum(-1).reshape(1000, 2, 5)
    paid = rollout_ET["next", "reward"][..., 0].reshape(1000, 2, 5)
    torch.testing.assert_close(paid, torch.where(is_mirrored, -sums, sums))


def test_a_batch_is_doubled_by_its_mirror_image():
    batch_ET = fixed_rollout(mirror_env(0.0), 6)
    maps = {VECTOR: POLAR, "action": SWAP}
    image_ET = mirrored(batch_ET, maps)
    assert torch.equal(image_ET["next"][VECTOR], POLAR(batch_ET["next"][VECTOR]))
    assert torch.equal(image_ET["action"], SWAP(batch_ET["action"]))
    assert torch.equal(image_ET["next", "reward"], batch_ET["next", "reward"])
    again = mirrored(image_ET, maps)
    assert all(torch.equal(again[key], value) for key, value in batch_ET.items(True, True))
    assert torch.cat((batch_ET, image_ET)).shape == (6, 6)
    with pytest.raises(KeyError, match="imu"):
        mirrored(batch_ET, {"imu": POLAR})


def test_the_policy_gets_the_bounds_that_both_images_have():
    env = mirror_env(0.5)
    assert env.action_spec == CounterEnv().action_spec
    steps = actions(3, env)
    assert all(env.action_spec.is_in(SWAP(step)) for step in steps)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: MirrorMap(source=(0, 0)), "each of 0 to 1 once"),
        (lambda: MirrorMap(source=(1, 2, 0)), "no mirror images"),
        (lambda: MirrorMap(source=(1, 0), signs=(1, -1)), "no mirror images"),
        (lambda: MirrorMap(source=(0,), signs=(2.0,)), r"signs\[0\]"),
        (lambda: MirrorMap(source=(0, 1), signs=(1.0,)), "1 numbers for the 2"),
        (lambda: Mirror("x", maps={"x": POLAR}), r"maps has the keys \['x'\]: expected \['x'\]"),
        (
            lambda: Mirror("x", in_keys_inv=[], maps={"x": POLAR}, probability=2.0),
            "probability=2.0",
        ),
        (lambda: mirrored(TensorDict(x=torch.zeros(2)), {"y": POLAR}), "y"),
    ],
)
def test_wrong_values_are_refused(build, message):
    with pytest.raises((ValueError, KeyError), match=message):
        build()
