"""Parameters and moments of an update in the flat and padded forms that the kernels read."""

import torch
from torch.nn import functional

from ksim_rl.objectives.fused_ppo.dataset import as_tf32
from ksim_rl.objectives.fused_ppo.layout import FusedLayout, FusedNetworks

MOMENTS = "exp_avg", "exp_avg_sq"


class FusedParameters:
    """Flat and padded forms (see `FusedLayout`) of the tensors that an update changes.

    Parameters of the modules and moments of the optimizer are views of the flat form: checkpoints, evaluation and
    collection see the same as ever. `load` makes the padded form of it, and `store` tells how many steps were made.
    """

    def __init__(
        self,
        networks: FusedNetworks,
        layout: FusedLayout,
        *,
        optimizer: torch.optim.Adam,
        dtype: torch.dtype,
        tf32: bool,
        num_steps: int,
        size: int,
    ) -> None:
        self._parameters = networks.parameters
        self._optimizer = optimizer
        self._tf32 = tf32
        device = self._parameters[0].device
        padding = -layout.num_flat % size
        # Parameters, and the optimizer's means and variances, each [N] and zeros up to a whole number of `size`.
        self.flat = [torch.zeros(layout.num_flat + padding, device=device) for _ in range(3)]
        sizes = [own.numel() for own in self._parameters]
        self._views = [flat[: layout.num_flat].split(sizes) for flat in self.flat]
        self._index = layout.padded_index(networks).to(device, torch.int64)  # as torch takes it
        self.places = functional.pad(self._index, (0, padding)).to(torch.int32)
        # The parameters in padded form, in float32 and in the dtype of the products.
        self.exact = torch.zeros(2, layout.num_padded, device=device)
        self.weights = torch.zeros(2, layout.num_padded, dtype=dtype, device=device)
        # The biases of both networks in float32; rows are as far apart as in `exact`.
        self.biases_2N = self.exact[:, layout.num_weights :]
        # The optimizer's number of steps before the first gradient step of the update, and after each.
        self.steps = torch.zeros(num_steps + 1, device=device)
        for parameter in self._parameters:
            if parameter not in optimizer.state:
                moments = {name: torch.zeros_like(parameter) for name in MOMENTS}
                optimizer.state[parameter] = {"step": torch.zeros((), device=device), **moments}
        self.load()

    @torch.no_grad()
    def load(self) -> None:
        """Take over the parameters of the modules and the state of the optimizer."""
        for parameter, *views in zip(self._parameters, *self._views, strict=True):
            state = self._optimizer.state[parameter]
            held = [parameter, *(state[name] for name in MOMENTS)]
            # Elsewhere at first, and where torch has loaded the optimizer's state.
            if any(
                own.data_ptr() != view.data_ptr() for own, view in zip(held, views, strict=True)
            ):
                views = [
                    view.copy_(own.flatten()).view_as(own)
                    for own, view in zip(held, views, strict=True)
                ]
                parameter.data, *moments = views
                state.update(zip(MOMENTS, moments, strict=True))
        self.steps[0].copy_(self._optimizer.state[self._parameters[0]]["step"])
        self.exact.view(-1)[self._index] = self.flat[0][: len(self._index)]
        self.weights.copy_(as_tf32(self.exact) if self._tf32 else self.exact)

    @torch.no_grad()
    def store(self) -> None:
        """Give the optimizer the number of steps after the last gradient step."""
        counts = [self._optimizer.state[parameter]["step"] for parameter in self._parameters]
        torch._foreach_copy_(counts, [self.steps[-1]] * len(counts))
