"""The clipped surrogate loss of PPO, free of host syncs."""

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase, is_tensor_collection
from tensordict.nn import (
    CompositeDistribution,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    dispatch,
)
from tensordict.utils import NestedKey
from torch import Tensor
from torch.distributions import Distribution
from torchrl import objectives
from torchrl.modules.distributions.utils import has_analytic_entropy, sample_and_log_prob

from ksim_rl import ranks
from ksim_rl.objectives.masked import standardized
from ksim_rl.objectives.policy_kl import (
    distribution_keys,
    estimated_kl,
    observation_keys,
    policy_kl,
    stored_distribution,
)


class ClipPPOLoss(objectives.ClipPPOLoss):
    """TorchRL's `ClipPPOLoss` (Schulman et al., arXiv 1707.06347), with the same options, losses and gradients.

    The stock loss reads tensor values on the host 1 to 3 times per call and breaks `fullgraph` compilation with
    `clip_value`; this one never does. It also writes `kl`, the divergence from the policy that collected the data to
    the present one: exact where there is a closed form and the data has the parameters of the old distribution, else an
    estimate from the actions.

    Losses are means over the env states, without a factor 0.5: `loss_objective` = -mean(min(r A, clip(r, 1 -
    clip_epsilon, 1 + clip_epsilon) A)), r the probability ratio; `loss_critic` = critic_coeff * mean(max((v - R)^2,
    (v_old + clip(v - v_old, -clip_value, clip_value) - R)^2)) with `loss_critic_type="l2"`, which is rsl_rl's clipped
    value loss with `value_loss_coef = critic_coeff`; `loss_entropy` = -entropy_coeff * mean(entropy). Env states whose
    `("collector", "mask")` is False are left out.

    Args:
        clip_value: radius of the value clipping, in units of the value; True takes `clip_epsilon`, None or False does
            not clip. It is a plain number here: a captured graph or a compiled loss keeps the one it saw.
        log_ratio_statistics: also write TorchRL's `ESS`, `max_ratio` and `mean_ratio`.
    """

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential | None = None,
        critic_network: TensorDictModule | None = None,
        *,
        clip_epsilon: float | tuple[float, float] = 0.2,
        clip_value: bool | float | None = None,
        log_ratio_statistics: bool = True,
        **kwargs: Any,
    ) -> None:
        # TorchRL keeps clip_value in a buffer and tests it in an `if`, which is a host sync.
        super().__init__(
            actor_network, critic_network, clip_epsilon=clip_epsilon, clip_value=None, **kwargs
        )
        if clip_value is True:
            if isinstance(clip_epsilon, (tuple, list)):
                raise ValueError(
                    f"clip_value=True takes the radius from clip_epsilon={clip_epsilon!r}, which has two: pass a number"
                )
            clip_value = float(clip_epsilon)
        if clip_value:
            self.clip_value = float(clip_value)
        else:
            self.clip_value = None
        # TorchRL names heads by their log-probabilities where it samples entropies; here one name serves.
        if self._entropy_coeff_map is not None:
            self._entropy_coeff_map = {
                _head(key): coeff for key, coeff in self._entropy_coeff_map.items()
            }
        self.log_ratio_statistics = log_ratio_statistics

    @property
    def dataset_keys(self) -> list[NestedKey]:
        """The leaves that a dataset needs for this loss, advantages already estimated."""
        keys = self.tensor_keys
        actor = self.actor_network
        wanted = [
            *observation_keys(actor),
            *_as_list(keys.action),
            *_as_list(keys.sample_log_prob),
            *distribution_keys(actor),
            keys.advantage,
        ]
        if self.critic_network is not None:
            wanted += [*self.critic_network.in_keys, keys.value, keys.value_target]
        return list(dict.fromkeys(wanted))

    @dispatch  # type: ignore[arg-type]
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return the losses and the logged quantities, all detached but those named `loss_*`.

        A minibatch is `["B"]`, or `["B","T"]` for recurrent networks, with the `dataset_keys`. Without an advantage it
        must be a rollout, from which the value estimator computes one. Returned, without batch dims, are
        `loss_objective`, `loss_critic`, `loss_entropy`, `entropy`, `kl`, `kl_approx`, `clip_fraction`,
        `value_clip_fraction` and `explained_variance`.
        """
        # A shallow copy: the networks write their outputs into it, and the caller's minibatch stays as it was.
        tensordict = tensordict.clone(False)
        # Read before the actor runs, which writes its own distribution under the same keys.
        dist_old = stored_distribution(self.actor_network, tensordict)
        adv_B = self._advantage(tensordict)
        log_weight_B, dist, kl_approx_B, log_is_weight_B = self._log_weight(
            tensordict, adv_shape=adv_B.shape[:-1]
        )
        values_shape = adv_B.shape
        adv_B = _for_each_part(adv_B, log_weight_B)
        if adv_B.shape != log_weight_B.shape:
            raise ValueError(
                f"the advantage has shape {tuple(adv_B.shape)}, the log-probability ratio "
                f"{tuple(log_weight_B.shape)}: both must be batch shape + (1,), or the objective were an outer product"
            )
        if (mask_B := self._mask(tensordict, log_weight_B)) is not None:
            # The ratio of a row that is left out may be infinite, and zero times that is a gradient of NaN.
            log_weight_B = torch.where(mask_B, log_weight_B, 0.0)
        # The clipping acts on the ratio to the proximal policy; the gain is weighted by that to the collecting one.
        if log_is_weight_B is None:
            log_behavior_weight_B = log_weight_B
        else:
            log_behavior_weight_B = log_weight_B + log_is_weight_B
        # Clipping the logarithm clips the ratio, and does not overflow as its exponential may.
        log_clipped_B = log_weight_B.clamp(*self._clip_bounds)
        clipped_B = log_clipped_B != log_weight_B
        if log_is_weight_B is not None:
            log_clipped_B = log_clipped_B + log_is_weight_B
        # The smaller gain: a step that moves the ratio beyond its bounds earns nothing more.
        gain_B = torch.minimum(log_behavior_weight_B.exp() * adv_B, log_clipped_B.exp() * adv_B)

        losses = {"loss_objective": -gain_B}
        logged = {"clip_fraction": clipped_B.to(gain_B.dtype), "kl_approx": kl_approx_B}
        with torch.no_grad():
            if dist_old is None:
                exact_B = None
            else:
                exact_B = policy_kl(dist_old, dist)
            # The adaptive learning rate reads this: the exact divergence has less noise than the estimate.
            if exact_B is None:
                logged["kl"] = estimated_kl(log_behavior_weight_B)
            else:
                logged["kl"] = exact_B.unsqueeze(-1)
        out = TensorDict({})
        if self.entropy_bonus:
            entropy_B = self._get_entropy(dist, adv_shape=adv_B.shape[:-1])
            losses["loss_entropy"] = self._weighted_loss_entropy(entropy_B)
            # Several actions have an entropy each; the loss and the log take their sum.
            if is_tensor_collection(entropy_B):
                out.set("composite_entropy", entropy_B.detach())
                entropy_B = entropy_B.sum(dim="feature", reduce=True)  # type: ignore[call-overload]
            logged["entropy"] = entropy_B
        if self._has_critic:
            loss_critic_B, value_clip_fraction, explained_variance = self.loss_critic(tensordict)
            if is_tensor_collection(loss_critic_B):
                # Several values have a loss each, which TorchRL leaves as it is, by env state.
                out.set("loss_critic", loss_critic_B)
            else:
                losses["loss_critic"] = loss_critic_B.view(values_shape)
            if value_clip_fraction is not None:
                out.set("value_clip_fraction", value_clip_fraction)
            if is_tensor_collection(explained_variance):
                out.set("explained_variance", explained_variance)
            elif explained_variance is not None:
                # TorchRL keeps the last dim of size one here; all other logged values are scalars.
                out.set("explained_variance", explained_variance.squeeze(-1))
        if self.log_ratio_statistics:
            out.update(_ratio_statistics(log_behavior_weight_B.detach()))
        # Other reductions return losses per env state, which the shared mean below must not touch.
        if self.reduction != "mean":
            for name, loss in losses.items():
                out.set(name, self._reduce_loss(loss, tensordict).squeeze(-1))
            losses = {}
        # Losses and logged columns are averaged in one reduction, which saves a kernel for each of them.
        for name, mean in self._means(losses | logged, tensordict).items():
            out.set(name, mean if name in losses else mean.detach())
        self._clear_weakrefs(
            tensordict,
            out,
            "actor_network_params",
            "critic_network_params",
            "target_actor_network_params",
            "target_critic_network_params",
        )
        return out

    def _critic_loss_inputs(
        self, target_return: Tensor, state_value: Tensor, old_state_value: Tensor | None
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        # Several values in a TensorDict have no trailing dim of one in its batch.
        if is_tensor_collection(state_value):
            return super()._critic_loss_inputs(target_return, state_value, old_state_value)
        # TorchRL's explained variance is over the first dim: rows of sequences [B, T] come one below the other.
        return super()._critic_loss_inputs(
            target_return.flatten(0, -2),
            state_value.flatten(0, -2),
            None if old_state_value is None else old_state_value.flatten(0, -2),
        )

    def _advantage(self, tensordict: TensorDictBase) -> Tensor:
        adv_B = tensordict.get(self.tensor_keys.advantage, None)
        estimate = adv_B is None
        # If the data has no advantage, the value estimator computes it: the data must then be a rollout.
        if estimate:
            self.value_estimator(
                tensordict,
                params=self._cached_critic_network_params_detached,
                target_params=self.target_critic_network_params,
            )
            adv_B = tensordict.get(self.tensor_keys.advantage)
        return self._maybe_normalize_advantage(adv_B, tensordict, update_norm=estimate)

    def _means(self, columns: dict[str, Tensor], tensordict: TensorDictBase) -> dict[str, Tensor]:
        """Return the means over all env states that take part; one reduction for all columns."""
        # One table for all quantities, but where parts of an action have columns of their own.
        by_shape: dict[torch.Size, list[str]] = {}
        for name, column in columns.items():
            by_shape.setdefault(column.shape, []).append(name)
        found = {}
        for names in by_shape.values():
            # One row per quantity, [K, B, 1].
            table = torch.stack([columns[name] for name in names])
            mask = self._mask(tensordict, table[0])
            if mask is None:
                means = table.flatten(1).mean(1)
            else:
                # A where instead of a product: values left out may be anything, and zero times infinity is NaN.
                table = torch.where(mask, table, torch.zeros_like(table))
                means = table.flatten(1).sum(1) / mask.sum().clamp_min(1)
            found.update(zip(names, means.unbind(0), strict=True))
        # In the order of the columns, whatever their shapes.
        return {name: found[name] for name in columns}

    def _mask(self, tensordict: TensorDictBase, column_B: Tensor) -> Tensor | None:
        masks = [tensordict.get(key, None) for key in self._loss_mask_keys()]
        masks = [self._expand_loss_mask(mask, column_B) for mask in masks if mask is not None]
        # One mask is used as it is, without the copy of a stack.
        if len(masks) < 2:
            if masks:
                return masks[0]
            return None
        return torch.stack(masks).all(0)

    def _standardize_advantage(self, advantage: Tensor, tensordict: TensorDictBase) -> Tensor:
        mask_B = self._mask(tensordict, advantage)
        if self.normalize_advantage_exclude_dims or mask_B is None and ranks.size() == 1:
            return super()._standardize_advantage(advantage, tensordict)
        if mask_B is None:
            mask_B = torch.ones_like(advantage, dtype=torch.bool)
        # The bound is TorchRL's.
        return standardized(advantage, mask_B, lowest_std=torch.finfo(torch.float32).resolution)

    def _get_entropy(self, dist: Distribution, adv_shape: torch.Size) -> Tensor | TensorDictBase:
        # TorchRL falls back on samples where the entropy is not finite, and asks the host for it.
        if isinstance(dist, CompositeDistribution):
            entropies = TensorDict(batch_size=adv_shape)
            # One by one, which keeps the order of the distribution.
            for key, part in dist.dists.items():
                entropies.set(_entropy_key(key), self._entropy(part))
            return entropies.unsqueeze(-1)
        return self._entropy(dist).unsqueeze(-1)

    def _entropy(self, dist: Distribution) -> Tensor:
        if has_analytic_entropy(dist):
            return dist.entropy()
        # The mean of -log p over samples: an unbiased estimate where there is no closed form.
        _, log_prob = sample_and_log_prob(
            dist, (self.samples_mc_entropy,), reparameterize=bool(dist.has_rsample)
        )
        return -log_prob.mean(0)


def _for_each_part(adv_B: Tensor, log_weight_B: Tensor) -> Tensor:
    """Return the advantages [*batch, 1] for each part of an action where ratios are of parts: [*batch, *parts, 1]."""
    batch = adv_B.shape[:-1]
    parts = log_weight_B.ndim - adv_B.ndim
    fits = adv_B.ndim > 1 and adv_B.shape[-1] == log_weight_B.shape[-1] == 1
    if parts < 1 or not fits or log_weight_B.shape[: len(batch)] != batch:
        return adv_B
    return adv_B.view(*batch, *(1,) * parts, 1).expand_as(log_weight_B)


def _entropy_key(key: NestedKey) -> NestedKey:
    if isinstance(key, str):
        return f"{key}_entropy"
    return (*key[:-1], f"{key[-1]}_entropy")


def _head(key: NestedKey) -> NestedKey:
    """Return the name of a head's entropy, given that or the name of its log-probability."""
    if isinstance(key, str):
        return key.removesuffix("_log_prob") + "_entropy" if key.endswith("_log_prob") else key
    return (*key[:-1], _head(key[-1]))


def _as_list(keys: NestedKey | list[NestedKey] | None) -> list[NestedKey]:
    assert keys is not None
    if isinstance(keys, list):
        return list(keys)
    return [keys]


def _ratio_statistics(log_weight: Tensor) -> dict[str, Tensor]:
    """Return TorchRL's statistics of the probability ratio: effective sample size (a share), maximum and mean."""
    log_weight_B = log_weight.squeeze(-1)
    # The logarithm of (sum w)^2 / sum w^2, which does not overflow for large ratios.
    log_size = 2.0 * log_weight_B.logsumexp(0) - (2.0 * log_weight_B).logsumexp(0)
    ratio = log_weight.exp()
    return {
        "ESS": log_size.exp() / log_weight.shape[0],
        "max_ratio": ratio.max(),
        "mean_ratio": ratio.mean(),
    }
