"""This module lists what `data` uses of TorchRL beyond its documented interfaces.

They are inherited, so that they cannot be hidden behind functions. `tests/data/test_upstream.py` names the one that a
new version moved. Checked with TorchRL 0.14.1.
"""

from torchrl.data import ReplayBuffer
from torchrl.data.replay_buffers import Sampler, TensorStorage, Writer
from torchrl.data.replay_buffers.storages import Storage

# By class: methods with their arguments, or attributes without, and why they are needed.
INHERITED: list[tuple[type, str, str | None, str]] = [
    (
        ReplayBuffer,
        "_sample",
        "self args kwargs",
        "a sample of any size, and its info, as the buffer collates it",
    ),
    (Sampler, "_empty", "self", "overridden: what `empty` of a buffer calls"),
    (Sampler, "_remaining_batches", None, "set: what iterating over a buffer reads"),
    (Storage, "_empty", "self", "overridden: what `empty` of a buffer calls"),
    (TensorStorage, "_bump_mutation_revision", "self", "tells who caches that the content is another"),
    (Writer, "_empty", "self empty_write_count", "overridden: what `empty` of a buffer calls"),
]
# Instance attributes of a TensorStorage that `DatasetStorage` sets when it allocates and writes.
SET = ("_storage", "_len")
