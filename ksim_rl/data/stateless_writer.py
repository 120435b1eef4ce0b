"""This module has a writer without a state of its own: its storage knows all that there is to know."""

from typing import Any

from torchrl.data.replay_buffers import Writer


class StatelessWriter(Writer):
    """A TorchRL writer without a state of its own: what it writes, and where the next goes, is the storage's."""

    def state_dict(self) -> dict[str, Any]:
        """Return nothing."""
        return {}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Read nothing."""

    def dumps(self, path: Any) -> None:
        """Write nothing."""

    def loads(self, path: Any) -> None:
        """Read nothing."""

    def _empty(self, empty_write_count: bool = True) -> None:
        """Forget nothing."""
