"""Cameras against MuJoCo's own renderer and closed forms: a red box above a green floor, seen from the front."""

import mujoco
import numpy as np
import pytest
import torch

from ksim_rl.envs import (
    CameraSensor,
    ManagerBasedRlEnv,
    ObservationGroupCfg,
    ObservationTermCfg,
)
from ksim_rl.mdp import CameraImage, JointPos
from ksim_rl.scene.rendering import rendering
from ksim_rl.testing import count_syncs
from ksim_rl.transforms.groups.group_cfg import compile_groups
from tests.envs.probe_env import puck_cfg
from tests.scene.sensors.bench import SensorBench

WIDTH, HEIGHT = 40, 30
SCENE = """
<mujoco>
  <visual><quality offsamples="0"/><headlight ambient="0.4 0.4 0.4" diffuse="0.6 0.6 0.6" specular="0 0 0"/></visual>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 0.1" rgba="0 1 0 1"/>
    <body name="box" pos="0 0 0.5">
      <joint name="slide" type="slide" axis="0 1 0"/>
      <geom name="box" type="box" size="0.2 0.2 0.2" rgba="1 0 0 1"/>
      <geom name="hidden" type="sphere" size="0.4" rgba="0 0 1 1" group="4"/>
    </body>
    <camera name="front" pos="-2 0 0.8" xyaxes="0 -1 0 0.1 0 1" fovy="50"/>
  </worldbody>
</mujoco>
"""
LOOK = {"width": WIDTH, "height": HEIGHT, "depth": True, "segmentation": True}
SENSORS = {
    "front": CameraSensor(camera="front", **LOOK),
    # The same place and direction, added to the model.
    "added": CameraSensor(
        pos=(-2.0, 0.0, 0.8), xyaxes=(0.0, -1.0, 0.0, 0.1, 0.0, 1.0), fovy=50.0, **LOOK
    ),
    # Looks down from above the box's face, 2 m over the floor.
    "top": CameraSensor(
        body="box", pos=(0.0, 0.0, 1.5), xyaxes=(0.0, -1.0, 0.0, 1.0, 0.0, 0.0), **LOOK
    ),
}


@pytest.fixture(scope="module")
def bench():
    bench = SensorBench(SCENE, 2, SENSORS)
    bench.place(qpos=[[0.0], [0.4]])
    return bench


@pytest.fixture(scope="module")
def reference(bench):
    """MuJoCo's own pictures of both worlds: colors, depth and ids of geoms."""
    model = bench.world.mj_model
    try:
        rendering.choose_gl_platform()
        renderer = mujoco.Renderer(model, HEIGHT, WIDTH)
    except Exception as error:
        pytest.skip(f"no OpenGL here: {error}")
    data, pictures = mujoco.MjData(model), []
    for qpos in bench.world.qpos_EL.numpy():
        data.qpos[:] = qpos
        mujoco.mj_forward(model, data)
        renderer.update_scene(data, camera="front")
        rgb = renderer.render().copy()
        renderer.enable_depth_rendering()
        depth = renderer.render().copy()
        renderer.disable_depth_rendering()
        renderer.enable_segmentation_rendering()
        ids = renderer.render()[..., 0].copy()
        renderer.disable_segmentation_rendering()
        pictures.append((rgb, depth, ids))
    renderer.close()
    return [np.stack(kind) for kind in zip(*pictures, strict=True)]


def agreement(actual, expected, tolerance):
    return (np.abs(actual.astype(float) - expected) <= tolerance).mean()


def test_segmentation_agrees_with_mujocos_renderer(bench, reference):
    ids_EHW = bench.view.camera("front").segmentation_EHW
    assert ids_EHW.shape == (2, HEIGHT, WIDTH) and ids_EHW.dtype == torch.int32
    assert set(ids_EHW.unique().tolist()) == {-1, 0, 1}, "sky, floor and box, but no hidden geom"
    assert agreement(ids_EHW.numpy(), reference[2], 0) > 0.98, "up to the edges of things"


def test_depth_agrees_with_mujocos_renderer(bench, reference):
    depth_EHW = bench.view.camera("front").depth_EHW.numpy()
    seen = reference[2] >= 0
    # On a slanted floor half a pixel changes the depth, by up to several percent far away.
    assert agreement(depth_EHW[seen], reference[1][seen], 0.02 * reference[1][seen] + 0.01) > 0.95
    assert (depth_EHW[bench.view.camera("front").segmentation_EHW.numpy() < 0] == 10.0).all(), (
        "the sky is far"
    )


def test_colors_agree_with_mujocos_renderer(bench, reference):
    rgb_EHW3 = bench.view.camera("front").rgb_EHW3
    assert rgb_EHW3.shape == (2, HEIGHT, WIDTH, 3) and rgb_EHW3.dtype == torch.uint8
    assert agreement(rgb_EHW3.numpy(), reference[0], 3) > 0.98
    for geom, strongest in ((0, 1), (1, 0)):  # the floor is green, the box red
        colors = rgb_EHW3[bench.view.camera("front").segmentation_EHW == geom]
        assert (colors.argmax(-1) == strongest).all() and colors.amax() > 100


def test_a_camera_can_be_added_to_the_model(bench):
    for output in ("rgb_EHW3", "depth_EHW", "segmentation_EHW"):
        added, front = (getattr(bench.view.camera(name), output) for name in ("added", "front"))
        assert torch.equal(added, front), output


def test_a_camera_on_a_body_measures_heights(bench):
    depth_EHW = bench.view.camera("top").depth_EHW
    middle = depth_EHW[:, HEIGHT // 2, WIDTH // 2]
    torch.testing.assert_close(middle, torch.full((2,), 1.5 - 0.2), atol=1e-3, rtol=0)
    torch.testing.assert_close(depth_EHW[:, 0, 0], torch.full((2,), 2.0), atol=1e-3, rtol=0)
    # It moves with its body, so both worlds look the same from it.
    assert torch.equal(depth_EHW[0], depth_EHW[1])


def test_the_pictures_are_of_the_present_state_and_stay_as_they_are(bench):
    here_EHW = bench.view.camera("front").segmentation_EHW
    bench.place(qpos=[[-0.4], [0.4]])
    there_EHW = bench.view.camera("front").segmentation_EHW
    columns = [
        np.nonzero(picture.numpy() == 1)[1].mean() for picture in (here_EHW[0], there_EHW[0])
    ]
    assert columns[1] - columns[0] > 3, "world -y is the right of the picture"
    assert torch.equal(here_EHW[1], there_EHW[1])
    bench.place(qpos=[[0.0], [0.4]])
    assert torch.equal(bench.view.camera("front").segmentation_EHW, here_EHW)


def test_what_is_farther_than_the_limit_has_its_depth():
    bench = SensorBench(
        SCENE, 1, {"near": CameraSensor(camera="front", depth=True, rgb=False, max_depth=1.9)}
    )
    depth_EHW = bench.view.camera("near").depth_EHW
    assert depth_EHW.max() == pytest.approx(1.9) and depth_EHW.min() < 1.85
    with pytest.raises(ValueError, match=r"scene\.sensors\.near\.rgb=False: set it to True"):
        _ = bench.view.camera("near").rgb_EHW3


# -- in an env -----------------------------------------------------------------------------------------------------


def image_env(**groups) -> ManagerBasedRlEnv:
    camera = CameraSensor(
        pos=(0.0, 0.0, 1.0), xyaxes=(1.0, 0.0, 0.0, 0.0, 1.0, 0.0), width=16, height=12, depth=True
    )
    cfg = puck_cfg(num_envs=2, limit=None)
    scene = type(cfg.scene)(robots=cfg.scene.robots, sensors={"eye": camera}, num_envs=2)
    state = ObservationTermCfg(term=JointPos())
    observations = {"actor": ObservationGroupCfg(terms={"position": state}), **groups}
    return ManagerBasedRlEnv(
        puck_cfg(num_envs=2, limit=None, scene=scene, observations=observations)
    )


def test_an_image_is_an_observation_of_its_own_shape():
    from torchrl.envs.utils import check_env_specs

    from ksim_rl.envs import MaskedTransformedEnv

    groups = {
        "image": ObservationGroupCfg(
            terms={"rgb": ObservationTermCfg(term=CameraImage(sensor="eye"))}
        ),
        "depth": ObservationGroupCfg(
            terms={"depth": ObservationTermCfg(term=CameraImage(sensor="eye", output="depth"))}
        ),
    }
    base = image_env(**groups)
    env = MaskedTransformedEnv(base)
    for transform in compile_groups(base.cfg.observations):
        env.append_transform(transform)
    check_env_specs(env)
    rollout = env.rollout(4)
    assert rollout["image"].shape == (2, 4, 12, 16, 3) and rollout["image"].dtype == torch.uint8
    assert rollout["depth"].shape == (2, 4, 12, 16) and rollout["depth"].dtype == torch.float32
    assert rollout["actor"].shape == (2, 4, 1)
    assert (
        "observations/image (12, 16, 3)" in base.explain()
        and "observations/actor (1,)" in base.explain()
    )
    # A step that draws makes nothing wait: on CUDA it can be captured.
    root = env.rand_action(env.reset())
    with count_syncs() as syncs:
        env.step_and_maybe_reset(root)
    assert syncs.total == 0, syncs.report()
    # The puck moves to the right (+x) at 1 and 2 m/s, under a camera whose right is x.
    near = rollout["depth"] < 0.99
    middle = [(near[1, k].float() * torch.arange(16.0)).sum() / near[1, k].sum() for k in (0, 3)]
    assert middle[1] > middle[0] + 1
    assert torch.equal(rollout["next", "image"][:, :-1], rollout["image"][:, 1:])


def test_an_image_cannot_share_a_group():
    terms = {
        "rgb": ObservationTermCfg(term=CameraImage(sensor="eye")),
        "position": ObservationTermCfg(term=JointPos()),
    }
    with pytest.raises(
        ValueError, match="'rgb' is an image, which is not concatenated with 'position'"
    ):
        ObservationGroupCfg(terms=terms)


@pytest.mark.parametrize("where", ["group", "term"])
def test_frames_of_an_image_are_stacked_and_never_flattened(where):
    term = {"term": CameraImage(sensor="eye")}
    group = {"history": 2} if where == "group" else {}
    own = {"history": 2} if where == "term" else {}
    with pytest.raises(ValueError, match=r"history would flatten the image 'rgb': .*flat=False"):
        ObservationGroupCfg(terms={"rgb": ObservationTermCfg(**term, **own)}, **group)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"width": 0}, "width=0"),
        ({"fovy": 180.5}, "fovy=180.5"),
        ({"rgb": False}, "draw at least one"),
        ({"geom_groups": (7,)}, r"geom_groups\[0\]=7"),
        ({"max_depth": 0.0}, "max_depth=0.0"),
    ],
)
def test_cameras_out_of_range_are_refused(fields, message):
    with pytest.raises(ValueError, match=message):
        CameraSensor(**fields)


@pytest.mark.parametrize(
    ("sensor", "message"),
    [
        (
            CameraSensor(camera="frond"),
            r"scene\.sensors\.eye: no camera 'frond': did you mean 'front'",
        ),
        (CameraSensor(body="bax"), r"scene\.sensors\.eye: no body 'bax': did you mean 'box'"),
    ],
)
def test_unknown_cameras_and_bodies_are_refused(sensor, message):
    with pytest.raises(ValueError, match=message):
        sensor.add_to(mujoco.MjSpec.from_string(SCENE), "eye")


def test_a_camera_that_may_see_none_of_the_models_geoms_is_refused():
    with pytest.raises(ValueError, match=r"eye\.geom_groups=\(5,\): no geom .*in \[0, 4\]"):
        SensorBench(SCENE, 1, {"eye": CameraSensor(camera="front", geom_groups=(5,))})
