"""Writes the parts of an env as tables to read."""

import dataclasses
import io
from collections.abc import Mapping
from functools import partial
from typing import Any

import torch
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from torchrl.envs.transforms import Transform

from ksim_rl.envs.driver import EnvDriver
from ksim_rl.envs.manager_based_rl_env_cfg import ManagerBasedRlEnvCfg
from ksim_rl.envs.term import EventTerm
from ksim_rl.transforms.groups.group_cfg import compile_groups
from ksim_rl.transforms.specs import spell
from ksim_rl.transforms.transform_cfg import TransformCfg

WIDTH = 120


def explain(
    cfg: ManagerBasedRlEnvCfg,
    driver: EnvDriver,
    *,
    shapes: Mapping[str, torch.Size],
    action_sizes: Mapping[str, int],
    events: Mapping[str, EventTerm],
    levels: Mapping[str, float],
    width: int,
) -> str:
    """Return one table per manager: index, name, shape, weight, mode and parameters other than defaults of each term.

    `shapes` are of observation terms, [E, ...], and `action_sizes` are numbers of columns; lines are `width` long.
    """
    output = io.StringIO()
    console = Console(
        file=output,
        force_jupyter=False,
        width=width,
        highlight=False,
        markup=False,
        color_system=None,
    )
    show = partial(_show, console)
    # Inputs and outputs of the policy first, then what rates and disturbs it.
    console.print(_summary(cfg, driver))
    for group, group_cfg in cfg.observations.items():
        rows = []
        widths = []
        for name, term_cfg in group_cfg.terms.items():
            shape = tuple(shapes[name][1:])
            # History stacks frames of a vector side by side.
            if len(shape) == 1:
                shape = (shape[0] * group_cfg.num_frames(name),)
            widths.append(shape)
            # Noise, delay, history and the like of this group.
            chain = _parameters(term_cfg, without=("term",))
            rows.append((name, str(shape), chain, _described(term_cfg.term)))
        # An image stands alone in its group; vectors are concatenated.
        # The shape that the policy sees under the group's key.
        whole = widths[0]
        if len(widths) > 1:
            whole = (sum(shape[0] for shape in widths),)
        if group_cfg.num_stacked is not None:
            whole = (group_cfg.num_stacked, *whole)
        show(f"observations/{group} {whole}", ("term", "shape", "chain", "parameters"), rows)

    rows = [
        (name, f"({action_sizes[name]},)", _described(term)) for name, term in cfg.actions.items()
    ]
    show(f"actions ({sum(action_sizes.values())},)", ("term", "shape", "parameters"), rows)

    rows = [
        (name, f"({driver.readings.commands[name].shape[-1]},)", _seconds(term.resampling_time_range_s, "at resets"),
         _described(term, without=("resampling_time_range_s",)))
        for name, term in cfg.commands.items()
    ]  # fmt: skip
    show("commands", ("term", "shape", "resampled every", "parameters"), rows)

    weights = driver.readings.reward_weights
    # The present weights, which a curriculum may have changed.
    shown = {
        name: f"{float(weights[name]):g}" if name in weights else "0: not computed"
        for name in cfg.rewards
    }
    rows = [
        (name, shown[name], _described(term, ("weight",))) for name, term in cfg.rewards.items()
    ]
    if cfg.scale_rewards_by_dt:
        # Weights are per second then, and a step adds this share.
        scaled = f"times {driver.step_dt:g} s"
    else:
        scaled = "per step"
    show(f"rewards ({scaled})", ("term", "weight", "parameters"), rows)

    if cfg.is_finite_horizon:
        ends = "terminated"
    else:
        ends = "truncated"
    rows = [
        (name, ends if term.time_out else "terminated", _described(term, ("time_out",)))
        for name, term in cfg.terminations.items()
    ]
    # The guard is no term of the config, but ends episodes like one.
    rows.append(("non_finite", "terminated", "always: the physics or the action is not finite"))
    show("terminations", ("term", "marks", "parameters"), rows)

    rows = [
        (
            name,
            term.mode,
            _seconds(term.interval_range_s, ""),
            _described(term, ("mode", "interval_range_s")),
        )
        for name, term in events.items()
    ]
    show("events", ("term", "mode", "every", "parameters"), rows)

    rows = [(name, f"{levels[name]:g}", _described(term)) for name, term in cfg.curriculum.items()]
    show("curriculum", ("term", "level", "parameters"), rows)

    rows = [
        (name, term.reduce, _described(term, ("reduce",))) for name, term in cfg.metrics.items()
    ]
    show("metrics", ("term", "reduced by", "parameters"), rows)

    # Groups first, as observations pass them first.
    rows = []
    for transform in compile_groups(cfg.observations):
        rows.append(("(groups)", _keys(transform), type(transform).__name__))
    for name, transform_cfg in cfg.transforms.items():
        rows.append((name, _keys(transform_cfg.build()), _call(transform_cfg)))
    show("transforms (actions pass them from last to first)", ("term", "keys", "parameters"), rows)
    return "\n".join(line.rstrip() for line in output.getvalue().splitlines()) + "\n"


def _summary(cfg: ManagerBasedRlEnvCfg, driver: EnvDriver) -> str:
    length = f"{cfg.episode_length_s:g} s = {driver.max_episode_length} steps"
    return (
        f"{driver.num_envs} envs on {driver.device}, "
        f"{driver.step_dt:g} s per step = {cfg.decimation} x {driver.physics_dt:g} s, "
        f"episodes of {length if driver.max_episode_length else 'any length'}\n"
        + "\n".join((*driver.world.explained(), *_hooks(driver)))
        + "".join(f"\n{line}" for line in driver.non_finite.lines())
    )


def _hooks(driver: EnvDriver) -> list[str]:
    """Return a line where parts of the env, such as motor models, run between substeps."""
    before = len(driver.before_substep)
    after = len(driver.after_substep)
    if not before and not after:
        return []
    return [f"substeps are launched one by one, for {before} hooks before and {after} after each"]


def _keys(transform: Transform) -> str:
    """Return the keys that a transform reads and, if they differ, the keys that it writes."""
    keys = [
        [*transform.in_keys, *transform.in_keys_inv],
        [*transform.out_keys, *transform.out_keys_inv],
    ]
    reads, writes = (", ".join(map(spell, part)) for part in keys)
    # A transform in place needs no arrow.
    if reads == writes:
        return reads
    return f"{reads} -> {writes}"


def _call(described: TransformCfg) -> str:
    parts = (f"{name}={_shown(value)}" for name, value in described.given().items())
    return f"{described.transform.__name__}({', '.join(parts)})"


def _show(
    console: Console, title: str, columns: tuple[str, ...], rows: list[tuple[str, ...]]
) -> None:
    table = Table(
        title=title, title_justify="left", title_style="", box=SIMPLE_HEAD, pad_edge=False
    )
    table.add_column("index", justify="right", no_wrap=True)
    for column in columns:
        table.add_column(column, no_wrap=column == "term", overflow="fold")
    for index, row in enumerate(rows):
        table.add_row(str(index), *row)
    if not rows:
        # An empty manager has a row, so that one sees that it is empty on purpose.
        table.add_row("-", "none", *[""] * (len(columns) - 1))
    console.print(table)


def _described(term: Any, without: tuple[str, ...] = ()) -> str:
    """Return the class of a term and its parameters."""
    if not dataclasses.is_dataclass(term):
        return repr(term)
    return f"{type(term).__name__}({_parameters(term, without=without)})"


def _parameters(value: Any, *, without: tuple[str, ...] = ()) -> str:
    """Return the fields of a dataclass that differ from their defaults."""
    parts = []
    for field in dataclasses.fields(value):
        given = getattr(value, field.name)
        default = field.default
        if field.default_factory is not dataclasses.MISSING:
            # A default from a factory is another object each time, and compared by value.
            default = field.default_factory()
        if field.name not in without and given != default:
            parts.append(f"{field.name}={_shown(given)}")
    return ", ".join(parts)


def _shown(value: Any) -> str:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return f"{type(value).__name__}({_parameters(value)})"
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{key}: {_shown(entry)}" for key, entry in value.items()) + "}"
    if isinstance(value, (tuple, list)):
        return "(" + ", ".join(_shown(entry) for entry in value) + ")"
    if isinstance(value, float):
        return f"{value:.6g}"
    return str(value)


def _seconds(pair: tuple[float, float] | None, otherwise: str) -> str:
    if pair is None:
        return otherwise
    low, high = pair
    if low == high:
        return f"{low:g} s"
    return f"{low:g} to {high:g} s"
