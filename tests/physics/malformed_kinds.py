"""Malformed models of more kinds than one writes by hand, each loaded in a process of its own with a time limit.

`python -m tests.physics.malformed_kinds [NAME ...]` prints the figures; `figures()` returns them.
"""

import faulthandler
import os
import resource
import signal
import struct
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from ksim_rl.physics import load_model
from tests.physics.malformed_models import JOINTED, MALFORMED, body, world

MOST_SECONDS = 10
MOST_BYTES = 8 * 2**30
Writes = Callable[[Path], str]  # writes files beside the model, and returns its XML

FULL = """<mujoco model="full">
  <compiler angle="radian"/>
  <option timestep="0.002" gravity="0 0 -9.81" iterations="100" ls_iterations="50" tolerance="1e-8" impratio="1"/>
  <visual><global fovy="45"/><map znear="0.01"/></visual>
  <statistic extent="1" center="0 0 0"/>
  <default><geom rgba="1 1 1 1"/></default>
  <asset>
    <texture name="grid" type="2d" builtin="checker" width="8" height="8" rgb1="1 1 1"/>
    <material name="grey" texture="grid" specular="0.5" rgba="1 1 1 1"/>
    <mesh name="wedge" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/>
    <hfield name="hills" nrow="2" ncol="2" size="1 1 1 1" elevation="0 1 1 0"/>
  </asset>
  <worldbody>
    <light name="sun" pos="0 0 3" dir="0 0 -1"/>
    <camera name="eye" pos="0 0 3" fovy="45"/>
    <geom name="ground" type="hfield" hfield="hills" friction="1 0.005 0.0001" margin="0"/>
    <body name="link" pos="0 0 2" quat="1 0 0 0" gravcomp="0">
      <joint name="hinge" type="hinge" axis="0 1 0" range="-1 1" damping="1" armature="0.1" frictionloss="0.1"
        stiffness="1" ref="0"/>
      <geom name="shape" type="capsule" size="0.1 0.2" density="1000" condim="3" solref="0.02 1"
        solimp="0.9 0.95 0.001 0.5 2"/>
      <site name="tip" pos="0 0 0.2" size="0.01"/>
      <body name="child" pos="0 0 0.5">
        <inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
        <joint name="slide" type="slide" axis="0 0 1"/>
        <geom name="part" type="mesh" mesh="wedge"/>
      </body>
    </body>
  </worldbody>
  <tendon><fixed name="rope" damping="1" stiffness="1"><joint joint="hinge" coef="1"/></fixed></tendon>
  <contact><pair name="two" geom1="shape" geom2="ground" friction="1 1 0.005 0.0001 0.0001"/></contact>
  <equality><joint name="gears" joint1="hinge" joint2="slide" polycoef="0 1 0 0 0"/></equality>
  <actuator>
    <position name="servo" joint="hinge" kp="10" ctrlrange="-1 1" gear="1"/>
    <general name="push" joint="slide" gainprm="1" biasprm="0 0 0" dynprm="1" forcerange="-1 1"/>
  </actuator>
  <sensor><gyro name="imu" site="tip" noise="0.1" cutoff="0"/></sensor>
  <keyframe><key name="home" qpos="0 0" ctrl="0 0" time="0"/></keyframe>
</mujoco>"""

# Numbers of `FULL`, by element and attribute; each is replaced by a text that is no number.
NUMBERS = (
    *(
        "timestep",
        "gravity",
        "iterations",
        "ls_iterations",
        "tolerance",
        "impratio",
        "fovy",
        "znear",
        "extent",
    ),
    *(
        "width",
        "height",
        "rgb1",
        "specular",
        "vertex",
        "nrow",
        "ncol",
        "elevation",
        "dir",
        "friction",
        "margin",
    ),
    *(
        "quat",
        "gravcomp",
        "axis",
        "range",
        "damping",
        "armature",
        "frictionloss",
        "stiffness",
        "ref",
        "density",
    ),
    *(
        "condim",
        "solref",
        "solimp",
        "mass",
        "diaginertia",
        "coef",
        "polycoef",
        "kp",
        "ctrlrange",
        "gear",
        "gainprm",
    ),
    *("biasprm", "dynprm", "forcerange", "noise", "cutoff", "qpos", "ctrl", "time"),
)
NAMES = ("texture", "hfield", "mesh", "joint1", "joint", "site", "geom1", "type", "builtin")
NOT_NEGATIVE = (
    "timestep",
    "iterations",
    "ls_iterations",
    "impratio",
    "friction",
    "damping",
    "frictionloss",
    "kp",
)
NOT_NEGATIVE += ("density", "mass", "gainprm", "nrow", "width", "noise", "diaginertia")


def _with(attribute: str, value: str) -> str:
    start = FULL.index(f' {attribute}="') + len(attribute) + 3
    return FULL[:start] + value + FULL[FULL.index('"', start) :]


def _generated() -> Iterator[tuple[str, str]]:
    for attribute in NUMBERS:
        yield f"{attribute} is a word", _with(attribute, "high")
        yield f"{attribute} is beyond all numbers", _with(attribute, "1e999")
    for attribute in NAMES:
        yield f"{attribute} names nothing", _with(attribute, "nothing_of_the_kind")
    for attribute in NOT_NEGATIVE:
        yield f"{attribute} is negative", _with(attribute, "-1")
    for tag in ("worldbody", "body", "geom", "joint", "actuator", "sensor", "asset", "tendon"):
        yield (
            f"{tag} is not closed",
            FULL.replace(f"</{tag}>", "", 1).replace(f"<{tag} ", f"<{tag}> <", 1),
        )


def _enormous() -> Iterator[tuple[str, str]]:
    bare = '<geom size="0.1"/>'
    yield "time step of a second", _with("timestep", "1")
    yield "time step of nothing", _with("timestep", "0")
    for count in (100_000, 50_000_000):
        yield (
            f"{count} replicas",
            world(f'<replicate count="{count}" offset="1 0 0">{bare}</replicate>'),
        )
    yield (
        "replicas of replicas",
        world(f'<replicate count="10000"><replicate count="10000">{bare}</replicate></replicate>'),
    )
    for what, attribute in (
        ("an entity", 'count="5&#48;000000"'),
        ("brackets before it", 'sep="&gt; >" count="50000000"'),
        ("a name that ends as it does", 'count="50000000" x-count="1"'),
        ("quotes in quotes", "count='50000000' sep=\"x' count='1\""),
        ("another after it", 'count="50000000" count="1"'),
    ):
        yield f"replicas, with {what}", world(f"<replicate {attribute}>{bare}</replicate>")
    hidden = f'<replicate count="50000000">{bare}</replicate>'
    for what, begins in (("text", "<![CDATA[ <!-- ]]>"), ("declaration", "<!x <!-- >")):
        yield f"replicas hidden by a {what}", world(f"{begins}{hidden}<!-- -->")
    yield "replicas of nothing", world('<replicate count="50000000"><site/></replicate>')
    yield "many geoms", world(bare * 20_000)
    yield "deep bodies", world("<body>" * 20_000 + bare + "</body>" * 20_000)
    yield (
        "deep defaults",
        f"<mujoco><default>{'<default>' * 9000}{'</default>' * 9000}</default></mujoco>",
    )
    yield (
        "a soft grid",
        world('<flexcomp name="f" type="grid" count="2000 2000 2000" spacing="1 1 1" dim="3"/>'),
    )
    for kind, params in (
        ("supersphere", "100000 1 1"),
        ("cone", "100000000 0.5"),
        ("plate", "100000 100000"),
    ):
        yield f"mesh {kind}", _asset(f'<mesh name="a" builtin="{kind}" params="{params}"/>')
    for sizes in ('nrow="100000" ncol="100000"', 'nrow="1000000000" ncol="2"'):
        yield f"height field {sizes}", _asset(f'<hfield name="a" {sizes} size="1 1 1 1"/>')
    for kind in ("2d", "cube", "skybox"):
        yield (
            f"texture {kind}",
            _asset(
                f'<texture name="a" type="{kind}" builtin="flat" width="100000" height="600000"/>'
            ),
        )
    for size in ("nuserdata", "nkey", "nuser_body", "nuser_geom", "nuser_sensor", "njmax"):
        yield f"size {size}", world(bare, f'<size {size}="2000000000"/>')
    user = 'datatype="real" needstage="acc" objtype="body" objname="link"'
    for name, sensor in (
        ("user sensor", f'<user dim="1000000000" {user}/>'),
        ("contact sensor", '<contact num="100000000" data="found force"/>'),
        ("history", '<jointpos joint="hinge" nsample="1000000000" delay="1"/>'),
    ):
        yield f"enormous {name}", body(JOINTED, f"<sensor>{sensor}</sensor>")
    for kind in ("dyntype", "gaintype", "biastype"):
        actuator = f'<general name="push" joint="hinge" {kind}="user"/>'
        yield f"user {kind} without a callback", body(JOINTED, f"<actuator>{actuator}</actuator>")


def _asset(text: str) -> str:
    return f"<mujoco>\n  <asset>{text}</asset>\n</mujoco>"


def _with_file(name: str, content: bytes, xml: str) -> Writes:
    def write(folder: Path) -> str:
        (folder / name).write_bytes(content)
        return xml

    return write


def _files() -> Iterator[tuple[str, Writes]]:
    mesh = world('<geom type="mesh" mesh="m"/>', '<asset><mesh name="m" file="{}"/></asset>').format
    binary_stl = b" " * 80 + struct.pack("<I", 2**32 - 1)
    contents = {
        "nothing": b"",
        "noise": bytes(range(256)) * 8,
        "zeros": bytes(4096),
        "text": b"solid x\nfacet\n",
    }
    for ending in ("stl", "obj", "msh"):
        for what, content in contents.items():
            yield f"{ending} of {what}", _with_file(f"m.{ending}", content, mesh(f"m.{ending}"))
    yield "stl of 4e9 faces", _with_file("m.stl", binary_stl, mesh("m.stl"))
    yield (
        "stl of nan",
        _with_file(
            "m.stl", b" " * 80 + struct.pack("<I12fH", 1, *[float("nan")] * 12, 0), mesh("m.stl")
        ),
    )
    yield (
        "obj of unknown points",
        _with_file("m.obj", b"v 0 0 0\nf 1 2 3\nf 9 8 7\n", mesh("m.obj")),
    )
    yield (
        "msh of 2e9 points",
        _with_file("m.msh", struct.pack("<4i", 2**31 - 1, 0, 0, 2**31 - 1), mesh("m.msh")),
    )
    png = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + struct.pack(">2I5B", 100_000, 100_000, 8, 2, 0, 0, 0)
    picture = _asset('<texture name="t" type="2d" file="t.png"/>')
    hills = _asset('<hfield name="h" file="h.png" size="1 1 1 1"/>')
    yield "texture of 1e10 pixels", _with_file("t.png", png, picture)
    yield "height field of a damaged png", _with_file("h.png", png[:20], hills)
    for what, content in contents.items():
        yield f"png of {what}", _with_file("t.png", content, picture)
    for rows in (2**31 - 1, -5, 1000):
        yield (
            f"height field file of {rows} rows",
            _with_file("h.bin", struct.pack("<2i", rows, 1000), hills.replace("h.png", "h.bin")),
        )
    for tag, xml in (
        ("include", '<mujoco><include file="model.xml"/></mujoco>'),
        ("attached", '<mujoco><asset><model name="m" file="model.xml"/></asset><worldbody>'
         '<attach model="m" prefix="p"/></worldbody></mujoco>'),
    ):  # fmt: skip
        yield f"{tag} in itself", lambda folder, xml=xml: xml
    yield from _special_files(mesh)


def _special_files(mesh: Callable[[str], str]) -> Iterator[tuple[str, Writes]]:
    """Yield models that name pipes, devices, and files that include each other."""
    include = '<mujoco><include file="{}"/></mujoco>'.format
    hills = _asset('<hfield name="h" file="{}" size="1 1 1 1"/>').format
    attached = _asset('<model name="m" file="{}"/>').format
    skin = '<mujoco><deformable><skin name="s" file="{}"/></deformable></mujoco>'.format
    for what, xml, name in (
        ("mesh", mesh, "m.stl"),
        (
            "mesh in a folder",
            lambda name: mesh(name).replace("<asset>", '<compiler meshdir="below"/><asset>'),
            "m.stl",
        ),
        ("height field", hills, "h.png"),
        ("include", include, "i.xml"),
        ("model", attached, "i.xml"),
        ("skin", skin, "s.skn"),
    ):
        for special in ("pipe", "device"):

            def write(folder: Path, xml=xml, name=name, special=special) -> str:
                text = xml(name)
                path = folder / ("below" if "below" in text else "") / name
                path.parent.mkdir(exist_ok=True)
                os.mkfifo(path) if special == "pipe" else path.symlink_to("/dev/zero")
                return text

            yield f"{what} that is a {special}", write

    def write_chain(folder: Path) -> str:
        for number in range(60):
            following = f'<include file="{number + 1}.xml"/>'
            (folder / f"{number}.xml").write_text(f"<mujoco>{following}{following}</mujoco>")
        return include("0.xml")

    yield "includes of includes", write_chain


def kinds() -> dict[str, Writes]:
    """Return what writes each kind, by name: the kinds of `malformed_models`, and the generated ones."""
    texts = (
        {name: xml for name, (xml, _) in MALFORMED.items()} | dict(_generated()) | dict(_enormous())
    )
    return {name: (lambda folder, xml=xml: xml) for name, xml in texts.items()} | dict(_files())


def load_apart(write: Writes, *, load: Callable[[Path], object] = load_model) -> tuple[str, str]:
    """Load a kind in a forked process; return "refused", "accepted", "crash" or "hang", and what was said."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.xml"
        path.write_text(write(Path(folder)))
        read_end, write_end = os.pipe()
        started = time.monotonic()
        pid = os.fork()
        if pid == 0:
            os.close(read_end)
            _load_and_say(load, path, write_end)
        os.close(write_end)
        with os.fdopen(read_end, "rb") as said:
            text = said.read().decode(errors="replace")
        _, status = os.waitpid(pid, 0)
    if os.WIFSIGNALED(status):
        late = os.WTERMSIG(status) in (signal.SIGALRM, signal.SIGVTALRM)
        return (
            "hang" if late else "crash"
        ), f"signal {os.WTERMSIG(status)} after {time.monotonic() - started:.0f} s"
    verdict, _, message = text.partition(" ")
    if verdict == "refused" and (str(path) not in message or "\n" in message):
        return "crash", f"not one line with the file's name: {message[:300]}"
    return verdict or "crash", message


def _load_and_say(load: Callable[[Path], object], path: Path, pipe: int) -> None:
    """Leave the process with what came of it in the pipe; the child of a test runner must not return."""
    faulthandler.disable()  # what the test runner has enabled would print a traceback for each crash that is counted
    try:
        # On top of what the libraries have mapped, which is gigabytes where torch is built for CUDA.
        mapped = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        most = mapped + MOST_BYTES
        resource.setrlimit(resource.RLIMIT_AS, (most, most))
        # Processor time, since other programs may hold the machine up; wall time only ends what waits for ever.
        for kind, number, seconds in (
            (signal.ITIMER_VIRTUAL, signal.SIGVTALRM, MOST_SECONDS),
            (signal.ITIMER_REAL, signal.SIGALRM, 6 * MOST_SECONDS),
        ):
            signal.signal(number, signal.SIG_DFL)
            signal.setitimer(kind, seconds)
        load(path)
        text = "accepted"
    except ValueError as error:
        text = f"refused {error}"
    except BaseException:
        text = f"crash {traceback.format_exc()[-600:]}"
    os.write(pipe, text.encode()[:60_000])
    os._exit(0)


def figures(
    names: Iterable[str] | None = None, *, load: Callable[[Path], object] = load_model
) -> dict:
    """Return how many kinds there are, how many crashed, hung or were accepted, and which."""
    chosen = kinds() if names is None else {name: kinds()[name] for name in names}
    found = {name: load_apart(write, load=load) for name, write in chosen.items()}
    bad = {
        name: f"{verdict}: {text}"
        for name, (verdict, text) in found.items()
        if verdict != "refused"
    }
    counts = {
        verdict: sum(v == verdict for v, _ in found.values())
        for verdict in ("crash", "hang", "accepted")
    }
    return {
        "kinds": len(found),
        "crashes": counts["crash"],
        "hangs": counts["hang"],
        "accepted": counts["accepted"],
        "which": bad,
    }


if __name__ == "__main__":
    print(figures(sys.argv[1:] or None))
