"""This module finds the parts of an env that draw themselves into its pictures."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from typing import Protocol

from ksim_rl.envs.manager_based_rl_env_cfg import ManagerBasedRlEnvCfg
from ksim_rl.envs.term import CommandTerm, RewardTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.scene.rendering.visualizer import DebugVisualizer
from ksim_rl.scene.sensors import SensorTracker


class Drawing(Protocol):
    """What draws one env's quantities."""

    def draw_debug(self, view: EnvView, visualizer: DebugVisualizer, env_index: int) -> None:
        """Draw those of one env."""
        ...


def drawings(
    cfg: ManagerBasedRlEnvCfg, sensors: Mapping[str, SensorTracker], rewards: Collection[str]
) -> dict[str, Drawing]:
    """Return what draws itself and that `viewer.draw` asks for, by "commands/<name>", "rewards/..." or "sensors/...".

    Args:
        cfg: of the env.
        sensors: the readers of its sensors.
        rewards: the rewards that are computed; others have no quantities to draw.
    """
    found: dict[str, Drawing] = {}
    for room, base, parts in (
        ("commands", CommandTerm, cfg.commands),
        ("rewards", RewardTerm, {name: cfg.rewards[name] for name in rewards}),
        ("sensors", SensorTracker, sensors),
    ):
        found |= {
            f"{room}/{name}": part
            for name, part in parts.items()
            if type(part).draw_debug is not base.draw_debug and _wanted(f"{room}/{name}", cfg.viewer.draw)
        }
    return found


def _wanted(name: str, patterns: Sequence[str]) -> bool:
    return any(re.fullmatch(pattern, name) for pattern in patterns)
