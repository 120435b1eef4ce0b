"""Numbers that no run can have, for every whole number that a config takes: none may hang, fill memory or end badly."""

import dataclasses
import types
import typing
from collections.abc import Iterator, Mapping, Sequence

from ksim_rl import conf
from ksim_rl.checked import Annotation
from ksim_rl.trainers import RunCfg

# Beyond 32 bits, and just within them.
HUGE = (10**12, 2 * 10**9)
# No memory and no time within an iteration depends on these, so that any number of 32 bits is as good as another.
FREE = frozenset(
    {
        "collector.warmup",
        "data.learning_starts",
        "objective.max_skipped_steps",
        "objective.policy_delay",
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
    (("modules=lstm",), ("modules", "objective", "data")),
    (
        (
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


def words() -> Iterator[tuple[str, Sequence[str], str]]:
    """Yield each wrong number as words of the command line: its name, the words, and what the line has to name."""
    for _, brought, numbers in configs():
        for path, is_list in numbers:
            for value in (*HUGE, -1, 0):
                # A run that goes on for ever is what was asked for.
                if path == "trainer.num_iterations" and value == HUGE[1]:
                    continue
                word = f"{path}={[value, value] if is_list else value}".replace(" ", "")
                yield word, (*brought, word), path.rpartition(".")[2]


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
