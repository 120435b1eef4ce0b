"""Models of users that are none, or none of a robot."""

from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path

BODY = '<body name="b" pos="0 0 1"><joint name="j" type="free"/><geom name="g" size="0.1"/></body>'
QUADRUPED = files("ksim_rl.scene.robots").joinpath("quadruped.xml").read_text()

MODELS: dict[str, tuple[str | bytes, str]] = {
    "empty": ("", "empty.xml"),
    "no XML": ("this is no model", "no XML.xml"),
    "cut": ("<mujoco><worldbody>", "cut.xml"),
    "another root": ("<html/>", "another root.xml"),
    "bytes": (bytes(range(256)), "bytes.xml"),
    "no body": ("<mujoco/>", "free joint"),
    "no joint": ('<mujoco><worldbody><geom size="1"/></worldbody></mujoco>', "free joint"),
    "unknown element": (f"<mujoco><worldbody>{BODY}<cube/></worldbody></mujoco>", "cube"),
    "unknown attribute": ('<mujoco><worldbody><body weight="1"/></worldbody></mujoco>', "weight"),
    "no mass": ('<mujoco><worldbody><body><joint name="j"/></body></worldbody></mujoco>', "mass"),
    "a size of NaN": (
        '<mujoco><worldbody><body><geom size="nan"/></body></worldbody></mujoco>',
        "NaN.xml",
    ),
    "a name twice": (f"<mujoco><worldbody>{BODY}{BODY}</worldbody></mujoco>", "'b'"),
    "no feet": (
        f'<mujoco><worldbody>{BODY}</worldbody><actuator><motor joint="knee"/></actuator></mujoco>',
        "feet",
    ),
    "a mesh that is missing": (
        '<mujoco><asset><mesh name="m" file="m.stl"/></asset><worldbody>'
        f'{BODY}<geom type="mesh" mesh="m"/></worldbody></mujoco>',
        "m.stl",
    ),
    "an include that is missing": ('<mujoco><include file="other.xml"/></mujoco>', "other.xml"),
    # Works: a task steps by a time of its own.
    "a negative time step": (
        QUADRUPED.replace("<worldbody>", '<option timestep="-1"/><worldbody>', 1),
        "timestep",
    ),
    "a mesh of 10^15 numbers": (
        '<mujoco><asset><mesh name="m" builtin="supersphere" params="100000 1 1"/></asset></mujoco>',
        "numbers",
    ),
    "a texture of 10^10 pixels": (
        '<mujoco><asset><texture name="t" type="2d" builtin="flat" width="100000" height="100000"/></asset></mujoco>',
        "numbers",
    ),
    "two billion numbers of a user": ('<mujoco><size nuserdata="2000000000"/></mujoco>', "numbers"),
    "frames in frames": (
        f"<mujoco><worldbody>{'<frame>' * 50000}{'</frame>' * 50000}</worldbody></mujoco>",
        "elements",
    ),
    "an include of itself": (
        '<mujoco><include file="an include of itself.xml"/></mujoco>',
        "takes in itself",
    ),
    "a URDF whose links turn in a circle": (
        '<robot name="r"><link name="a"/><link name="b"/>'
        '<joint name="j" type="fixed"><parent link="a"/><child link="b"/></joint>'
        '<joint name="k" type="fixed"><parent link="b"/><child link="a"/></joint></robot>',
        "circle.xml",
    ),
    "a URDF without links": ('<robot name="r"/>', "free joint"),
    "a URDF whose joint has no child": (
        '<robot name="r"><link name="a"/><joint name="j" type="revolute"><parent link="a"/></joint></robot>',
        "child.xml",
    ),
}


def write(folder: Path) -> Iterator[tuple[str, str, Path]]:
    """Write the models; yield each one's name, what an error names, and its path, and paths without a model."""
    folder.mkdir()
    for name, (content, named) in MODELS.items():
        path = folder / f"{name}.xml"
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        yield name, named, path
    yield "missing", "missing.xml", folder / "missing.xml"
    yield "a folder", "models", folder
    text = folder / "model.txt"
    text.write_text("<mujoco/>")
    yield "another ending", "model.txt", text
