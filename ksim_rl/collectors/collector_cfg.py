"""This module has the options of how rollouts are collected."""

from dataclasses import dataclass

from ksim_rl.checks import check_count


@dataclass(frozen=True, kw_only=True)
class CollectorCfg:
    """Options of `RolloutCollector` that a config may set.

    Attributes:
        require_graphs: on CUDA, fail where CUDA graphs are unavailable instead of running slower with a warning.
        stagger_episodes: at the first reset, spread the time-outs of the envs over an episode's length, where the env
            offers it, so that not all episodes are in the same phase.
        warmup: on CUDA, how many rollouts run eagerly before one is captured; they are ordinary rollouts.
    """

    require_graphs: bool = False
    stagger_episodes: bool = False
    warmup: int = 2

    def __post_init__(self) -> None:
        """Refuse values of another kind, and a warm-up that would capture cold kernels."""
        for field in ("require_graphs", "stagger_episodes"):
            value = getattr(self, field)
            if not isinstance(value, bool):
                raise ValueError(f"{field}={value!r}: expected True or False")
        check_count("warmup", self.warmup)
