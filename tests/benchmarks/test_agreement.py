import json
import os

import numpy as np
import pytest
import torch

from benchmarks import agreement, report
from benchmarks.agreement_errors import compare, errors
from ksim_rl.physics import load_model

CPU = torch.device("cpu")


def case(name: str) -> agreement.Case:
    return next(case for case in agreement.CASES if case.name == name)


def check(name: str, num_worlds: int) -> agreement.Agreement:
    found = agreement.measure(case(name), num_worlds=num_worlds, device=CPU)
    for quantity, values in found.errors.items():
        judged = case(name).start != "thrown" or quantity == "qpos"
        assert not judged or agreement.agrees(case(name), values), f"{name}: {quantity}: {values}"
    assert agreement.agrees(case(name), found.errors_as_trained["qpos"]), (
        f"{name}: {found.errors_as_trained}"
    )
    return found


@pytest.mark.parametrize(
    "name",
    [
        "double_pendulum",
        pytest.param("cartpole", marks=pytest.mark.full),
        pytest.param("spinning_body", marks=pytest.mark.full),
    ],
)
def test_smooth_models_agree_after_100_substeps(name):
    found = check(name, num_worlds=8)
    assert {"qpos", "qvel", "xpos", "sensordata"} <= found.errors.keys()
    assert case(name).substeps == 100


def test_a_robot_in_contact_agrees_after_20_substeps():
    found = check("quadruped", num_worlds=64)
    assert case("quadruped").substeps == 20
    assert found.errors["contact_force"].worlds >= 32
    assert found.errors["contact_force"].scale > 5.0
    assert found.errors.keys() == {
        "qpos",
        "qvel",
        "xpos",
        "sensordata",
        "actuator_force",
        "qfrc_constraint",
        "contact_force",
    }


@pytest.mark.full
@pytest.mark.skipif(
    "MENAGERIE_ROOT" not in os.environ, reason="MENAGERIE_ROOT names no folder of robots"
)
@pytest.mark.parametrize(
    "name", [case.name for case in agreement.CASES if case.start != "anywhere"]
)
def test_robots_agree_as_they_train(name):
    check(name, num_worlds=64)


def test_what_is_committed_is_within_the_limits_for_every_robot():
    figures = json.loads((report.RESULTS / "agreement.json").read_text())["figures"]
    measured = {name.split("/")[0] for name in figures if "/as_trained/" in name}
    assert "cpu" in measured
    for device in measured:
        for each in agreement.CASES:
            figure = f"{device}/{each.name}/qpos/as_trained"
            if device != "cpu" and f"{figure}/median" not in figures:
                continue  # time on a GPU is short: what was measured there counts
            assert figures[f"{figure}/share_within_1e_3"] >= 0.95, figure
            assert figures[f"{figure}/share_within_1e_2"] >= 0.99, figure
            assert figures[f"{figure}/median"] <= 1e-5, figure


def test_any_file_is_a_model(tmp_path, monkeypatch):
    monkeypatch.delenv("MENAGERIE_ROOT", raising=False)
    path = tmp_path / "ball.xml"
    path.write_text(
        "<mujoco><worldbody><body><freejoint/><geom size='0.1'/></body></worldbody></mujoco>"
    )
    (chosen,) = agreement.chosen_cases([str(path)])
    assert chosen.name == "ball" and chosen.load().nv == 6
    assert chosen.states(chosen.load(), 2).qpos_EL.shape == (2, 7)
    (of_task,) = agreement.chosen_cases(["pendulum_swingup"])
    assert of_task.name == "pendulum_swingup" and of_task.start == "thrown"
    with pytest.raises(ValueError, match="did you mean 'quadruped'"):
        agreement.chosen_cases(["quadrupe"])
    with pytest.raises(ValueError, match="--models unitree_g1: set MENAGERIE_ROOT"):
        agreement.chosen_cases(["unitree_g1"])
    assert "robotis_op3" not in {each.name for each in agreement.chosen_cases(None)}


def test_robots_start_in_motion_and_in_contact():
    quadruped = case("quadruped")
    mj_model = quadruped.load()
    states = quadruped.states(mj_model, 16)
    after = agreement.run_c_engine(mj_model, states, 1)
    assert np.mean(after["ncon"] > 0) > 0.7
    assert np.median(np.abs(states.qvel_EL).max(axis=1)) > 0.5
    assert states.qpos_EL.dtype == np.float32


def test_an_error_is_relative_to_the_scale_of_the_quantity():
    expected = np.array([[2.0, -4.0], [1.0, 0.0], [0.0, 8.0]])
    actual = expected + np.array([[0.0, 0.04], [0.0, 0.0], [0.4, 0.0]])
    found = errors(actual, expected)
    assert found.scale == 4.0
    assert found.max == pytest.approx(0.1)
    assert found.median == pytest.approx(0.01)
    assert found.share_within_1e_3 == pytest.approx(1 / 3)


def test_a_wrong_sensor_is_not_hidden_by_large_ones():
    mj_model = load_model(agreement.CARTPOLE)
    count = {
        name: np.ones((4, 2))
        for name in ("qpos", "qvel", "xpos", "actuator_force", "qfrc_constraint")
    }
    expected = {**count, "sensordata": np.tile([1000.0, 0.01, 1.0, 1.0, 1.0, 1.0], (4, 1))}
    actual = {name: values.copy() for name, values in expected.items()}
    actual["sensordata"][:, 1] *= 1.5
    found = compare(mj_model, actual, expected)
    assert found["sensordata"].median == pytest.approx(0.5)
    assert found["qpos"].max == 0.0
