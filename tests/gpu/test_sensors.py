"""Sensors and the NaN guard inside captured steps on the GPU, against themselves on the CPU."""

import pytest
import torch

from ksim_rl.envs import CameraSensor, ContactSensor, ImuSensor
from ksim_rl.physics import Captured, NanGuardCfg, SimCfg, nan_file
from tests.envs.sensors.bench import SensorBench
from tests.physics.test_nan_guard import HEAVY, LIGHT, SLEDS, SUBSTEPS

E, STEPS = 8, 12
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
    found |= {f"imu.{name}": value for name, value in view.imu("imu")._asdict().items()}
    eye = view.camera("eye")
    pictures = {"rgb": eye.rgb_EHW3, "depth": eye.depth_EHW, "segmentation": eye.segmentation_EHW}
    return found | pictures | {"strongest": view.contact("strongest").force_EN3}


def drop(device: str) -> list[dict[str, torch.Tensor]]:
    """Drop balls from several heights, and return what the sensors read after each step, on the CPU."""
    bench = SensorBench(SCENE, E, SENSORS, device=device)
    bench.place(qpos=torch.linspace(0.0, 0.2, E)[:, None])
    kept = {name: torch.zeros_like(value) for name, value in read(bench).items()}

    def body() -> None:
        bench.step()
        for name, value in read(bench).items():
            kept[name].copy_(value)

    step = Captured(body, device=device, warmup=2)
    seen = []
    for _ in range(STEPS):
        if device == "cuda":
            torch.cuda.synchronize()
            torch.cuda.set_sync_debug_mode("error" if step.ready else "default")
        try:
            step()
        finally:
            if device == "cuda":
                torch.cuda.set_sync_debug_mode("default")
        seen.append({name: value.cpu().clone() for name, value in kept.items()})
    return seen


@pytest.mark.gpu
def test_all_sensors_captured_read_what_they_read_on_the_cpu():
    for n, (actual, expected) in enumerate(zip(drop("cuda"), drop("cpu"), strict=True)):
        for name, value in expected.items():
            if name in ("rgb", "segmentation"):  # a pixel on an edge may fall to either side
                same = (actual[name].int() - value.int()).abs() <= 3
                assert same.float().mean() > 0.97, f"{n} {name}"
            elif name == "depth":
                assert ((actual[name] - value).abs() < 0.01).float().mean() > 0.97, f"{n} {name}"
            else:
                torch.testing.assert_close(actual[name], value, rtol=1e-2, atol=0.05, msg=f"{n} {name}")


@pytest.mark.gpu
def test_the_nan_guard_records_inside_a_captured_step_without_a_sync(tmp_path):
    guard = NanGuardCfg(folder=str(tmp_path), history=5)
    bench = SensorBench(SLEDS, E, {}, device="cuda", sim=SimCfg(nan_guard=guard))
    world = bench.world
    world.ctrl_EL[:, HEAVY] = 1.0
    step = Captured(lambda: world.step(SUBSTEPS), device="cuda", warmup=2, require_graphs=True)
    for n in range(6):
        if n == 5:
            world.ctrl_EL[3, LIGHT] = 1e9
        torch.cuda.synchronize()
        torch.cuda.set_sync_debug_mode("error" if step.ready else "default")
        try:
            step()
        finally:
            torch.cuda.set_sync_debug_mode("default")
    assert step.ready
    report = world.nan_report()
    assert report.worlds == (3,)
    failure = nan_file.read(report.files[0])
    assert failure.substep == 5 * SUBSTEPS + 1 and failure.states["ctrl"][-1, LIGHT] == 1e9
