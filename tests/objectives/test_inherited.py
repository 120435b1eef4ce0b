"""What objectives uses of TorchRL and torch beyond their documents is still there; each failure names what moved.

These are methods that losses inherit and override, so that they cannot be hidden behind functions of the room. Checked
with TorchRL 0.14.1 and torch 2.10 to 2.14.
"""

import inspect

import pytest
import torch
from torchrl import objectives
from torchrl.objectives.common import LossModule

# Methods by their class, each with its arguments and the reason.
INHERITED: dict[type, dict[str, tuple[str, str]]] = {
    LossModule: {
        "_loss_mask_keys": ("self", "which masks the user chose; there is no public reader"),
        "_expand_loss_mask": ("mask loss", "gives a mask the shape of a loss"),
        "_forward_value_estimator_keys": ("self kwargs", "abstract: each loss has to define it"),
    },
    objectives.ClipPPOLoss: {
        "_log_weight": (
            "self tensordict adv_shape",
            "log ratios, for all distributions and proximal policies",
        ),
        "_maybe_normalize_advantage": (
            "self advantage tensordict update_norm",
            "the options of normalization",
        ),
        "_standardize_advantage": (
            "self advantage tensordict",
            "overridden: masked rows have no part in it",
        ),
        "_critic_loss_inputs": (
            "self target_return state_value old_state_value",
            "overridden: sequences [B, T]",
        ),
        "_get_entropy": ("self dist adv_shape", "overridden: the stock one asks the host"),
        "_weighted_loss_entropy": ("self entropy", "the entropy coefficients of several actions"),
        "_reduce_loss": (
            "self loss tensordict mask reduction weights",
            "reductions other than the mean",
        ),
        "_clear_weakrefs": ("self tds", "frees functional parameters as the stock forward does"),
    },
}
# Properties of TorchRL's `ClipPPOLoss` that its forward reads as well.
READ = ("_clip_bounds", "_cached_critic_network_params_detached")
# torch's kernels over lists of tensors, which its own optimizers are made of: one launch for all leaves of a dtype.
FOREACH = ("_foreach_copy_", "_foreach_lerp_", "_foreach_mul_")
METHODS = [(kind, name) for kind, methods in INHERITED.items() for name in methods]


@pytest.mark.parametrize(("kind", "name"), METHODS)
def test_inherited_methods_take_the_same_arguments(kind, name):
    arguments, _ = INHERITED[kind][name]
    method = getattr(kind, name, None)
    assert method is not None, f"{kind.__name__}.{name} is gone"
    assert " ".join(inspect.signature(method).parameters) == arguments, (
        f"{kind.__name__}.{name} changed"
    )


def test_properties_and_list_kernels_are_there():
    gone = [
        name
        for name in READ
        if not isinstance(getattr(objectives.ClipPPOLoss, name, None), property)
    ]
    gone += [name for name in FOREACH if not hasattr(torch, name)]
    assert not gone
