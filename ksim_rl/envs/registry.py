"""Finds the tasks by name, for Python and for the Hydra config group `task`, and builds their envs."""

import dataclasses
import importlib
import pkgutil
from collections.abc import Mapping, Sequence
from functools import cache

import torch
from tensordict import NestedKey
from tensordict.utils import unravel_key
from torchrl.envs.transforms import Transform

from ksim_rl.checks import check_known, naming, near
from ksim_rl.config import plugins
from ksim_rl.config.config_tree import from_tree, to_tree
from ksim_rl.config.trees import Tree
from ksim_rl.device.room import check_room
from ksim_rl.envs.manager_based_rl_env import ManagerBasedRlEnv
from ksim_rl.envs.manager_based_rl_env_cfg import ManagerBasedRlEnvCfg
from ksim_rl.envs.managers.replaced_fields import check_not_replaced
from ksim_rl.envs.masked_transformed_env import MaskedTransformedEnv
from ksim_rl.envs.specs import misfit
from ksim_rl.envs.task import Task
from ksim_rl.transforms.groups.group_cfg import compile_groups
from ksim_rl.transforms.row_transform import follow_level, seed_transforms

# Imported by name when tasks are first asked for: they stand above this room and import it.
OWN_TASKS = ("ksim_rl.tasks", "ksim_rl.suites", "ksim_rl.tracking")


def _tasks() -> dict[str, Task]:
    # The names are the key of the cache: a plug-in that comes later brings its tasks.
    return _tasks_with(plugins.named())


@cache
def _tasks_with(_named: tuple[str, ...]) -> dict[str, Task]:
    """Import all task modules once, ours and other packages', and collect their `Task`s."""
    found: dict[str, tuple[str, Task]] = {}
    packages = map(importlib.import_module, OWN_TASKS)
    # Ours first, so that a task of another package cannot take the place of one of ours.
    inside = (
        info for own in packages for info in pkgutil.iter_modules(own.__path__, f"{own.__name__}.")
    )
    ours = ((info.name, importlib.import_module(info.name)) for info in inside)
    for origin, module in (*ours, *plugins.modules(plugins.TASKS)):
        held = [value for value in vars(module).values() if isinstance(value, Task)]
        for value in (*held, *vars(module).get("TASKS", ())):
            first, known = found.setdefault(value.name, (origin, value))
            # The same object may be imported into several modules; only another task is refused.
            if known is not value:
                raise ValueError(
                    f"two tasks are called {value.name!r}: in {first} and in {origin}; rename one"
                )
    return {name: task for name, (_, task) in sorted(found.items())}


def names() -> list[str]:
    """Return the names of the registered tasks."""
    return list(_tasks())


def task(name: str) -> Task:
    """Return a task by name; a ValueError gives the near names."""
    tasks = _tasks()
    check_known("task", name, tasks)
    return tasks[name]


def cfg_of(name: str) -> ManagerBasedRlEnvCfg:
    """Return a task's config as it is registered; a ValueError names the task, as where its robot cannot be read."""
    with naming(f"task {name!r}"):
        return task(name).cfg()


def register_configs() -> None:
    """Store each task's config tree in Hydra's config group `task`."""
    # Hydra takes a while to load, which an env without overrides does not need.
    from ksim_rl.envs import composed

    composed.register(tuple(names()), _tree)


def _tree(name: str) -> Tree:
    return to_tree(cfg_of(name), ManagerBasedRlEnvCfg)


def make_cfg(name: str, overrides: Sequence[str] = ()) -> ManagerBasedRlEnvCfg:
    """Return a task's config with Hydra overrides applied, such as `"task.rewards.upright.weight=0.5"`.

    A ValueError names the task or field that does not exist, or the value that is not valid, before models compile.
    """
    # Without Hydra, which takes long to load.
    if not overrides:
        return cfg_of(name)
    from ksim_rl.envs import composed

    register_configs()
    tree = composed.with_overrides(name, _tree, overrides)
    cfg = from_tree(ManagerBasedRlEnvCfg, tree, "task")
    check_not_replaced(cfg.curriculum, overrides)
    return cfg


def build(
    cfg: ManagerBasedRlEnvCfg, *, device: str | torch.device = "cpu", render_mode: str | None = None
) -> MaskedTransformedEnv:
    """Build the env of a config, with the transforms that its observation groups ask for and its own after them.

    A ValueError names the transform that does not fit the env.
    """
    check_room(cfg, num_envs=cfg.scene.num_envs, device=torch.device(device), path="task")
    base_env = ManagerBasedRlEnv(cfg, device=device, render_mode=render_mode)
    level = base_env.view.level
    env = MaskedTransformedEnv(base_env, compile_groups(cfg.observations, level=level))
    foreign: dict[str, Transform] = {}
    for name, described in cfg.transforms.items():
        transform = described.build(name)
        # Transforms of others are tried out below, ours and TorchRL's are not.
        if not type(transform).__module__.startswith(("ksim_rl.", "torchrl.")):
            foreign[name] = transform
        # Transforms that scale with difficulty read the env's own tensor.
        follow_level([transform], level)
        try:
            _check_reads(transform, env)
            env.append_transform(transform)
            # Specs that are made show what does not fit.
            assert env.output_spec is not None and env.input_spec is not None
        except (KeyError, ValueError, RuntimeError, TypeError) as error:
            if isinstance(error, KeyError) and error.args:
                reason = error.args[0]
            else:
                reason = error
            raise ValueError(f"task.transforms.{name}: {reason}") from error
    seed = base_env.cfg.seed
    assert seed is not None  # an env stores the seed that it drew
    if foreign:
        _check_writes(env, foreign)
        base_env.set_seed(seed)  # as if nothing had been reset
    seed_transforms(env, seed)  # alone: the base env has its seed already
    return env


def _check_writes(env: MaskedTransformedEnv, foreign: Mapping[str, Transform]) -> None:
    """Refuse foreign transforms whose outputs in a first root do not match their specs."""
    try:
        # Specs say what a transform declares; only a run shows what it does.
        root = env.reset()
    except Exception as error:
        error.add_note(f"(in the first reset, with task.transforms.{', '.join(foreign)})")
        raise
    spec = env.full_observation_spec
    for key in spec.keys(True, True):
        reason = misfit(root.get(key, None), spec[key])
        writers = [name for name, own in foreign.items() if _writes(own, key)]
        if reason and writers:
            raise ValueError(f"task.transforms.{writers[-1]}: observation {key!r} {reason}")


def _writes(transform: Transform, key: NestedKey) -> bool:
    return unravel_key(key) in {unravel_key(own) for own in transform.out_keys or ()}


def _check_reads(transform: Transform, env: MaskedTransformedEnv) -> None:
    """Refuse a transform that reads a key that the env does not emit; TorchRL would fail in the first step only."""
    specs = (
        env.full_observation_spec,
        env.full_reward_spec,
        env.full_done_spec,
        env.full_action_spec,
    )
    known = {unravel_key(key) for spec in specs for key in spec.keys(True, True)}
    for key in transform.in_keys or ():
        if unravel_key(key) not in known:
            names = sorted(str(one) for one in known)
            raise ValueError(f"{type(transform).__name__} reads {key!r}: {near(str(key), names)}")


def make(
    name: str,
    *,
    num_envs: int,
    device: str | torch.device = "cpu",
    seed: int | None = None,
    overrides: Sequence[str] = (),
    render_mode: str | None = None,
) -> MaskedTransformedEnv:
    """Build a registered task, ready to train on, with keys `"actor"`, `"critic"` (or its own groups), `"action"`.

    `seed` is of all draws; None keeps the task's own, and if that is None too, draws one. `overrides` are Hydra's, of
    the task's config. A ValueError names the task, field or value that is wrong and what would be valid.
    """
    cfg = make_cfg(name, overrides)
    scene = dataclasses.replace(cfg.scene, num_envs=num_envs)
    cfg = dataclasses.replace(cfg, scene=scene, seed=cfg.seed if seed is None else seed)
    return build(cfg, device=device, render_mode=render_mode)
