"""The parts of an env that draw themselves into its pictures."""

import re
from collections.abc import Collection, Mapping

from ksim_rl.envs.driver import EnvDriver
from ksim_rl.envs.manager_based_rl_env_cfg import ManagerBasedRlEnvCfg
from ksim_rl.envs.term import CommandTerm, RewardTerm
from ksim_rl.scene.rendering.visualizer import DebugVisualizer
from ksim_rl.scene.sensors import SensorTracker

Drawing = CommandTerm | RewardTerm | SensorTracker


def drawings(
    cfg: ManagerBasedRlEnvCfg, sensors: Mapping[str, SensorTracker], rewards: Collection[str]
) -> dict[str, Drawing]:
    """Return the parts that draw themselves and that `viewer.draw` names, by "commands/<name>", "rewards/..." etc.

    `sensors` are the readers of the env's, and `rewards` those that are computed; others have no quantities to draw.
    """
    found: dict[str, Drawing] = {}
    # Names are "<room>/<name>", as in `viewer.draw`.
    for room, base, parts in (
        ("commands", CommandTerm, cfg.commands),
        ("rewards", RewardTerm, {name: cfg.rewards[name] for name in rewards}),
        ("sensors", SensorTracker, sensors),
    ):
        for name, part in parts.items():
            # A part that keeps the empty `draw_debug` of its base draws nothing.
            wanted = any(re.fullmatch(pattern, f"{room}/{name}") for pattern in cfg.viewer.draw)
            if wanted and type(part).draw_debug is not base.draw_debug:
                found[f"{room}/{name}"] = part
    return found


def draw(
    driver: EnvDriver,
    parts: Mapping[str, Drawing],
    visualizer: DebugVisualizer,
    *,
    env_index: int,
    drawn: Collection[str] | None,
) -> None:
    """Let parts draw one env, all of them or only the ones named in `drawn`; a ValueError names one that moves it."""
    # Drawing must not move the robot. Only torch's writes, as the other check would slow each picture down.
    with driver.guard.watching(past_torch=False):
        for name, part in parts.items():
            if drawn is not None and name not in drawn:
                continue
            with driver.scope(name, part=part):
                part.draw_debug(driver.view, visualizer, env_index)
