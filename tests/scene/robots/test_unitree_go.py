import mujoco
import pytest

from ksim_rl.scene.robots.unitree_go import UnitreeGo1
from ksim_rl.scene.scene import SceneCfg, build_spec
from ksim_rl.scene.terrains import PlaneTerrain
from tests.scene.robots.reference import loaded_spec


@pytest.fixture(scope="module")
def model():
    loaded_spec(UnitreeGo1())
    return build_spec(SceneCfg(robots={"robot": UnitreeGo1()}, terrain=PlaneTerrain())).compile()


def test_stance_stands_on_all_four_feet(model):
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_kinematics(model, data)
    lowest = [data.geom(name).xpos[2] - model.geom(name).size[0] for name in UnitreeGo1.foot_geoms]
    assert max(lowest) - min(lowest) < 1e-6
    assert abs(lowest[0]) < 0.02
    for _ in range(int(2.0 / model.opt.timestep)):
        mujoco.mj_step(model, data)
    # The servos are soft: under its weight the robot sags and leans a little.
    assert data.body("trunk").xmat[8] > 0.95
    assert 0.2 < data.qpos[2] < 0.32


def test_spec_is_fresh_each_time():
    first = loaded_spec(UnitreeGo1())
    first.delete(first.site("imu"))
    assert loaded_spec(UnitreeGo1()).site("imu") is not None
