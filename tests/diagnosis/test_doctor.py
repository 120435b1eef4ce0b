"""`ksim-rl doctor` names what is wrong with a machine, in one line each."""

import getpass
import os

import pytest
import torch

from ksim_rl.cli.main import main
from ksim_rl.device import streams
from ksim_rl.diagnosis import doctor, self_test


@pytest.fixture
def draws(monkeypatch):
    """Let OpenGL be found without a process that tries it."""
    monkeypatch.setattr(doctor, "_look_at_opengl", lambda report: report.say("OpenGL", "egl draws"))


def test_a_machine_without_faults(draws, monkeypatch, tmp_path, capsys):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(tmp_path / "inductor"))
    with pytest.raises(SystemExit) as ended:
        main(["doctor", "--no-test"])
    text = capsys.readouterr().out
    assert ended.value.code == 0, text
    for word in (
        f"torch {torch.__version__.partition('+')[0]}",
        "mujoco-warp",
        "cache of Warp",
        "OpenGL: ",
        "no fault found",
    ):
        assert word in text
    assert f"cache of torch.compile: ~{os.sep}inductor" in text
    assert getpass.getuser() == "root" or getpass.getuser() not in text


def test_a_cache_that_cannot_be_written_is_a_fault(draws, monkeypatch, tmp_path):
    (tmp_path / "file").touch()
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(tmp_path / "file" / "below"))
    (fault,) = doctor.examine(test_devices=False).faults
    assert fault.startswith("cache of torch.compile: ") and "TORCHINDUCTOR_CACHE_DIR" in fault


def test_warp_that_does_not_start_is_a_fault_and_ends_no_report(draws, monkeypatch):
    def refuse():
        raise PermissionError(13, "Permission denied", "/somewhere")

    monkeypatch.setattr(streams.wp, "init", refuse)
    monkeypatch.setattr(doctor, "start_warp", streams.start_warp.__wrapped__)
    report = doctor.examine()
    assert [fault.partition(":")[0] for fault in report.faults] == ["Warp"]
    assert "WARP_CACHE_PATH" in report.faults[0] and "OpenGL" in str(report)


@pytest.mark.parametrize("home", [None, "/proc/nowhere"])
def test_no_home_is_a_fault(draws, monkeypatch, home):
    monkeypatch.delenv("HOME") if home is None else monkeypatch.setenv("HOME", home)
    faults = doctor.examine(test_devices=False).faults
    assert any(fault.startswith("HOME") for fault in faults)


def test_no_opengl_is_a_fault_with_what_to_install(monkeypatch):
    # What another test of this process chose is kept.
    monkeypatch.setattr(
        doctor.rendering, "choose_gl_platform", doctor.rendering.choose_gl_platform.__wrapped__
    )
    monkeypatch.setenv("MUJOCO_GL", "nonsense")
    report = doctor.Report()
    doctor._look_at_opengl(report)
    (fault,) = report.faults
    assert "nonsense" in fault and "libosmesa6" in fault


def test_a_driver_that_torch_does_not_use_is_a_fault(monkeypatch, tmp_path):
    driver = tmp_path / "version"
    driver.write_text("NVRM version: NVIDIA UNIX x86_64 Kernel Module  580.1\n")
    monkeypatch.setattr(doctor, "NVIDIA", driver)
    monkeypatch.setattr(doctor, "_devices", lambda: [torch.device("cpu")])
    report = doctor.Report()
    doctor._look_at_gpus(report)
    assert "finds no GPU" in report.faults[0]


def test_the_test_of_a_device_passes_here():
    assert self_test.try_device(torch.device("cpu")) == [
        ("physics as in C", None),
        ("graphs as eager", None),
        ("an update", None),
    ]


def test_the_test_of_a_device_finds_what_is_broken(monkeypatch):
    monkeypatch.setattr(self_test, "MOST_DIFFERENCE", 0.0)
    monkeypatch.setattr(self_test, "ppo_step", lambda *_, **__: None)
    found = dict(self_test.try_device(torch.device("cpu")))
    assert "C engine" in found["physics as in C"]
    assert found["an update"] == "a gradient step changed nothing"
