import os
from pathlib import Path

import mujoco
import numpy as np
import pytest

from benchmarks.agreement_models import CARTPOLE, QUADRUPED
from ksim_rl.physics import SimCfg, load_model, load_spec
from tests.physics.malformed_models import MALFORMED

needs_menagerie = pytest.mark.skipif(
    "MENAGERIE_ROOT" not in os.environ, reason="MENAGERIE_ROOT names no folder of robots"
)


def test_path_string_text_and_spec_give_the_same_model(tmp_path: Path):
    path = tmp_path / "cartpole.xml"
    path.write_text(CARTPOLE)
    sources = (path, str(path), CARTPOLE, mujoco.MjSpec.from_string(CARTPOLE))
    for mj_model in map(load_model, sources):
        assert mj_model.nq == 2
        assert mj_model.opt.timestep == 0.01
        assert mj_model.body("pole").mass == pytest.approx(0.1)


def test_a_loaded_spec_can_be_edited_and_the_given_one_is_not_changed():
    spec = mujoco.MjSpec.from_string(CARTPOLE)
    edited = load_spec(spec)
    edited.joint("hinge").armature = 0.5
    assert load_model(edited).dof_armature.tolist() == [0.0, 0.5]
    assert load_model(spec).dof_armature.tolist() == [0.0, 0.0]


@pytest.mark.parametrize("fault", MALFORMED)
def test_malformed_model_is_refused_by_name(fault: str, tmp_path: Path):
    xml, must_name = MALFORMED[fault]
    path = tmp_path / "robot_of_mine.xml"
    path.write_text(xml)
    with pytest.raises(ValueError) as caught:
        load_model(path)
    message = str(caught.value)
    assert str(path) in message
    assert "\n" not in message
    for words in must_name:
        assert words.lower() in message.lower()


@pytest.mark.parametrize(
    ("source", "words"),
    [
        ("", "empty string"),
        ("   \n", "empty string"),
        ("robots/nothing_here.xml", "no such file"),
        (Path("nothing_here.xml"), "no such file"),
        (3, "is int: expected a path"),
        (None, "is NoneType"),
    ],
)
def test_sources_that_are_none(source, words):
    with pytest.raises(ValueError, match=words):
        load_model(source)


def test_files_that_are_none(tmp_path: Path):
    for name, content, words in (
        ("empty.xml", b"", "is empty"),
        ("binary.xml", b"\xff\xfe<mujoco/>", "is not utf-16 text"),
        (
            "latin.xml",
            "<!-- b\xe4r --><mujoco/>".encode("latin-1"),
            "is not UTF-8 text: byte 6; save it as",
        ),
        (
            "klingon.xml",
            b'<?xml version="1.0" encoding="klingon"?><mujoco/>',
            "'klingon' is not known",
        ),
        ("model.mjb", b"\x00\x01", "ends in .xml"),
    ):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(ValueError, match=words):
            load_model(tmp_path / name)
    with pytest.raises(ValueError, match="is a folder"):
        load_model(tmp_path)


def test_a_fault_in_an_included_file_names_both(tmp_path: Path):
    (tmp_path / "leg.xml").write_text(
        '<mujocoinclude>\n  <geom name="g" type="spher"/>\n</mujocoinclude>'
    )
    main = tmp_path / "robot.xml"
    main.write_text(
        '<mujoco>\n  <worldbody>\n    <include file="leg.xml"/>\n  </worldbody>\n</mujoco>'
    )
    with pytest.raises(ValueError, match=r"robot\.xml: .*'spher'"):
        load_model(main)


def test_a_broken_spec_is_refused():
    spec = mujoco.MjSpec()
    spec.modelname = "my_robot"
    spec.worldbody.add_body(name="link").add_freejoint()
    with pytest.raises(ValueError, match="my_robot.*mass.*'link'"):
        load_model(spec)


def test_nothing_is_written_beside_the_program(tmp_path: Path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError):
        load_model(MALFORMED["timestep nan"][0])
    load_model(QUADRUPED)
    assert list(tmp_path.iterdir()) == []
    assert "NaN" not in capfd.readouterr().err


def test_menagerie_root_serves_robots_offline(tmp_path: Path, monkeypatch):
    monkeypatch.setenv("MENAGERIE_ROOT", str(tmp_path))
    (tmp_path / "toy_robot").mkdir()
    (tmp_path / "toy_robot" / "scene.xml").write_text(CARTPOLE)
    (tmp_path / "toy_robot" / "alone.xml").write_text(QUADRUPED)
    assert load_model("toy_robot").nq == 2
    assert load_model("toy_robot/alone").nq == 15
    with pytest.raises(
        ValueError, match=r"'toy_robto' is not under MENAGERIE_ROOT.*did you mean 'toy_robot'"
    ):
        load_model("toy_robto")
    with pytest.raises(ValueError, match="no entry point 'alon': did you mean 'alone'"):
        load_model("toy_robot/alon")


def test_an_unknown_robot_without_a_folder_is_one_line(monkeypatch):
    monkeypatch.delenv("MENAGERIE_ROOT", raising=False)
    pytest.importorskip("mujoco_menagerie")
    with pytest.raises(ValueError, match="unitree_go1") as caught:
        load_model("unitree_go11")
    assert "\n" not in str(caught.value)


def test_without_a_network_one_line_says_what_to_do(tmp_path: Path, monkeypatch):
    pytest.importorskip("mujoco_menagerie")
    monkeypatch.delenv("MENAGERIE_ROOT", raising=False)
    monkeypatch.setenv("MENAGERIE_CACHE_DIR", str(tmp_path))
    monkeypatch.setenv("MENAGERIE_BASE_URL", "http://127.0.0.1:9/nothing")
    monkeypatch.setattr("time.sleep", lambda seconds: None)
    with pytest.raises(
        ValueError, match="could not be downloaded.*without one, copy.*MENAGERIE_ROOT"
    ) as caught:
        load_model("unitree_go1")
    assert "\n" not in str(caught.value)


@needs_menagerie
@pytest.mark.parametrize("name", ["unitree_go1", "unitree_g1"])
def test_menagerie_robots_load(name: str):
    mj_model = load_model(name)
    assert mj_model.nkey >= 1
    assert np.isfinite(mj_model.qpos0).all()


def test_a_solver_that_warp_lacks_is_refused_with_the_override_that_makes_it_run():
    gymnasium = pytest.importorskip("gymnasium")
    path = Path(gymnasium.__file__).parent / "envs/mujoco/assets/humanoid.xml"
    with pytest.raises(
        ValueError, match=r"mjSOL_PGS.*sim=SimCfg\(solver='newton'\).*task\.sim\.solver=newton"
    ):
        load_model(path)
    mj_model = load_model(path, sim=SimCfg(solver="newton"))
    assert mj_model.opt.solver == mujoco.mjtSolver.mjSOL_NEWTON


ONE_BODY = """
<mujoco>
  <worldbody>
    <site name="base"/>
    <body pos="0 0 1"><joint name="hinge"/><geom size=".1"/><site name="near" pos=".1 0 0"/>
      <body><geom size=".1"/><site name="far" pos=".3 0 0"/></body>
    </body>
  </worldbody>
  <tendon>
    <spatial name="still" {still}><site site="near"/><site site="far"/></spatial>
    <spatial name="other" limited="true" range="0 .1"><site site="base"/><site site="far"/></spatial>
  </tendon>
  <equality>{equality}</equality>
</mujoco>
"""


@pytest.mark.parametrize(
    ("still", "equality", "words"),
    [
        ('frictionloss="1"', "", "it has a frictionloss"),
        ('limited="true" range="0 .1"', "", "its length, 0.2, violates its range"),
        ('limited="true" range="0 .25" margin=".1"', "", "its length, 0.2, violates its range"),
        ("", '<tendon tendon1="still"/>', "an equality holds it"),
    ],
)
def test_constraints_of_tendons_that_no_joint_moves_are_refused(
    still: str, equality: str, words: str
):
    """Of a tendon on one rigid body C finds accelerations by chance, and worlds had some of 1e16."""
    with pytest.raises(ValueError, match=f"tendon 'still' lies on one rigid body, but {words}"):
        load_model(ONE_BODY.format(still=still, equality=equality))


def test_tendons_that_no_joint_moves_may_be_there():
    tie = '<tendon tendon1="still" tendon2="other"/>'
    load_model(ONE_BODY.format(still='limited="true" range="0 .3" stiffness="3"', equality=tie))
