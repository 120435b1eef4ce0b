"""Steps AdamW over a network's parameters as one piece of memory: a few kernels, whatever its layers are."""

import math
from collections.abc import Iterable

import torch
from jaxtyping import Float, Float32
from torch import Tensor, nn

from ksim_rl.device.compiling import compiled
from ksim_rl.objectives.algorithm_cfg import OffPolicyCfg

# Parameters begin at multiples of so many elements, as kernels that load 16 bytes at a time ask.
ALIGNMENT = 32


class FlatAdamW(torch.optim.Optimizer):
    """AdamW (Loshchilov and Hutter, arXiv 1711.05101) on parameters that lie end to end, as do their moments.

    From then on the parameters, and the `target`'s, which follow each step by the share `tau` of the config, are
    parts of one tensor; they keep their names, and `state` has the parts of the moments. The learning rate, a tensor []
    on the device, may change in place.
    """

    def __init__(
        self,
        cfg: OffPolicyCfg,
        parameters: Iterable[nn.Parameter],
        *,
        learning_rate: float,
        target: Iterable[nn.Parameter] = (),
    ) -> None:
        learning = [parameter for parameter in parameters if parameter.requires_grad]
        device = learning[0].device
        rates = {"lr": torch.tensor(learning_rate, device=device), "initial_lr": learning_rate}
        super().__init__(learning, rates)
        self._cfg = cfg
        self._learning = learning
        # Zeros between the parameters: their gradient, moments and change stay zero.
        self._gaps = [own.new_zeros(-own.numel() % ALIGNMENT) for own in learning]
        self._flat = self._end_to_end(learning)
        self._target = self._end_to_end(list(target))
        self._moments = torch.zeros_like(self._flat), torch.zeros_like(self._flat)
        self._steps = torch.zeros((), device=device)
        # Views of the flat moments, so that checkpoints see an optimizer like torch's.
        for own, mean, variance in zip(learning, *map(self._parts, self._moments), strict=True):
            self.state[own] = {"step": self._steps, "exp_avg": mean, "exp_avg_sq": variance}
        self._change_ = compiled(_change_, device=device, wanted=cfg.compile)

    def _parts(self, flat: Tensor) -> list[Tensor]:
        sizes = [
            own.numel() + gap.numel() for own, gap in zip(self._learning, self._gaps, strict=True)
        ]
        parts = zip(flat.split(sizes), self._learning, strict=True)
        return [part[: own.numel()].view_as(own) for part, own in parts]

    def _pieces(self, tensors: list[Tensor]) -> list[Tensor]:
        pieces = []
        for own, gap in zip(tensors, self._gaps, strict=True):
            pieces += [own.reshape(-1), gap]
        return pieces

    def _end_to_end(self, parameters: list[nn.Parameter]) -> Tensor:
        if not parameters:
            return torch.empty(0)
        flat = torch.cat(self._pieces([own.detach() for own in parameters]))
        # Modules keep their parameter objects, whose memory is now a part of the flat tensor.
        for parameter, part in zip(parameters, self._parts(flat), strict=True):
            parameter.data = part
        return flat

    @torch.no_grad()
    def step(self, loss: Float[Tensor, ""]) -> tuple[Float32[Tensor, ""], Float32[Tensor, ""]]:  # type: ignore[override]
        """Make the step whose gradients are there, unless they or the loss are not finite, without a host sync.

        Returned are the norm of the gradient before clipping, and 1 if the step was skipped, else 0.
        """
        gradients = []
        for own in self._learning:
            # A parameter that the loss did not reach has no gradient, but a place in the flat one.
            gradients.append(torch.zeros_like(own) if own.grad is None else own.grad)
        # The compiled function gets all tensors that change as arguments.
        changed = self._flat, *self._moments, self._steps, self._target
        given = self._pieces(gradients), loss.detach(), self.param_groups[0]["lr"]
        return self._change_(changed, *given, self._cfg)


def _change_(
    changed: tuple[Tensor, ...], pieces: list[Tensor], loss: Tensor, rate: Tensor, cfg: OffPolicyCfg
) -> tuple[Tensor, Tensor]:
    flat, mean, variance, steps, target = changed
    # Here, where the compiler makes a kernel of it: torch's takes as long as all the rest.
    gradient = torch.cat(pieces)
    norm = torch.linalg.vector_norm(gradient)
    made = norm.isfinite() & loss.isfinite()
    if cfg.max_grad_norm is not None:
        gradient = gradient * (cfg.max_grad_norm / (norm + 1e-6)).clamp_max(1.0)
    # 1 - beta^step loses most digits of float32 in the first steps; this does not.
    unbias = []
    for beta in cfg.betas:
        log_beta = math.log(beta) if beta else -math.inf
        unbias.append(-torch.expm1((steps + 1.0) * log_beta))
    new_mean = mean.lerp(gradient, 1.0 - cfg.betas[0])
    new_variance = variance.lerp(gradient.square(), 1.0 - cfg.betas[1])
    change = new_mean / unbias[0] / ((new_variance / unbias[1]).sqrt() + cfg.adam_eps)
    # Decoupled weight decay: it scales with the learning rate, and is not in the moments.
    change = rate * (change + cfg.weight_decay * flat)
    # A step that is not finite changes nothing; a where keeps the decision on the device.
    flat.copy_(torch.where(made, flat - change, flat))
    mean.copy_(torch.where(made, new_mean, mean))
    variance.copy_(torch.where(made, new_variance, variance))
    steps.add_(made)
    if target.numel():
        target.lerp_(flat, cfg.tau)
    return norm, 1.0 - made.to(torch.float32)
