"""Compiles kernels for CUDA where there is no GPU: NVRTC comes with Warp, and its PTX tells two trees apart.

    python -m tests.cuda_builds --out DIR        # in one tree, then in the other; a few minutes each
    python -m tests.cuda_builds --out DIR --of rows cartpole
    diff -r DIR OTHER

Worlds are built with the lanes, blocks and registers that a GPU would get, and nothing is launched. Equal text means
equal bits and equal speed. What differs without a meaning has names of its own: hashes, registers and labels are
numbered as they come, and a kernel's arguments are called as in their struct.
"""

import argparse
import importlib
import pkgutil
import re
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args
from unittest import mock

import mujoco
import torch
import warp as wp

import ksim_rl
from benchmarks.agreement_models import CARTPOLE, QUADRUPED
from benchmarks.judge.generator import generate
from ksim_rl.compiled import lanes, tape
from ksim_rl.device import copying, random, recording, upstream
from ksim_rl.device.quick_launch import QuickLaunch
from ksim_rl.physics import SimCfg, load_model, native
from ksim_rl.physics.fields import ALL
from ksim_rl.physics.newton import solver
from ksim_rl.physics.rows.contact_lists import ContactLists
from ksim_rl.physics.substeps import Sensors
from ksim_rl.physics.warp_world import WarpWorld
from ksim_rl.scene.robots.unitree_g1 import UnitreeG1
from ksim_rl.scene.robots.unitree_go import UnitreeGo1
from ksim_rl.scene.scene import SceneCfg, build_spec
from ksim_rl.scene.terrains import PlaneTerrain
from ksim_rl.terminal import show
from tests.physics import row_models, rows_of_all_kinds, test_smooth

ARCHITECTURE = 90
NUM_ENVS = 8
BLOCK = 256
"""Threads of a block where a launch does not say."""
MULTIPROCESSORS = 132
# Fields that an env may draw, so that constants are recomputed.
DRAWN = ("body_mass", "dof_armature")


@dataclass(frozen=True, kw_only=True)
class Build:
    """A module of Warp, with the struct that its kernel takes, and the size of the blocks of its launches."""

    module: wp.Module
    block_dim: int
    argument: Any = None


@contextmanager
def as_on_cuda(*, many: bool) -> Iterator[None]:
    """Let the package take the CPU for an H200, with more worlds than fill it or fewer."""
    of_device = vars(wp.Device)["is_cuda"]

    def is_cuda(device: wp.Device) -> bool:
        # Warp itself, and MuJoCo Warp, go on working on the CPU.
        asks = sys._getframe(1).f_globals["__name__"]
        return asks.startswith("ksim_rl.") or of_device.fget(device)

    few = 0 if many else native.FEW_WORLDS
    multiprocessors = 0 if many else MULTIPROCESSORS
    with (
        mock.patch.object(wp.Device, "is_cuda", property(is_cuda)),
        mock.patch.object(wp.get_device("cpu"), "sm_count", multiprocessors),
        mock.patch.object(native, "FEW_WORLDS", few),
        mock.patch.object(solver, "FEW_WORLDS", few),
    ):
        yield


def builds_of_world(
    mj_model: mujoco.MjModel, *, many: bool = False, njmax: int = 64, nconmax: int = 24
) -> list[Build]:
    """Return what a world of this model launches, in the order of its first launches."""
    found: dict[tuple[wp.Kernel, int | None], None] = {}

    def note(kernel: wp.Kernel, dim: int | Sequence[int], block_dim: int | None) -> None:
        if kernel.func.__module__.startswith("ksim_rl.") and not kernel.is_generic:
            found[kernel, block_dim] = None

    # Launches are noted, and nothing runs.
    with as_on_cuda(many=many), upstream.launches_diverted(note):
        sim = SimCfg(njmax=njmax, nconmax=nconmax)
        world = WarpWorld(mj_model, num_envs=NUM_ENVS, sim=sim, per_world_fields=DRAWN)
        world._launch_once()
        for sensors in get_args(Sensors):
            world._launch_substep(sensors)
        if world._substeps.stages.contacts is not None:
            world._substeps.stages.contacts.rne_postconstraint(world.warp_model)
        world._substeps.refresh()
        world._launch_reset()
        world._overflow.record()
        if world._masked_constants is not None:
            world._masked_constants.launch(ALL)
            world._masked_constants.mend_weights()
        ContactLists(world.warp_model, world.warp_data_E).order()
    builds: dict[tuple[wp.Module, int], Build] = {}
    for kernel, size in found:
        block_dim = size or BLOCK
        build = Build(module=kernel.module, block_dim=block_dim, argument=argument_of(kernel))
        # Kernels of one file of Python are one module.
        builds.setdefault((kernel.module, block_dim), build)
    return [*builds.values()]


def builds_of_rows() -> list[Build]:
    """Return the kernels of rows: those that exist once the package is imported, a copy, and one of a recording."""
    for module in pkgutil.walk_packages(ksim_rl.__path__, "ksim_rl."):
        if not module.name.endswith("__main__"):
            importlib.import_module(module.name)
    named = {*QuickLaunch.existing}
    copies = copying._launcher(((4, 7, 9, 12), (1, 3, 3, 3)))
    found = [*sorted(named, key=lambda launch: [*launch._arguments]), copies, *_recorded()]
    builds = []
    for launch in found:
        module, block_dim = launch.loadable
        (kernel,) = module.kernels.values()
        builds.append(Build(module=module, block_dim=block_dim, argument=argument_of(kernel)))
    return builds


def _recorded() -> set[QuickLaunch]:
    """Return the kernel of a recording with draws, sums over columns and products of matrices, by lanes."""
    seed = torch.tensor(5)
    keys = random.row_keys(seed, 7, torch.zeros(NUM_ENVS, dtype=torch.int64), NUM_ENVS)

    def step(obs_EL: torch.Tensor) -> torch.Tensor:
        noisy_EL = obs_EL + random.normal(keys, obs_EL.shape[1])
        weight_E1 = noisy_EL.exp().sum(1, keepdim=True) + random.uniform(keys, 1)
        turned_EL = (noisy_EL.view(-1, 6, 6) @ obs_EL[:, :6, None]).squeeze(-1)
        return torch.where(turned_EL > weight_E1, turned_EL, weight_E1)

    before = {*QuickLaunch.existing}
    with recording.recorded() as recorder:
        result = step(torch.randn(NUM_ENVS, 36))
    with (
        mock.patch.dict(lanes.LANES, cpu=lanes.LANES["cuda"]),
        mock.patch.object(tape.kernel_loading, "load", lambda modules, device: None),
    ):
        kept = tape.Tape(recorder, num_rows=NUM_ENVS, returned=(result,))
    made = {*QuickLaunch.existing} - before
    assert kept and made, "the recording became no kernel"
    return made


def argument_of(kernel: wp.Kernel) -> Any:
    """Return the struct that a kernel takes alone, or None."""
    kinds = [argument.type for argument in kernel.adj.args]
    if len(kinds) != 1:
        return None
    return getattr(kinds[0], "ctype", None)


def _robot(robot: Any) -> mujoco.MjModel:
    return build_spec(SceneCfg(robots={"robot": robot}, terrain=PlaneTerrain())).compile()


def _generated(number: int) -> mujoco.MjModel:
    return load_model(generate(0, number).xml)


def _rows_of_all_kinds(cone: str) -> mujoco.MjModel:
    return load_model(rows_of_all_kinds.ROWS_OF_ALL_KINDS.format(cone=cone, iterations=20))


MODELS: dict[str, Callable[[], mujoco.MjModel]] = {
    "cartpole": lambda: load_model(CARTPOLE),
    "quadruped": lambda: load_model(QUADRUPED),
    "all_rows": lambda: row_models.mj_model("elliptic"),
    "all_pyramidal": lambda: _rows_of_all_kinds("pyramidal"),
    "all_elliptic": lambda: _rows_of_all_kinds("elliptic"),
    "mixed": test_smooth.mixed,
    "go1": lambda: _robot(UnitreeGo1()),
    "g1": lambda: _robot(UnitreeG1()),
}


def builds_of(name: str) -> list[Build]:
    """Return the builds of `rows`, or of a model, such as `go1`, `go1:many` of more worlds, or `generated7`."""
    if name == "rows":
        return builds_of_rows()
    model, _, many = name.partition(":")
    if model.startswith("generated"):
        mj_model = _generated(int(model.removeprefix("generated")))
    else:
        mj_model = MODELS[model]()
    return builds_of_world(mj_model, many=bool(many), njmax=100 if model == "g1" else 64)


def ptx(build: Build) -> str:
    """Compile a build; return its PTX with names that do not depend on hashes, registers or places of arguments."""
    # Tests compile without optimization, a GPU does not.
    optimized = mock.patch.object(wp.config, "optimization_level", None)
    with tempfile.TemporaryDirectory() as folder, optimized:
        build.module.options["block_dim"] = build.block_dim
        (file,) = wp.compile_aot_module(
            build.module, arch=ARCHITECTURE, module_dir=folder, use_ptx=True
        )
        return normalized(file.read_text(), build.argument)


def normalized(text: str, argument: Any = None) -> str:
    """Return PTX without what compilations of equal kernels may differ in."""
    text = re.sub(r"//.*|\0", "", text)
    text = re.sub(r"(?m)^\s*\.(reg|loc|file|version)\b.*\n", "", text)
    text = re.sub(r"\w+_param_(\d+)(\+\d+)?", lambda m: _argument_at(m[1], m[2], argument), text)
    # Registers, labels, and functions and arrays whose names are mangled or hashed.
    named = re.compile(r"%[a-z]+\d+|\$\w+|\b_Z\w+|\b\w+_[0-9a-f]{8}\w*")
    numbers: dict[str, str] = {}

    def number(match: re.Match[str]) -> str:
        name = match[0]
        kind = re.match(r"%[a-z]+|\$|_Z|\w", name)
        assert kind is not None
        return numbers.setdefault(name, f"{kind[0]}:{len(numbers)}")

    used = Counter(re.findall(r"[\w$%]+", text))
    # Warp's headers declare constants that no kernel of ours reads.
    lines = [
        line.rstrip() for line in text.splitlines() if line.strip() and not _is_unread(line, used)
    ]
    return named.sub(number, "\n".join(lines)) + "\n"


def _is_unread(line: str, used: Mapping[str, int]) -> bool:
    declared = re.match(r"\.(?:const|global)\b.*?(\w+)(?:\[\d+\])?(?: = .*)?;", line)
    return declared is not None and used[declared[1]] <= 1


def _argument_at(number: str, offset: str | None, argument: Any) -> str:
    place = int(offset or 0)
    # The first one has the sizes of the launch.
    if argument is None or number != "1":
        return f"argument{number}+{place}"
    fields = [name for name, _ in argument._fields_ if getattr(argument, name).offset <= place]
    if not fields:
        return f"argument+{place}"
    return f"{fields[-1]}+{place - getattr(argument, fields[-1]).offset}"


def main(arguments: Sequence[str] | None = None) -> None:
    """Write the PTX of each build to a file of its own, by the name of what it is of."""
    parser = argparse.ArgumentParser(description="Write kernels as PTX.")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--of", nargs="*", default=EVERYTHING)
    given = parser.parse_args(arguments)
    for name in given.of:
        folder = given.out / name.replace(":", "_of_")
        folder.mkdir(parents=True, exist_ok=True)
        # A kernel that is launched no more would stay, and equal the other tree's.
        for old in folder.glob("*.ptx"):
            old.unlink()
        for place, build in enumerate(builds_of(name)):
            text = ptx(build)
            (folder / f"{place:02}.ptx").write_text(text)
            show(f"{name} {place}: {len(text.splitlines())} lines")


EVERYTHING = (
    "rows",
    *MODELS,
    *("quadruped:many", "go1:many", "g1:many", "mixed:many"),
    *("generated0", "generated1", "generated2"),
)


if __name__ == "__main__":
    main()
