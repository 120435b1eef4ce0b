"""What data uses of TorchRL beyond its documents is still there; each failure names what moved."""

import inspect

import pytest
import torch
from torchrl.data import LazyTensorStorage

from ksim_rl.data import upstream


@pytest.mark.parametrize(("kind", "name", "arguments"), [row[:3] for row in upstream.INHERITED])
def test_inherited_members_are_what_they_were(kind, name, arguments):
    member = getattr(kind, name, None)
    assert member is not None, f"{kind.__name__}.{name} is gone"
    if arguments is not None:
        assert " ".join(inspect.signature(member).parameters) == arguments, f"{kind.__name__}.{name} changed"


def test_a_storage_keeps_its_content_and_length_where_they_were():
    storage = LazyTensorStorage(3)
    storage.set(range(2), torch.zeros(2, 4))
    gone = [name for name in upstream.SET if getattr(storage, name, None) is None]
    assert not gone
    assert storage._storage.shape == (3, 4) and storage._len == 2
