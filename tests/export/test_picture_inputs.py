"""Policies that see leave the library with their pictures: as inputs, described, drawn by MuJoCo, and compared."""

import dataclasses
import json
import shutil
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import torch
from tensordict.nn import TensorDictSequential
from torchrl.data import Bounded, Composite, Unbounded

pytest.importorskip("onnxruntime", reason="needs the extra: pip install ksim_rl[export]")
pytest.importorskip("onnx", reason="needs the extra: pip install ksim_rl[export]")

import onnx
from onnx import TensorProto, helper, numpy_helper

from ksim_rl import envs
from ksim_rl.export import policy as policies
from ksim_rl.export.picture_inputs import PictureInput, describe_sight
from ksim_rl.export.policy import Column, ExportedPolicy
from ksim_rl.export.policy_check import greatest_difference
from ksim_rl.export.refusal import NotDescribedError
from ksim_rl.export.standalone.policy_control import PolicyControl
from ksim_rl.export.standalone.sight import Sight
from ksim_rl.export.standalone.simulated_robot import SimulatedRobot
from ksim_rl.modules import ActorCfg, EncoderCfg, make_actor, make_for_spec
from ksim_rl.scene.rendering import rendering
from ksim_rl.scene.sensors import CameraSensor
from ksim_rl.transforms import (
    Brightness,
    DelayCfg,
    ObservationDelay,
    ObservationHistory,
    ObservationHold,
    PictureEffects,
    RandomCrop,
    TransformCfg,
)
from tests.export.loop_bench import Bench, Clock

# -- the network -------------------------------------------------------------------------------------------------

SENSOR = CameraSensor(width=14, height=12, depth=True)


def picture(group, output, **frames):
    return PictureInput(group=group, term="x", camera=group, sensor=SENSOR, output=output, **frames)


def encoder(**fields):
    return EncoderCfg(channels=(4,), kernel_sizes=(4,), strides=(2,), **fields)


@pytest.mark.full
def test_a_network_of_numbers_and_pictures_is_written_with_its_frames(tmp_path):
    pictures = [
        picture("wrist", "rgb", length=3, stride=2, is_stacked=True),
        picture("front", "depth"),
    ]
    spec = Composite(
        actor=Unbounded((5,)),
        wrist=Bounded(0, 255, (3, 12, 14, 3), dtype=torch.uint8),
        front=Bounded(0.0, 10.0, (12, 14)),
    )
    cfg = ActorCfg(
        in_keys=("wrist", "actor", "front"),
        hidden_dims=(16,),
        obs_normalization=False,
        output_gain=1.0,
        encoders={"wrist": encoder(), "front": encoder(spatial_softmax=True)},
    )
    actor = make_for_spec(make_actor, cfg, spec, action_dim=2)
    columns = {"actor": [Column(name="joints", size=3), Column(name="gyro", size=1, length=2)]}
    exported = ExportedPolicy(actor, columns, pictures)
    assert exported.input_names == [
        "obs",
        "picture_wrist",
        "picture_front",
        "history_gyro_in",
        "history_picture_wrist_in",
    ]
    policies.write(exported, tmp_path)
    assert greatest_difference(exported, tmp_path / "policy.onnx") < 1e-5
    state = exported.states[-1]
    assert state.shape == (4, 12, 14, 3) and state.dtype == "uint8" and state.of == "picture_wrist"
    # A file of another network is found out.
    for parameter in actor.parameters():
        parameter.data += 0.05
    assert isinstance(actor, TensorDictSequential)
    assert greatest_difference(exported, tmp_path / "policy.onnx") > 1e-3


# -- what becomes of pictures on their way -----------------------------------------------------------------------

TASK = envs.task("cartpole_balance_pixels")


def task(**transforms):
    cfg = TASK.cfg()
    group = dataclasses.replace(cfg.observations["actor"], history=None)
    return dataclasses.replace(
        cfg, observations={**cfg.observations, "actor": group}, transforms=transforms
    )


KEYS = {"in_keys": ["actor"]}
LOOK = TransformCfg(PictureEffects, **KEYS, effects={"light": Brightness()})
RATE = TransformCfg(ObservationHold, **KEYS, every=4, dropped=0.1)
LAG = TransformCfg(ObservationDelay, **KEYS, delay=DelayCfg(min_lag=1, max_lag=3))
FRAMES = TransformCfg(ObservationHistory, **KEYS, length=3, flat=False)
CROP = TransformCfg(PictureEffects, **KEYS, effects={"crop": RandomCrop(height=32, width=32)})


def test_a_camera_is_described_with_its_rate_its_lag_and_its_frames():
    sight = describe_sight(task(look=LOOK, rate=RATE, lag=LAG, frames=FRAMES), ["actor"])
    (found,) = sight.pictures
    assert sight.training_only == ["look"]
    described = found.described()
    assert described["input"] == "picture_actor" and described["camera"] == "side"
    assert described["shape"] == [64, 64, 3] and described["dtype"] == "uint8"
    assert (described["every"], described["dropped"]) == (4, 0.1)
    assert (described["delay"]["min"], described["delay"]["max"]) == (1, 3)
    assert (described["history_length"], described["history_stride"]) == (3, 1)
    assert found.is_late and found.is_stacked


@pytest.mark.parametrize(
    ("transforms", "keys", "said"),
    [
        ({"crop": CROP}, ["actor"], "task.transforms.crop: PictureEffects makes pictures"),
        ({"frames": FRAMES, "rate": RATE}, ["actor"], "task.transforms.rate: ObservationHold"),
        ({"lag": LAG, "rate": RATE}, ["actor"], "task.transforms.rate: ObservationHold"),
        ({}, ["actor", ("camera", "fresh")], "reads \\('camera', 'fresh'\\), which is none of"),
    ],
)
def test_what_no_camera_gives_is_refused_by_name(transforms, keys, said):
    with pytest.raises(NotDescribedError, match=said):
        describe_sight(task(**transforms), keys)


# -- a robot that sees -------------------------------------------------------------------------------------------

CAMERA = '<camera name="front" pos="1 0 0.4" xyaxes="0 1 0 -0.3 0 1" fovy="45"/>'
SPEC = {
    "input": "picture_eye",
    "group": "eye",
    "camera": "front",
    "output": "rgb",
    "shape": [12, 16, 3],
    "dtype": "uint8",
    "max_depth": 10.0,
    "geom_groups": [0, 1, 2],
    "textures": True,
    "shadows": False,
    "every": 1,
    "dropped": 0.0,
    "delay": None,
    "history_length": 1,
    "history_stride": 1,
}
WEIGHTS = np.random.default_rng(4).normal(0.0, 1e-3, (12 * 16 * 3, 2)).astype(np.float32)


@pytest.fixture
def seeing(folder, tmp_path):
    """The toy, whose policy sees by a camera in front of it, and reads nothing else."""
    return see(folder, tmp_path, SPEC, WEIGHTS)


def see(folder, tmp_path, spec, weights):
    """Write the toy with a policy of one picture, and return its folder and metadata."""
    kind = TensorProto.UINT8 if spec["dtype"] == "uint8" else TensorProto.FLOAT
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    robot = tmp_path / "robot.xml"
    robot.write_text(robot.read_text().replace('<site name="imu"', f'{CAMERA}<site name="imu"'))
    (tmp_path / "obs.onnx").unlink()
    nodes = [
        helper.make_node("Cast", ["picture_eye"], ["light"], to=TensorProto.FLOAT),
        helper.make_node("Flatten", ["light"], ["row"]),
        helper.make_node("MatMul", ["row", "weights"], ["actions"]),
    ]
    seen = helper.make_tensor_value_info("picture_eye", kind, [1, *spec["shape"]])
    actions = helper.make_tensor_value_info("actions", TensorProto.FLOAT, [1, 2])
    graph = helper.make_graph(
        nodes, "eye", [seen], [actions], [numpy_helper.from_array(weights, "weights")]
    )
    opset = [helper.make_opsetid("", 18)]
    onnx.save(
        helper.make_model(graph, opset_imports=opset, ir_version=10), tmp_path / "policy.onnx"
    )
    meta = json.loads((tmp_path / "export.json").read_text())
    meta |= {"obs": None, "observations": [], "pictures": [spec]}
    (tmp_path / "export.json").write_text(json.dumps(meta))
    return tmp_path, meta


def test_a_loop_gives_its_policy_the_pictures_of_a_robot(seeing):
    folder, meta = seeing
    control = PolicyControl(folder, meta)
    blind = Bench(Clock()).read()
    assert control.lacking(blind) == ["picture_eye"]
    eye = np.random.default_rng(2).integers(0, 256, (12, 16, 3), np.uint8)
    control(dataclasses.replace(blind, pictures={"picture_eye": eye}))
    # The first filter of the chain begins with the action itself.
    expected = np.clip(eye.astype(np.float32).ravel() @ WEIGHTS, -3.0, 3.0)
    assert control.action == pytest.approx(expected, abs=1e-4)
    for wrong in (eye[:, ::-1][:6], eye.astype(np.float32)):
        with pytest.raises(ValueError, match=r"picture_eye is .*: expected uint8 \[12, 16, 3\]"):
            control(dataclasses.replace(blind, pictures={"picture_eye": wrong}))


def test_what_is_farther_than_in_training_is_read_as_the_farthest(folder, tmp_path):
    spec = {**SPEC, "output": "depth", "shape": [12, 16], "dtype": "float32", "max_depth": 4.0}
    weights = WEIGHTS[: 12 * 16]
    control = PolicyControl(*see(folder, tmp_path, spec, weights))
    depth = np.random.default_rng(2).uniform(0.1, 60.0, (12, 16)).astype(np.float32)
    blind = Bench(Clock()).read()
    control(dataclasses.replace(blind, pictures={"picture_eye": depth}))
    expected = np.minimum(depth, 4.0).ravel() @ weights
    assert control.action == pytest.approx(expected, abs=1e-4)
    depth[3, 4] = np.inf
    with pytest.raises(ValueError, match="picture_eye holds numbers that are not finite"):
        control(dataclasses.replace(blind, pictures={"picture_eye": depth}))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            {"shape": [16, 12, 3]},
            r"picture_eye is uint8 \[12, 16, 3\]: export.json has uint8 \[16,",
        ),
        ({"dtype": "float32"}, "picture_eye is uint8 .*: export.json has float32"),
        ({"input": "picture_ear"}, "no input 'picture_ear'"),
    ],
)
def test_pictures_that_the_network_does_not_read_are_refused(seeing, change, said):
    folder, meta = seeing
    meta["pictures"] = [{**SPEC, **change}]
    with pytest.raises(ValueError, match=said):
        PolicyControl(folder, meta)


@pytest.fixture(scope="module")
def gl():
    try:
        rendering.choose_gl_platform()
        mujoco.Renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 12, 16).close()
    except Exception as error:
        pytest.skip(f"no OpenGL here: {error}")


def test_a_simulated_robot_sees_by_mujocos_renderer(seeing, gl):
    folder, _ = seeing
    robot = SimulatedRobot(folder, ())
    robot.data.qpos[7:] = (0.8, -0.6)
    robot.runner.refresh()
    found = robot.read().pictures["picture_eye"]
    model = robot.model
    renderer = mujoco.Renderer(model, 12, 16)
    renderer.update_scene(robot.data, "front")
    expected = renderer.render()
    renderer.close()
    assert found.dtype == np.uint8 and found.shape == (12, 16, 3)
    # Reflections and shadows apart, which this scene has none of.
    assert (np.abs(found.astype(int) - expected) > 8).mean() < 0.05
    assert found.std() > 5.0
    camera = robot.runner.sight.cameras["picture_eye"]
    assert camera.share_off(found) == 0.0 and camera.share_off(255 - found) > 0.9


class Counting:
    """A camera whose picture is how often it was drawn."""

    def __init__(self, spec):
        self.spec = spec
        self.count = 0

    def drawn(self):
        self.count += 1
        return np.full((2, 2), self.count)


@pytest.mark.parametrize(
    ("every", "dropped", "share"), [(1, 0.0, 1.0), (4, 0.0, 0.25), (2, 0.5, 0.25)]
)
def test_a_slow_camera_that_loses_pictures_shows_its_last_one(every, dropped, share):
    sight = Sight(SimpleNamespace(meta={}, draws=np.random.default_rng(1)))
    camera = Counting({"every": every, "dropped": dropped})
    sight.cameras["eye"] = camera
    seen = []
    for _ in range(20):
        sight.reset()
        before = camera.count
        seen.append([int(sight(advances=step > 0)["eye"][0, 0]) - before for step in range(101)])
    seen = np.array(seen)
    assert (seen[:, 0] == 1).all() and (np.diff(seen, axis=1) >= 0).all()
    assert (np.diff(seen, axis=1) > 0).mean() == pytest.approx(share, abs=0.03)
    if not dropped:
        # The first one behind a reset is due after 1 to `every` steps.
        assert sorted({int(np.argmax(row > 1)) for row in seen}) == list(range(1, every + 1))


@pytest.mark.parametrize(
    "change",
    [
        {"camera": "rear"},
        {"shape": [12, 16]},
        {"shape": [10**7, 16, 3]},
        {"dtype": "float32"},
        {"output": "heat"},
    ],
)
def test_a_picture_that_is_none_is_refused(seeing, change):
    folder, meta = seeing
    meta["pictures"] = [{**SPEC, **change}]
    (folder / "export.json").write_text(json.dumps(meta))
    with pytest.raises(ValueError, match=r"export\.json"):
        SimulatedRobot(folder, ())
