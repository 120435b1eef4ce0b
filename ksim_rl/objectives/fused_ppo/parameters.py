"""This module copies parameters and moments from modules and optimizer into the form of the kernels, and back."""

import torch
from jaxtyping import Float
from torch import Tensor

from ksim_rl.objectives.fused_ppo.layout import FusedLayout, FusedNetworks


class FusedParameters:
    """Flat and padded forms (see `FusedLayout`) of what an update changes.

    Between updates the modules and the optimizer hold the state, so that checkpoints, evaluation and collection see
    what they always see.

    Attributes:
        flat: parameters, and the optimizer's means and variances, each [N].
        exact: the parameters in padded form, [2, P] float32.
        weights: the same in the dtype of the products.
        steps: the optimizer's number of steps before the first gradient step of the update and after each, [steps + 1].

    Args:
        optimizer: Adam; moments that it does not have yet are made.
        dtype: of the products.
        num_steps: gradient steps of an update.
    """

    def __init__(
        self,
        networks: FusedNetworks,
        layout: FusedLayout,
        *,
        optimizer: torch.optim.Adam,
        dtype: torch.dtype,
        num_steps: int,
    ) -> None:
        self._parameters, self._optimizer = networks.parameters, optimizer
        device = self._parameters[0].device
        self.flat = [torch.zeros(layout.num_flat, device=device) for _ in range(3)]
        self._views = [layout.flat_views(flat, networks) for flat in self.flat]
        self.places = layout.padded_index(networks).to(device)
        self.exact = torch.zeros(2, layout.num_padded, device=device)
        self.weights = torch.zeros(2, layout.num_padded, dtype=dtype, device=device)
        self.steps = torch.zeros(num_steps + 1, device=device)
        for parameter in self._parameters:
            if parameter not in optimizer.state:
                optimizer.state[parameter] = {
                    "step": torch.zeros((), device=device),
                    "exp_avg": torch.zeros_like(parameter),
                    "exp_avg_sq": torch.zeros_like(parameter),
                }
        self._num_weights = layout.num_weights

    @property
    def biases_2N(self) -> Float[Tensor, "2 N"]:
        """The biases of both networks in float32; rows are as far apart as those of `exact`."""
        return self.exact[:, self._num_weights :]

    @torch.no_grad()
    def load(self) -> None:
        """Take over what modules and optimizer hold."""
        for views, tensors in zip(self._views, self._held(), strict=True):
            torch._foreach_copy_(views, tensors)
        self.steps[0].copy_(self._optimizer.state[self._parameters[0]]["step"])
        self.exact.view(-1)[self.places] = self.flat[0]
        self.weights.copy_(self.exact)

    @torch.no_grad()
    def store(self) -> None:
        """Hand it back, with the number of steps after the last gradient step."""
        for views, tensors in zip(self._views, self._held(), strict=True):
            torch._foreach_copy_(tensors, views)
        counts = [self._optimizer.state[parameter]["step"] for parameter in self._parameters]
        torch._foreach_copy_(counts, [self.steps[-1]] * len(counts))

    def _held(self) -> list[list[Tensor]]:
        # Looked up each time: loading a checkpoint gives the optimizer other tensors.
        states = [self._optimizer.state[parameter] for parameter in self._parameters]
        moments = [[state[name] for state in states] for name in ("exp_avg", "exp_avg_sq")]
        return [self._parameters, *moments]
