"""Checks step counts of a config against the length of an episode, which depends on the model's time step."""

import math
from collections.abc import Iterator

from ksim_rl.envs.manager_based_rl_env_cfg import ManagerBasedRlEnvCfg
from ksim_rl.transforms.delay import DelayCfg

# Steps are counted in int32 on the device.
MOST_STEPS = 2**31 - 1


def episode_steps(cfg: ManagerBasedRlEnvCfg, step_dt: float) -> int:
    """Return the env steps of `step_dt` seconds after which an episode is cut; 0 for never.

    Raises ValueError for more than are counted, and for a delay longer than an episode.
    """
    steps = cfg.episode_length_s / step_dt
    # Written so that NaN is refused, too.
    if not steps <= MOST_STEPS:
        raise ValueError(
            f"episode_length_s={cfg.episode_length_s:g} is {steps:.3g} env steps of {step_dt:g} s: expected at most "
            f"{MOST_STEPS}; raise sim.timestep, or shorten the episodes"
        )
    # Rounding first keeps 20 s / 0.02 s at 1000 steps in floating point.
    count = math.ceil(round(steps, 6))
    for where, delay in _delays(cfg):
        # Without a time limit (0) any delay ends at some time.
        if 0 < count <= delay.max_lag:
            raise ValueError(
                f"{where}.delay.max_lag={delay.max_lag}: an episode has {count} env steps, so that nothing would "
                "arrive in it; shorten the delay, or lengthen the episodes"
            )
    return count


def _delays(cfg: ManagerBasedRlEnvCfg) -> Iterator[tuple[str, DelayCfg]]:
    for name, group in cfg.observations.items():
        if group.delay is not None:
            yield f"observations.{name}", group.delay
        for key, term in group.terms.items():
            if term.delay is not None:
                yield f"observations.{name}.terms.{key}", term.delay
    # Transforms have a delay only as an argument of that name.
    for name, transform in cfg.transforms.items():
        delay = transform.arguments.get("delay")
        if isinstance(delay, DelayCfg):
            yield f"transforms.{name}", delay
