"""Finds the keys of an env's reward and of its flags for the end of an episode."""

from typing import NamedTuple

from tensordict import TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torchrl.envs import EnvBase


class SignalKeys(NamedTuple):
    """Keys of an env's signals below "next"; an env that never truncates has no such key."""

    reward: NestedKey = "reward"
    done: NestedKey = "done"
    terminated: NestedKey = "terminated"
    truncated: NestedKey | None = "truncated"

    @property
    def following(self) -> list[NestedKey]:
        """The keys of reward, done and terminated in an env state."""
        return [unravel_key(("next", key)) for key in self[:3] if key is not None]

    def renamed(self, rollout_ET: TensorDictBase) -> TensorDictBase:
        """Return a copy of the tree, not of the tensors, with reward, done and terminated under TorchRL's names too."""
        rollout_ET = rollout_ET.copy()
        for key, own in zip(STANDARD.following, self.following, strict=True):
            # The same tensors under a second name; nothing is copied.
            rollout_ET.set(key, rollout_ET.get(own))
        return rollout_ET


STANDARD = SignalKeys()


def signal_keys(env: EnvBase) -> SignalKeys:
    """Return an env's own keys, nested ones too: of those with one name, the one that lies highest.

    Raises ValueError where the env has several rewards, or none.
    """
    if len(env.reward_keys) != 1:
        raise ValueError(
            f"{type(env).__name__} has the rewards {env.reward_keys}: expected one; add them up, e.g. by TorchRL's "
            "LineariseRewards"
        )
    # `done_keys` are sorted by depth, so the first match lies highest; nested keys end with the name.
    done, terminated, truncated = (
        next((key for key in env.done_keys if key == name or key[-1] == name), None)
        for name in ("done", "terminated", "truncated")
    )
    # An env may have only one of the two; then it stands for both.
    ended = done or terminated
    assert ended is not None, "TorchRL completes the flags of every env"
    return SignalKeys(env.reward_keys[0], ended, terminated or ended, truncated)
