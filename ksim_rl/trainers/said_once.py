"""Tells the warnings of a run, each kind once."""

from collections.abc import Callable, Mapping, Sequence

from torchrl.envs import EnvBase

from ksim_rl.diagnosis.iteration_warnings import warnings_of
from ksim_rl.envs.contract import EpisodeSums, part
from ksim_rl.trainers.loggers import MetricLogger


class SaidOnce:
    """Passes the first warning of each kind to `say`; the counts of all stay in the metrics."""

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say = say
        self._kinds: set[str] = set()
        self._non_finite_terms = 0.0

    def warn(self, kind: str, text: str) -> None:
        """Say `text`, unless a text of that kind was said before."""
        if kind not in self._kinds:
            self._kinds.add(kind)
            self._say(f"warning: {text}")

    def call(
        self,
        logger: MetricLogger,
        method: Callable[..., None],
        *given: dict[str, float] | int,
        iteration: int,
    ) -> None:
        """Call a logger; a full disk or a server that is gone loses its records, but does not end the run."""
        try:
            method(*given)
        except Exception as error:
            name = type(logger).__name__
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            self.warn(
                name,
                f"the logger {name} failed at iteration {iteration}: {reason}; the run goes on (said once)",
            )

    def warn_of(
        self, losses: Sequence[str], metrics: Mapping[str, float], *, env: EnvBase, iteration: int
    ) -> None:
        """Warn of problems in an iteration: `losses` of physics, and those that its metrics show."""
        texts = warnings_of(losses, metrics)
        num_terms = metrics.get("sum/non_finite_terms", 0.0)
        if num_terms > self._non_finite_terms:
            self._non_finite_terms = num_terms
            sums = part(env, EpisodeSums)
            lines = sums.non_finite_terms() if sums else ()
            for line in lines:
                texts[line.split(":")[0]] = line
        for kind, text in texts.items():
            self.warn(kind, f"{text} (iteration {iteration}; said once)")
