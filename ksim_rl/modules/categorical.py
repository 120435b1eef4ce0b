"""The distribution of choices among options, free of host syncs."""

from collections.abc import Sequence
from functools import reduce
from operator import add

import torch
from jaxtyping import Float, Shaped
from torch import Tensor
from torch.distributions import Distribution, constraints, register_kl
from torch.nn import functional

from ksim_rl import ranks


class Categorical(Distribution):
    """One choice among N, or several independent ones, as indices or one-hot.

    It equals `torch.distributions.Categorical`, whose argument checks and sampling through `torch.multinomial` can wait
    for the device. Samples are drawn by the largest of the logits plus Gumbel noise (Maddison et al., arXiv 1411.0030)
    from torch's default generator of the device. Logits of several choices, [..., N], stand side by side, in K parts of
    the given `sizes`: samples are [..., K], or [...] for one choice. With `one_hot` they mark the options instead,
    [..., N]. Their `dtype` comes from the action spec.
    """

    arg_constraints = {"logits": constraints.real_vector}  # type: ignore[assignment]
    has_rsample = False

    def __init__(
        self,
        logits: Float[Tensor, "*batch N"],
        sizes: Sequence[int] | None = None,
        one_hot: bool = False,
        dtype: torch.dtype | None = None,
    ) -> None:
        if sizes is not None and sum(sizes) != logits.shape[-1]:
            raise ValueError(
                f"sizes={tuple(sizes)}: they must sum to the {logits.shape[-1]} logits"
            )
        self.logits = logits
        if sizes is None:
            self.sizes = None
        else:
            self.sizes = tuple(sizes)
        self.one_hot = one_hot
        self.dtype = dtype or (torch.bool if one_hot else torch.int64)
        parts = logits.split(list(self.sizes or logits.shape[-1:]), -1)
        smallest = torch.finfo(logits.dtype).min
        # An option that a logit of minus infinity rules out has probability zero: a finite logarithm keeps it no NaN.
        self._log_probs = [functional.log_softmax(part, -1).clamp_min(smallest) for part in parts]
        if one_hot:
            event = logits.shape[-1:]
        else:
            event = torch.Size(() if self.sizes is None else (len(parts),))
        # Argument checks compare all values and read the answer on the host.
        super().__init__(logits.shape[:-1], event, validate_args=False)

    @property
    def support(self) -> constraints.Constraint:  # type: ignore[override]
        """Indices below the number of options, or marks of 0 and 1."""
        if self.one_hot:
            return constraints.independent(constraints.boolean, 1)
        if self.sizes is None:
            return constraints.integer_interval(0, self.logits.shape[-1] - 1)
        return constraints.independent(constraints.integer_interval(0, max(self.sizes) - 1), 1)

    @property
    def probs(self) -> Float[Tensor, "*batch N"]:
        """The probabilities, which sum to 1 for each choice."""
        return torch.cat([log_probs.exp() for log_probs in self._log_probs], -1)

    @property
    def mode(self) -> Shaped[Tensor, "*value"]:
        """The most likely option of each choice."""
        return self._as_value([log_probs.argmax(-1) for log_probs in self._log_probs])

    @property
    def deterministic_sample(self) -> Shaped[Tensor, "*value"]:
        """The mode, which TorchRL takes under `ExplorationType.DETERMINISTIC`."""
        return self.mode

    def expand(
        self, batch_shape: Sequence[int], _instance: Distribution | None = None
    ) -> "Categorical":
        """Return the distribution with a larger batch shape."""
        logits = self.logits.expand(torch.Size(batch_shape) + self.logits.shape[-1:])
        return Categorical(logits, self.sizes, self.one_hot, self.dtype)

    def sample(self, sample_shape: torch.Size | tuple[int, ...] = ()) -> Shaped[Tensor, "*value"]:
        """Draw the options, sample_shape + batch shape + event shape."""
        chosen = []
        with torch.no_grad():
            for log_probs in self._log_probs:
                shape = torch.Size(sample_shape) + log_probs.shape
                like = {"dtype": log_probs.dtype, "device": log_probs.device}
                # The Gumbel noise is minus the logarithm of a draw from the exponential distribution.
                waiting = ranks.exponential(shape, dim=len(sample_shape), **like)
                chosen.append((log_probs - waiting.log()).argmax(-1))
        return self._as_value(chosen)

    def log_prob(self, value: Shaped[Tensor, "*value"]) -> Float[Tensor, "*shape"]:
        """Return the log probability of `value`, summed over the choices."""
        chosen = []
        for log_probs, index in zip(self._log_probs, self._as_indices(value), strict=True):
            of_each = log_probs.expand(*index.shape, -1)
            chosen.append(of_each.gather(-1, index.unsqueeze(-1)).squeeze(-1))
        return reduce(add, chosen)

    def entropy(self) -> Float[Tensor, "*batch"]:
        """Return the entropy in nats, summed over the choices."""
        entropies = [-(log_probs.exp() * log_probs).sum(-1) for log_probs in self._log_probs]
        return reduce(add, entropies)

    def _as_value(self, indices: Sequence[Tensor]) -> Tensor:
        if self.one_hot:
            # torch's one_hot() asks the host whether all indices are in range.
            marks = [
                index.unsqueeze(-1) == torch.arange(log_probs.shape[-1], device=index.device)
                for index, log_probs in zip(indices, self._log_probs, strict=True)
            ]
            return torch.cat(marks, -1).to(self.dtype)
        if self.sizes is None:
            value = indices[0]
        else:
            value = torch.stack(tuple(indices), -1)
        return value.to(self.dtype)

    def _as_indices(self, value: Tensor) -> list[Tensor]:
        if self.one_hot:
            widths = [log_probs.shape[-1] for log_probs in self._log_probs]
            return [marks.to(torch.uint8).argmax(-1) for marks in value.split(widths, -1)]
        if self.sizes is None:
            return [value.long()]
        return list(value.long().unbind(-1))


@register_kl(Categorical, Categorical)
def _kl(p: Categorical, q: Categorical) -> Tensor:
    divergences = []
    for log_p, log_q in zip(p._log_probs, q._log_probs, strict=True):
        divergences.append((log_p.exp() * (log_p - log_q)).sum(-1))
    return reduce(add, divergences)
