"""What data uses of TorchRL beyond its documents is still there; each failure names what moved.

It is inherited, so that it cannot be hidden behind functions of the room. Checked with TorchRL 0.14.1.
"""

import inspect

import pytest
import torch
from torchrl.data import LazyTensorStorage, ReplayBuffer
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
    (
        TensorStorage,
        "_bump_mutation_revision",
        "self",
        "tells who caches that the content is another",
    ),
    (Writer, "_empty", "self empty_write_count", "overridden: what `empty` of a buffer calls"),
]
# Instance attributes of a TensorStorage that `DatasetStorage` sets when it allocates and writes.
SET = ("_storage", "_len")


@pytest.mark.parametrize(("kind", "name", "arguments"), [row[:3] for row in INHERITED])
def test_inherited_members_are_what_they_were(kind, name, arguments):
    member = getattr(kind, name, None)
    assert member is not None, f"{kind.__name__}.{name} is gone"
    if arguments is not None:
        assert " ".join(inspect.signature(member).parameters) == arguments, (
            f"{kind.__name__}.{name} changed"
        )


def test_a_storage_keeps_its_content_and_length_where_they_were():
    storage = LazyTensorStorage(3)
    storage.set(range(2), torch.zeros(2, 4))
    gone = [name for name in SET if getattr(storage, name, None) is None]
    assert not gone
    assert storage._storage.shape == (3, 4) and storage._len == 2
