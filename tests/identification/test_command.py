"""`ksim-rl identify` as a user runs it: a plan, a log, a file of numbers, and words for a training."""

import json

import numpy as np
import pytest

from ksim_rl.cli.main import main
from tests.identification import hidden

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


REFUSED = {
    "neither": ((), "give either the LOG"),
    "both": (("log.csv", "--propose", "quadruped"), "give either the LOG"),
    "no robot": (("log.csv",), "--robot: which robot"),
    "kind": (("--propose", "quadruped", "--targets", "pos,speed"), "--targets='speed'"),
    "base": (
        ("--propose", "quadruped", "--base", "1,0,0"),
        "--base 1,0,0: expected a unit quaternion",
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
