"""`ksim-rl identify` as a user runs it: a plan, a log, a file of numbers, and words for a training."""

import json

import numpy as np
import pytest

from ksim_rl.cli.main import main
from tests.identification import hidden, hidden_motor

pytest.importorskip("tabulate", reason="needs the extra: pip install ksim_rl[identify]")


def run(capsys, *words):
    with pytest.raises(SystemExit) as stopped:
        main(["identify", *map(str, words)])
    return stopped.value.code, capsys.readouterr()


@pytest.mark.full
def test_from_a_plan_to_numbers(tmp_path, capsys):
    robot, plan, log = tmp_path / "leg.xml", tmp_path / "plan.csv", tmp_path / "log.csv"
    robot.write_text(hidden.MODEL)
    code, output = run(capsys, "--propose", robot, "--seconds", 6, "--seed", 4, "--output", plan)
    assert code == 0 and "6.0 s at 500 Hz for 2 joints" in output.out
    header, *lines = plan.read_text().splitlines()
    assert header == "time,hip.target_position,knee.target_position"
    table = np.loadtxt(lines, delimiter=",")
    secret = hidden.Secret()
    pos_TN = hidden.follow(secret, table[:, 0], {"pos": table[:, 1:]})
    log.write_text(hidden.log_text(table[:, 0], {"pos": table[:, 1:]}, pos_TN))
    code, output = run(capsys, log, "--robot", robot)
    assert code == 0, output
    assert "no velocities were commanded (hip, knee)" in output.out
    found = json.loads((tmp_path / "log_found.json").read_text())
    assert found["joints"]["knee"]["armature"]["value"] == pytest.approx(
        secret.armature[1], rel=0.05
    )
    assert found["joints"]["knee"]["torque_constant"]["value"] is None
    assert found["delay_s"]["value"] == pytest.approx(secret.delay_s, abs=1e-3)


@pytest.mark.full
def test_from_a_log_to_networks(tmp_path, capsys):
    robot, log, folder = tmp_path / "leg.xml", tmp_path / "log.csv", tmp_path / "nets"
    robot.write_text(hidden.MODEL)
    time_T, asked_TN = hidden_motor.commands(12.0)
    # Smaller, so that the log stays in the ranges of the joints.
    asked_TN = asked_TN[0] + 0.4 * (asked_TN - asked_TN[0])
    pos_TN, effort_TN = hidden_motor.follow(hidden_motor.SecretMotor(), time_T, asked_TN)
    text = hidden.log_text(time_T, {"pos": asked_TN}, pos_TN)
    header, *lines = text.splitlines()
    rows = [f"{header},hip.effort,knee.effort"]
    for line, (hip, knee) in zip(lines, effort_TN, strict=True):
        rows.append(f"{line},{hip:.6g},{knee:.6g}")
    log.write_text("\n".join(rows))
    code, output = run(capsys, log, "--robot", robot, "--nets", folder, "--timestep", 0.004)
    assert code == 0 and "motors_0.safetensors: off by" in output.out
    assert [path.name for path in folder.iterdir()] == ["motors_0.safetensors"]


REFUSED = {
    "neither": ((), "give either the LOG"),
    "both": (("log.csv", "--propose", "quadruped"), "give either the LOG"),
    "no robot": (("log.csv",), "--robot: which robot"),
    "kind": (("--propose", "quadruped", "--targets", "pos,speed"), "--targets='speed'"),
    "base": (
        ("--propose", "quadruped", "--base", "1,0,0"),
        "--base 1,0,0: expected a unit quaternion",
    ),
    "nets without steps": (
        ("log.csv", "--robot", "quadruped", "--nets", "nets"),
        "--nets: in which physics steps",
    ),
    "steps without nets": (
        ("log.csv", "--robot", "quadruped", "--timestep", "0.005"),
        "--timestep: it is of networks",
    ),
    "steps twice": (
        [
            "log.csv",
            "--robot",
            "go2",
            "--nets",
            "nets",
            "--timestep",
            "0.005",
            "--task",
            "go2_velocity_flat",
        ],
        "--timestep: --task says it",
    ),
    "a blank in a path": (
        [
            "log.csv",
            "--robot",
            "quadruped",
            "--nets",
            "my nets",
            "--task",
            "quadruped_velocity_flat",
        ],
        "my nets' cannot stand in words of a shell",
    ),
    "seconds": (("--propose", "quadruped", "--seconds", "1"), "--seconds=1.0"),
    "task of a proposal": (
        ("--propose", "quadruped", "--task", "go2_velocity_flat"),
        "--task: it is of logs",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_wrong_words_are_one_line(tmp_path, monkeypatch, capsys, case):
    monkeypatch.chdir(tmp_path)
    words, said = REFUSED[case]
    code, output = run(capsys, *words)
    assert code == 2 and said in output.err and output.err.count("\n") == 1
