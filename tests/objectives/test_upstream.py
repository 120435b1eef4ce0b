"""What objectives uses of TorchRL and torch beyond their documents is still there; each failure names what moved."""

import inspect

import pytest
import torch
from torchrl import objectives

from ksim_rl.objectives import upstream

METHODS = [(kind, name) for kind, methods in upstream.INHERITED.items() for name in methods]


@pytest.mark.parametrize(("kind", "name"), METHODS)
def test_inherited_methods_take_the_same_arguments(kind, name):
    arguments, _ = upstream.INHERITED[kind][name]
    method = getattr(kind, name, None)
    assert method is not None, f"{kind.__name__}.{name} is gone"
    assert " ".join(inspect.signature(method).parameters) == arguments, f"{kind.__name__}.{name} changed"


def test_properties_and_list_kernels_are_there():
    gone = [
        name
        for name in upstream.READ
        if not isinstance(getattr(objectives.ClipPPOLoss, name, None), property)
    ]
    gone += [name for name in upstream.FOREACH if not hasattr(torch, name)]
    assert not gone
