"""Sensors and the NaN guard inside captured steps on the GPU."""

import math

import mujoco
import numpy as np
import pytest
import torch

from ksim_rl.envs import CameraSensor, ContactSensor, ImuSensor
from ksim_rl.physics import Captured, NanGuardCfg, SimCfg
from ksim_rl.physics.nan_guard import failures as nan_file
from tests.gpu.no_syncs import no_syncs
from tests.physics import test_nan_guard as sleds
from tests.scene.sensors.bench import SUBSTEPS, SensorBench

E, STEPS = 8, 12
HEIGHTS = np.linspace(0.01, 0.2, E).tolist()
"""m, of each ball above the plane at the start."""
MAX_DEPTH = 10.0
PICTURES = ("rgb", "depth", "segmentation")
SCENE = """
<mujoco>
  <option timestep="0.002" gravity="0 0 -10"/>
  <worldbody>
    <body name="terrain"><geom name="terrain" type="plane" size="5 5 0.01" rgba="0 1 0 1"/></body>
    <body name="ball" pos="0 0 0.1">
      <joint name="ball" type="slide" axis="0 0 1"/><geom name="ball" size="0.1" mass="2" rgba="1 0 0 1"/>
    </body>
  </worldbody>
</mujoco>
"""
LOOK = {"pos": (-1.0, 0.0, 0.3), "width": 16, "height": 12, "depth": True, "segmentation": True}
SENSORS = {
    "net": ContactSensor(geoms=("ball",), every_substep=True),
    "strongest": ContactSensor(bodies=("ball",), reduce="strongest"),
    "imu": ImuSensor(body="ball"),
    "eye": CameraSensor(**LOOK),
}


def read(bench) -> dict[str, torch.Tensor]:
    view = bench.view
    found = {f"net.{name}": value for name, value in view.contact("net")._asdict().items()}
    readings = ("ang_vel_EL", "lin_acc_EL", "quat_EL", "projected_gravity_EL")
    found |= {f"imu.{name}": getattr(view.imu("imu"), name) for name in readings}
    eye = view.camera("eye")
    pictures = {"rgb": eye.rgb_EHW3, "depth": eye.depth_EHW, "segmentation": eye.segmentation_EHW}
    return found | pictures | {"strongest": view.contact("strongest").force_EN3}


def drop(*, captured: bool) -> tuple[SensorBench, list[dict[str, torch.Tensor]]]:
    """Drop balls from `HEIGHTS`; return the bench, and what the sensors read after each step, on the CPU."""
    bench = SensorBench(SCENE, E, SENSORS, device="cuda")
    bench.place(qpos=torch.tensor(HEIGHTS)[:, None])
    kept = {name: torch.zeros_like(value) for name, value in read(bench).items()}

    def body() -> None:
        bench.step()
        for name, value in read(bench).items():
            kept[name].copy_(value)

    step = Captured(body, device="cuda", warmup=2 if captured else STEPS, require_graphs=True)
    seen = []
    for _ in range(STEPS):
        with no_syncs(on=step.ready):
            step()
        seen.append({name: value.cpu().clone() for name, value in kept.items()})
    assert step.ready == captured
    return bench, seen


def c_engine_drop(model: mujoco.MjModel, height: float) -> list[dict[str, np.ndarray]]:
    """Return what the sensors of one ball should read after each step, by the C engine's contacts and rays."""
    data, seen = mujoco.MjData(model), []
    data.qpos[:] = height
    for _ in range(STEPS):
        forces_S3, found = [], False
        for _ in range(SUBSTEPS):
            mujoco.mj_step(model, data)
            force, found = np.zeros(3), data.ncon > 0
            for number, contact in enumerate(data.contact):
                in_its_frame = np.zeros(6)
                mujoco.mj_contactForce(model, data, number, in_its_frame)
                # It acts on the second geom, the ball.
                force -= contact.frame.reshape(3, 3).T @ in_its_frame[:3]
            forces_S3.append(force)
        acceleration = data.sensor("imu_accelerometer").data.copy()
        mujoco.mj_kinematics(model, data)
        mujoco.mj_camlight(model, data)
        depth_HW, geom_HW = picture(model, data)
        seen.append(
            {
                "net.found_EN": np.array([found]),
                "net.force_EN3": forces_S3[-1][None],
                "net.force_history_ESN3": np.stack(forces_S3)[:, None],
                "strongest": forces_S3[-1][None],
                "imu.lin_acc_EL": acceleration,
                "depth": depth_HW,
                "segmentation": geom_HW,
            }
        )
    return seen


def picture(model: mujoco.MjModel, data: mujoco.MjData) -> tuple[np.ndarray, np.ndarray]:
    """Cast a ray through the middle of each pixel; return depth along the camera's axis, m, and the geom, [H, W]."""
    camera, width, height = model.camera("eye").id, LOOK["width"], LOOK["height"]
    origin, to_world = data.cam_xpos[camera], data.cam_xmat[camera].reshape(3, 3)
    half = math.tan(math.radians(model.cam_fovy[camera]) / 2)
    depth_HW, geom_HW = np.full((height, width), MAX_DEPTH), np.full((height, width), -1)
    for row, column in np.ndindex(height, width):
        x, y = (
            half * (2 * (column + 0.5) - width) / height,
            half * (height - 2 * (row + 0.5)) / height,
        )
        along, geom = np.array([x, y, -1.0]), np.full(1, -1, dtype=np.int32)
        distance = mujoco.mj_ray(model, data, origin, to_world @ along, None, 1, -1, geom)
        if geom[0] >= 0:
            depth_HW[row, column], geom_HW[row, column] = min(distance, MAX_DEPTH), geom[0]
    return depth_HW, geom_HW


@pytest.mark.gpu
def test_all_sensors_captured_read_what_the_c_engine_says():
    bench, seen = drop(captured=True)
    model = bench.world.mj_model
    expected = [c_engine_drop(model, height) for height in HEIGHTS]
    for n, actual in enumerate(seen):
        for name in expected[0][n]:
            values = np.stack([worlds[n][name] for worlds in expected])
            if name in PICTURES:  # a pixel on an edge may fall to either side
                agrees = np.abs(actual[name].numpy() - values) < 0.02
                assert agrees.mean() > 0.97, f"{n} {name}"
            else:
                np.testing.assert_allclose(
                    actual[name], values, rtol=1e-2, atol=0.05, err_msg=f"{n} {name}"
                )
        strongest_color = actual["rgb"].argmax(-1)
        for name, color in (("ball", 0), ("terrain", 1)):
            shown = actual["segmentation"] == model.geom(name).id
            assert shown.any() and (strongest_color[shown] == color).all(), f"{n} {name}"
    touches = [bool(actual["net.found_EN"].any()) for actual in seen]
    assert not touches[0] and touches[-1], "the balls fly, then land"


@pytest.mark.gpu
def test_all_sensors_captured_read_what_eager_ones_read():
    for n, (actual, expected) in enumerate(
        zip(drop(captured=True)[1], drop(captured=False)[1], strict=True)
    ):
        for name, value in expected.items():
            if name in PICTURES:
                same = (actual[name].float() - value.float()).abs() <= (
                    3 if name == "rgb" else 0.01
                )
                assert same.float().mean() > 0.97, f"{n} {name}"
            else:
                torch.testing.assert_close(
                    actual[name], value, rtol=1e-2, atol=0.05, msg=f"{n} {name}"
                )


@pytest.mark.gpu
def test_the_nan_guard_records_inside_a_captured_step_without_a_sync(tmp_path):
    guard = NanGuardCfg(folder=str(tmp_path), history=5)
    bench = SensorBench(sleds.SLEDS, E, {}, device="cuda", sim=SimCfg(nan_guard=guard))
    world = bench.world
    world.ctrl_EL[:, sleds.HEAVY] = 1.0
    step = Captured(
        lambda: world.step(sleds.SUBSTEPS), device="cuda", warmup=2, require_graphs=True
    )
    for n in range(6):
        if n == 5:
            world.ctrl_EL[3, sleds.LIGHT] = 1e9
        with no_syncs(on=step.ready):
            step()
    assert step.ready
    report = world.nan_report()
    assert report.worlds == (3,)
    failure = nan_file.read(report.files[0])
    assert (
        failure.substep == 5 * sleds.SUBSTEPS + 1 and failure.states["ctrl"][-1, sleds.LIGHT] == 1e9
    )
