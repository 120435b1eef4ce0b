"""Configures which of a training's episodes are kept, and which leaves."""

from dataclasses import dataclass

from ksim_rl.checked import Checked, Count, WholeNumber


@dataclass(frozen=True, kw_only=True)
class RecorderCfg(Checked):
    """A recorder of a run: whole episodes of its rollouts go to `episodes/NAME` in the run folder.

    Attributes:
        num_episodes: after so many nothing more is recorded.
        num_envs: the first ones of the run, of its first rank; each gives as many episodes, give or take one.
        from_iteration: the first iteration whose rollout is recorded.
        keys: leaves, such as "actor" or "next/reward", to which "next/done" is added; None for all that the env gives.
    """

    num_episodes: Count = 1000
    num_envs: Count = 16
    from_iteration: WholeNumber = 1
    keys: tuple[str, ...] | None = None

    @property
    def episodes_E(self) -> list[int]:
        """How many episodes each env gives."""
        return shared(self.num_episodes, self.num_envs)


def shared(num_episodes: int, num_envs: int) -> list[int]:
    """Return how many episodes each env gives: as many, give or take one."""
    each, rest = divmod(num_episodes, num_envs)
    return [each + (env < rest) for env in range(num_envs)]
