"""Numbers that no run can have, for every whole number that a config takes: none may hang, fill memory or end badly."""

import dataclasses
import types
import typing
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import pytest

from benchmarks.faults import children
from ksim_rl import conf
from ksim_rl.checked import Annotation
from ksim_rl.device import room
from ksim_rl.trainers import RunCfg
from tests.cli import wrong_inputs

# Beyond 32 bits, and just within them.
HUGE = (10**12, 2 * 10**9)
LITTLE_BYTES = 2**30
# No memory and no time within an iteration depends on these, so that any number of 32 bits is as good as another.
FREE = frozenset(
    {
        "collector.warmup",
        "data.learning_starts",
        "data.policy_starts",
        "objective.max_skipped_steps",
        "objective.policy_delay",
        # Beyond the size of a picture it moves all of it away.
        "objective.random_shift",
        "seed",
        "task.observations.actor.delay.resample_every",
        "task.scene.terrain.max_initial_level",
        "task.scene.terrain.seed",
        "task.sim.ccd_iterations",
        "task.sim.iterations",
        "task.sim.ls_iterations",
        # Only Warp makes room for them, and looks at them itself; the C engine has none.
        "task.sim.nconmax",
        "task.sim.njmax",
        "task.sim.nan_guard.max_files",
        "task.viewer.num_envs",
        "trainer.checkpoint_interval",
        "trainer.eval_interval",
        "trainer.keep_checkpoints",
        "trainer.log_interval",
        "trainer.num_iterations",
    }
)
_SENSORS = "ksim_rl.scene.sensors"
_TERRAINS = "ksim_rl.scene.terrains"
# Parts that a small task leaves out: the words that bring them, and where fields are looked at with them.
PARTS: Sequence[tuple[Sequence[str], Sequence[str]]] = (
    (("objective=sac",), ("objective", "data", "modules")),
    (
        (
            "modules=lstm",
            "task.sim.nan_guard={folder: failures}",
            "task.observations.actor.delay={max_lag: 1}",
            "task.observations.critic.history={length: 2}",
            f"+task.scene.sensors.eye={{_target_: {_SENSORS}.CameraSensor}}",
            f"+task.scene.sensors.lidar={{_target_: {_SENSORS}.RayCaster, body: cart, "
            f"pattern: {{_target_: {_SENSORS}.RingPattern}}}}",
            f"+task.scene.sensors.pinhole={{_target_: {_SENSORS}.RayCaster, body: cart, "
            f"pattern: {{_target_: {_SENSORS}.PinholePattern}}}}",
            f"task.scene.terrain={{_target_: {_TERRAINS}.TerrainGrid, patches: {{"
            f"blocks: {{_target_: {_TERRAINS}.DiscreteObstacles}}, hills: {{_target_: {_TERRAINS}.PerlinNoise}}, "
            f"beams: {{_target_: {_TERRAINS}.NarrowBeams}}}}}}",
        ),
        ("",),
    ),
)


def configs() -> Iterator[tuple[RunCfg, Sequence[str], list[tuple[str, bool]]]]:
    """Yield configs with the words that bring their parts, and their whole numbers: path, and whether it is a list."""
    seen = set()
    for words, below in PARTS:
        cfg = conf.compose(["task=cartpole_balance", "device=cpu", *words])
        fresh = []
        for path, is_list in whole_numbers(cfg):
            if path not in seen and path.startswith(tuple(below)):
                fresh.append((path, is_list))
        seen.update(path for path, _ in fresh)
        yield cfg, words, fresh


def refusal(cfg: RunCfg, path: str, value: int | list[int]) -> str:
    """Return the message that refuses a run with this value before anything is built, or nothing where it is taken."""
    tree = part = cfg.to_tree()
    *above, name = path.split(".")
    for each in above:
        part = part[each]
    part[name] = value
    try:
        changed = RunCfg.from_tree(tree)
        room.check_room(changed, num_envs=changed.num_envs, device=changed.resolved_device())
    except ValueError as refused:
        return str(refused)
    return ""


def figures(folder: Path, *, commands: int) -> dict[str, float]:
    """Try every whole number, and so many spread over them by a command, in a process of its own."""
    found = dict.fromkeys(("fields", "not_refused", "not_named", "commands", "neither"), 0)
    words: list[tuple[Sequence[str], str]] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(room, "total_bytes", lambda device: LITTLE_BYTES)
        for cfg, brought, numbers in configs():
            for path, is_list in numbers:
                found["fields"] += 1
                name = path.rpartition(".")[2]
                for value in (*HUGE, -1):
                    given = [value, value] if is_list else value
                    said = refusal(cfg, path, given)
                    is_free = path in FREE and value == HUGE[1] or name == "seed" and value > 0
                    found["not_refused"] += not said and not is_free
                    found["not_named"] += bool(said) and name not in said
                    if not is_free:
                        words.append(((*brought, f"{path}={given}".replace(" ", "")), name))
    for brought, name in words[:: -(-len(words) // commands)][:commands]:
        ended = children.start(lambda brought=brought: _train(brought, folder), hangs_s=60).wait()
        wrong = wrong_inputs.verdict(ended, name)
        found["commands"] += 1
        found["neither"] += bool(wrong)
        if wrong:
            print(f"{brought}: {wrong}: {ended.text[-500:]}", flush=True)
    return found


def _train(words: Sequence[str], folder: Path) -> int:
    # In a forked process: what is taken by mistake fills no more of this machine.
    room.total_bytes = lambda device: LITTLE_BYTES
    return wrong_inputs.train(words, folder)


def whole_numbers(part: object, path: str = "") -> Iterator[tuple[str, bool]]:
    """Yield the path of each field of a config that takes a whole number, or a list of them."""
    if isinstance(part, Mapping):
        for name, value in part.items():
            yield from whole_numbers(value, f"{path}.{name}")
    if not dataclasses.is_dataclass(part) or isinstance(part, type):
        return
    hints = typing.get_type_hints(type(part))
    for field in dataclasses.fields(part):
        below = f"{path}.{field.name}".removeprefix(".")
        kinds = list(_kinds(hints[field.name]))
        lists = [kind for kind in kinds if typing.get_origin(kind) is tuple]
        if int in kinds:
            yield below, False
        elif any(int in _kinds(typing.get_args(kind)[0]) for kind in lists):
            yield below, True
        yield from whole_numbers(getattr(part, field.name), below)


def _kinds(hint: Annotation) -> Iterator[Annotation]:
    """Yield the alternatives of a hint."""
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        for option in typing.get_args(hint):
            yield from _kinds(option)
    else:
        yield hint
