"""Strangers' files are read as their authors meant them, whatever they are called and however they are encoded."""

from pathlib import Path

import mujoco
import numpy as np
import pytest

from ksim_rl.physics import load_model, load_spec
from ksim_rl.physics.model_files.source import SUFFIXES

NAMED = (
    '<mujoco><worldbody><body name="bär"><freejoint/><geom size="0.1"/></body></worldbody></mujoco>'
)
TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
INERTIA = '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
URDF = f"""<?xml version="1.0"?>
<robot name="lamp">
  <link name="base"><inertial><mass value="2"/>{INERTIA}</inertial>
    <collision><geometry><mesh filename="MESH"/></geometry></collision></link>
  <link name="arm"><inertial><mass value="1.0"/>{INERTIA}</inertial>
    <collision><geometry><box size="0.1 0.1 0.1"/></geometry></collision></link>
  <link name="head"><inertial><mass value="1"/>{INERTIA}</inertial></link>
  <joint name="hinge" type="continuous"><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/></joint>
  <joint name="neck" type="fixed"><parent link="arm"/><child link="head"/><origin xyz="0 0 1"/></joint>
</robot>"""


@pytest.mark.parametrize("suffix", [*SUFFIXES, *(suffix.upper() for suffix in SUFFIXES), ".Xml"])
def test_every_suffix_that_is_listed_loads(tmp_path: Path, suffix: str):
    path = tmp_path / f"model{suffix}"
    path.write_text(NAMED)
    assert load_model(path).body(1).name == "bär"


@pytest.mark.parametrize(
    "name", ["ä ö.xml", "robot (1).xml", "a=b,c.xml", "v1.2.final.xml", "[x]{y}.mjcf"]
)
def test_every_name_of_a_file_loads(tmp_path: Path, name: str):
    folder = tmp_path / name.replace(".xml", "")
    folder.mkdir()
    (folder / name).write_text(NAMED)
    assert load_model(str(folder / name)).nbody == 2


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-32"])
def test_a_mark_at_the_start_says_how_a_file_is_encoded(tmp_path: Path, encoding: str):
    path = tmp_path / "model.xml"
    path.write_bytes(NAMED.encode(encoding))
    assert load_model(path).body(1).name == "bär"


def test_a_declared_encoding_is_followed(tmp_path: Path):
    path = tmp_path / "model.xml"
    path.write_bytes(f"<?xml version='1.0' encoding='ISO-8859-1'?>\n{NAMED}".encode("latin-1"))
    assert load_model(path).body(1).name == "bär"


def test_an_xml_string_may_begin_with_a_mark():
    assert load_model(f"\ufeff\n{NAMED}").nbody == 2


def test_included_files_have_their_own_encodings(tmp_path: Path, monkeypatch):
    (tmp_path / "parts").mkdir()
    inner = '<mujocoinclude><body name="bär"><freejoint/><geom type="mesh" mesh="m"/></body></mujocoinclude>'
    (tmp_path / "parts" / "body.xml").write_bytes(inner.encode("utf-16"))
    (tmp_path / "m.obj").write_text(TETRAHEDRON)
    body = '<worldbody><include file="parts/body.xml"/></worldbody>'
    (tmp_path / "main.mjcf").write_text(
        f'<mujoco><asset><mesh file="m.obj"/></asset>{body}</mujoco>'
    )
    monkeypatch.chdir(tmp_path)
    for source in ("main.mjcf", tmp_path / "main.mjcf"):
        assert load_model(source).body(1).name == "bär"


def test_the_file_that_was_named_is_read_and_not_its_neighbour(tmp_path: Path):
    (tmp_path / "robot.xml").write_text(NAMED.replace("bär", "neighbour"))
    (tmp_path / "robot.mjcf").write_text(NAMED)
    assert load_model(tmp_path / "robot.mjcf").body(1).name == "bär"


def test_a_tilde_is_the_home_folder(tmp_path: Path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "robot.xml").write_text(NAMED)
    assert load_model("~/robot.xml").nbody == 2
    with pytest.raises(ValueError, match=f"{tmp_path}/other.xml': no such file"):
        load_model("~/other.xml")


def urdf_in_a_package(tmp_path: Path, mesh: str) -> Path:
    """Return a URDF file of a package called `lamp_description`, with a mesh in another folder of it."""
    package = tmp_path / "share" / "lamp_description"
    for folder in ("urdf", "meshes"):
        (package / folder).mkdir(parents=True)
    (package / "meshes" / "base.obj").write_text(TETRAHEDRON)
    path = package / "urdf" / "lamp.urdf"
    path.write_text(URDF.replace("MESH", mesh))
    return path


@pytest.mark.parametrize(
    "mesh",
    [
        "package://lamp_description/meshes/base.obj",
        "../meshes/base.obj",
        "model://lamp_description/meshes/base.obj",
    ],
)
def test_meshes_of_a_urdf_file_are_found_and_its_links_stay(tmp_path: Path, mesh: str, monkeypatch):
    monkeypatch.chdir(tmp_path)
    mj_model = load_model(urdf_in_a_package(tmp_path, mesh).relative_to(tmp_path))
    assert [mj_model.body(i).name for i in range(mj_model.nbody)] == [
        "world",
        "base",
        "arm",
        "head",
    ]
    assert mj_model.nmesh == 1
    np.testing.assert_allclose(mj_model.body_mass, [0.0, 2.0, 1.0, 1.0])


def test_a_urdf_files_own_extension_stays(tmp_path: Path):
    path = urdf_in_a_package(tmp_path, "package://lamp_description/meshes/base.obj")
    own = '<robot name="lamp"><mujoco><compiler strippath="false" fusestatic="true"/></mujoco>'
    path.write_text(path.read_text().replace('<robot name="lamp">', own))
    assert load_model(path).nbody == 2


def test_a_package_that_is_nowhere_is_named(tmp_path: Path):
    path = urdf_in_a_package(tmp_path, "package://desk_description/meshes/base.obj")
    with pytest.raises(
        ValueError, match="lamp.urdf: mesh 'package://desk_description.*'desk_description' beside"
    ):
        load_spec(path)


@pytest.mark.parametrize("inertia", ["10", "-1"])
def test_an_inertia_that_mujoco_refuses_is_told_with_its_link(tmp_path: Path, inertia: str):
    path = urdf_in_a_package(tmp_path, "../meshes/base.obj")
    of_arm = '<mass value="1.0"/><inertia ixx='
    path.write_text(path.read_text().replace(f'{of_arm}"1"', f'{of_arm}"{inertia}"'))
    with pytest.raises(ValueError, match="lamp.urdf: .*inertia.*'arm'"):
        load_model(path)


def test_a_urdf_file_of_drawn_shapes_alone_keeps_them(tmp_path: Path):
    path = urdf_in_a_package(tmp_path, "../meshes/base.obj")
    path.write_text(path.read_text().replace("collision", "visual"))
    assert load_model(path).ngeom == 2


def test_mujoco_by_itself_melts_fixed_links():
    """Were it otherwise, there would be nothing to mend here."""
    drawn = URDF.replace('<mesh filename="MESH"/>', '<sphere radius="1"/>')
    assert mujoco.MjModel.from_xml_string(drawn).nbody == 2
    assert load_model(drawn).nbody == 4
