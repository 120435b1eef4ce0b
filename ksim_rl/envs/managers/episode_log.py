"""Sums over finished episodes, kept on the device until the trainer reads them."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ksim_rl.envs.managers.metric_manager import MetricManager
from ksim_rl.envs.managers.reward_manager import RewardManager
from ksim_rl.envs.managers.termination_manager import TerminationManager
from ksim_rl.envs.view import EnvView


class EpisodeLog:
    """One vector of sums over the episodes that ended since the last `clear`.

    Entries: `episodes` (count), `length_sum` (env steps), `return_sum`, `reward/<term>` (weighted sums over the
    episode), `termination/<term>` (counts), `metric/<term>` (reduced values).
    """

    def __init__(
        self,
        view: EnvView,
        rewards: RewardManager,
        terminations: TerminationManager,
        metrics: MetricManager,
    ) -> None:
        self._view, self._rewards, self._terminations, self._metrics = view, rewards, terminations, metrics
        self.names = (
            "episodes",
            "length_sum",
            "return_sum",
            *(f"reward/{name}" for name in rewards.names),
            *(f"termination/{name}" for name in terminations.names),
            *(f"metric/{name}" for name in metrics.names),
        )
        self.totals_N = torch.zeros(len(self.names), device=view.device)

    def step(self, done_E: Bool[Tensor, " E"]) -> None:
        """Add the episodes that end now, bool [E]."""
        done_E1 = done_E[:, None]
        sums_ER = self._rewards.episode_sums_ER
        rows_EN = torch.cat(
            (
                torch.ones_like(done_E1, dtype=torch.float32),
                self._view.episode_step_E[:, None],
                sums_ER.sum(-1, keepdim=True),
                sums_ER,
                self._terminations.flags_EK,
                self._metrics.reduced_EM,
            ),
            dim=-1,
        )
        self.totals_N.add_(torch.where(done_E1, rows_EN, 0.0).sum(0))

    def read(self) -> dict[str, Float[Tensor, ""]]:
        """Return the sums by name, float32 [] each, still on the device."""
        return dict(zip(self.names, self.totals_N.unbind(), strict=True))

    def clear(self) -> None:
        """Start anew."""
        self.totals_N.zero_()
