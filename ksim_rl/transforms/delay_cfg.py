"""How long a signal is under way."""

from dataclasses import dataclass

from ksim_rl import checks


@dataclass(frozen=True, kw_only=True)
class DelayCfg:
    """A lag in env steps, drawn uniformly from {min_lag, ..., max_lag}.

    Args:
        min_lag, max_lag: env steps, both included.
        per_env: True draws a lag per env when that env resets. False draws one lag for all envs; it changes when all
            envs reset at once, not when some do.
        resample_every: env steps after which a new lag is drawn within an episode; 0 keeps it. Counted per env since
            its reset, or since all envs last reset together.
        hold_probability: chance that such a draw leaves the lag as it is.
        by_level: whether the transform's level (see `FollowsLevel`) sets the reach: lags are drawn from
            {min_lag, ..., min_lag + round(level * (max_lag - min_lag))}.
    """

    min_lag: int = 0
    max_lag: int
    per_env: bool = True
    resample_every: int = 0
    hold_probability: float = 0.0
    by_level: bool = False

    def __post_init__(self) -> None:
        for field in ("min_lag", "max_lag", "resample_every"):
            value = getattr(self, field)
            if isinstance(value, bool) or not isinstance(value, int) or value < 0:
                raise ValueError(f"{field}={value!r}: expected a whole number of env steps of at least 0")
        if self.min_lag > self.max_lag:
            raise ValueError(f"min_lag={self.min_lag} exceeds max_lag={self.max_lag}")
        checks.check_in_range("hold_probability", self.hold_probability, low=0.0, high=1.0)
        if self.hold_probability and not self.resample_every:
            raise ValueError(
                f"hold_probability={self.hold_probability} without resample_every: there is no draw to hold"
            )
