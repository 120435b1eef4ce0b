"""The engine runs beside torch, numpy, jaxtyping, MuJoCo, MuJoCo Warp and Warp, and nothing else of ours or others'."""

import inspect

import pytest

from ksim_rl import physics
from tests.integration.alone import run_each_with

PACKAGES = ("torch", "numpy", "jaxtyping", "mujoco", "mujoco-warp", "warp-lang")
# What programs beyond the engine's need; a name that is wrongly spelled here would be absent for another reason.
NOT_LOADED = (
    "torchrl",
    "tensordict",
    "hydra",
    "omegaconf",
    "safetensors",
    "rich",
    "matplotlib",
    "imageio",
)

ROOMS = """
import importlib, pathlib, sys
import ksim_rl

here = pathlib.Path(ksim_rl.__file__).parent
rooms = ("physics", "compiled", "device", "files")
files = [path for room in rooms for path in sorted((here / room).rglob("*.py"))]
for path in [*files, here / "checked.py", here / "checks.py", here / "terminal.py"]:
    if path.name in ("failures.py", "replay.py"):
        continue  # the files of a NaN guard
    parts = path.relative_to(here.parent).with_suffix("").parts
    importlib.import_module(".".join(parts[:-1] if parts[-1] == "__init__" else parts))
rooms = {name.split(".")[1] for name in sys.modules if name.startswith("ksim_rl.")}
print(*sorted(rooms))
print(*(name for name in NOT_LOADED if name in sys.modules))
""".replace("NOT_LOADED", repr(NOT_LOADED))

WORLDS = """
import runpy
import warp

# Kernels compile in half of the time, and run for an instant.
warp.config.optimization_level = 0
example = runpy.run_path("examples/worlds.py", run_name="example")
for engine in ("warp", "c"):
    mass_E, sag_E = example["reach"](engine=engine, num_worlds=4)
    print(*mass_E.tolist(), *sag_E.tolist())
"""

GUARD = """
from ksim_rl.physics import NanGuardCfg, SimCfg, World, load_model

model = load_model("<mujoco><worldbody><body><freejoint/><geom size='1'/></body></worldbody></mujoco>")
try:
    World(model, num_envs=1, sim=SimCfg(engine="c", nan_guard=NanGuardCfg(folder=FOLDER)))
except ValueError as error:
    print(error)
"""


@pytest.fixture(scope="module")
def printed(tmp_path_factory):
    """What the programs print, by name."""
    folder = str(tmp_path_factory.mktemp("guard"))
    programs = {"rooms": ROOMS, "guard": GUARD.replace("FOLDER", repr(folder)), "worlds": WORLDS}
    return dict(zip(programs, run_each_with(PACKAGES, [*programs.values()]), strict=True))


def test_its_modules_load_no_other_room_and_no_other_package(printed):
    rooms, others = printed["rooms"].splitlines()
    assert rooms.split() == [
        "checked",
        "checks",
        "compiled",
        "device",
        "files",
        "physics",
        "terminal",
    ]
    assert others == ""


def test_both_engines_step_worlds(printed):
    warp, c = (list(map(float, line.split())) for line in printed["worlds"].splitlines())
    masses, sags = warp[:4], warp[4:]
    assert masses == pytest.approx([0.5, 1.0, 1.5, 2.0])
    # What holds the arm: stiffness times sag is gravity's torque at the angle that is reached.
    assert sags == pytest.approx([0.0559, 0.1101, 0.1627, 0.2137], abs=0.01)
    assert warp == pytest.approx(c, abs=1e-4)


def test_who_asks_for_files_of_the_nan_guard_learns_what_they_need(printed):
    assert "need the package safetensors" in printed["guard"]


def test_its_face_is_a_few_names_that_explain_themselves():
    assert len(physics.__all__) <= 16 and sorted(physics.__all__) == physics.__all__
    for name in physics.__all__:
        assert len(inspect.getdoc(getattr(physics, name)) or "") > 60, name
