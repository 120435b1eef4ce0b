"""Exported folders of strangers are refused in one line, and what an export writes is what its runner takes."""

import contextlib
import importlib
import io
import runpy
import shutil
import subprocess
import sys

import mujoco
import numpy as np
import pytest

pytest.importorskip("onnxruntime", reason="needs the extra: pip install ksim_rl[export]")
pytest.importorskip("onnx", reason="needs the extra: pip install ksim_rl[export]")

from ksim_rl.export.standalone.models import CHOICE, FIELDS, check_record
from ksim_rl.physics.upstream import per_world_fields
from tests.export.strange_folders import STRANGE, said_of
from tests.export.test_sim2sim import exported

GROUNDS = """
<mujoco>
  <asset>
    <hfield name="a" nrow="2" ncol="2" size="1 1 1 1"/>
    <hfield name="b" nrow="2" ncol="2" size="1 1 1 1"/>
  </asset>
  <worldbody>
    <geom type="hfield" hfield="a"/>
    <body>
      <joint name="slide" type="slide"/>
      <geom size="1"/>
    </body>
  </worldbody>
</mujoco>
"""
META = {"joints": {"names": ["slide"]}, "commands": {}}


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    return exported("cartpole_balance", tmp_path_factory.mktemp("cartpole") / "export")


def run_here(words, *, environment=None):
    """Run a program as `run_python` does, but in this process, which has imported what it needs."""
    assert words[0] == "-I" and environment is None
    printed, complaints, code = io.StringIO(), io.StringIO(), 0
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", list(words[1:]))
        with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(complaints):
            try:
                runpy.run_path(words[1], run_name="__main__")
            except SystemExit as ended:
                code = ended.code
    return subprocess.CompletedProcess(words, code, printed.getvalue(), complaints.getvalue())


# All of them are told by a process of their own in full runs, and in `make test` each eighth.
BY_PROCESS = [
    pytest.param(name, True, marks=[] if number % 8 == 0 else [pytest.mark.full])
    for number, name in enumerate(STRANGE)
]


@pytest.mark.parametrize(
    ("name", "by_process"), [*((name, False) for name in STRANGE), *BY_PROCESS]
)
def test_a_strange_folder_is_refused_in_one_line(whole, name, by_process, tmp_path, monkeypatch):
    if not by_process:
        # By its path: the package gives out a function of this name.
        module = importlib.import_module("ksim_rl.export.sim2sim")
        monkeypatch.setattr(module, "run_python", run_here)
    folder = tmp_path / name
    shutil.copytree(whole, folder)
    STRANGE[name](folder)
    code, said = said_of(folder)
    assert code == 2
    assert said.startswith("ksim-rl: error: ") and said.count("\n") == 1
    assert name in said


def test_fields_that_an_export_may_write_are_numbers_that_differ_between_worlds():
    model = mujoco.MjModel.from_xml_string("<mujoco/>")
    floats = {name for name in per_world_fields() if getattr(model, name).dtype.kind == "f"}
    when = {
        "actuator_delay",
        "sensor_delay",
        "sensor_interval",
    }  # they say where in a memory C looks
    assert floats - when == FIELDS


def record(**fields):
    """A record of two episodes of `GROUNDS` that writes fields of the model."""
    own = {
        "start/qpos": np.zeros((2, 1)),
        "start/qvel": np.zeros((2, 1)),
        "pushes": np.zeros((0, 3)),
    }
    return own | {f"start/model/{name}": np.array([value, value]) for name, value in fields.items()}


@pytest.mark.parametrize("chosen", [[1, -1], [0, -1]])
def test_another_height_field_of_the_model_may_be_chosen(tmp_path, chosen):
    model = mujoco.MjModel.from_xml_string(GROUNDS)
    assert check_record(tmp_path, record(**{CHOICE: np.array(chosen, np.int32)}), META, model) == 2


@pytest.mark.parametrize("chosen", [[2, -1], [-1, -1], [0, 0], [0.0, -1.0]])
def test_none_that_the_model_does_not_have(tmp_path, chosen):
    model = mujoco.MjModel.from_xml_string(GROUNDS)
    value = np.array(chosen, np.float64 if isinstance(chosen[0], float) else np.int32)
    with pytest.raises(ValueError, match="names what geom . of the model cannot be"):
        check_record(tmp_path, record(**{CHOICE: value}), META, model)
