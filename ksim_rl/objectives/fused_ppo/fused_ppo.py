"""This module makes all gradient steps of a PPO update in four Triton kernels each, for most runs' networks.

It computes what `GAE`, `ClipPPOLoss` and `ppo_step` compute for an actor and a critic of `FusedNetworks`, from the same
config, in the same order of env states, and on the state of the same optimizer: a run can change from one to the other
at any update. With bfloat16 the weights, observations, hidden layers and their gradients are rounded to 8 significant
bits where they are multiplied; parameters, sums, losses and Adam stay float32. For networks of 512, 256 and 128 that
moved the gradient of each parameter by 0.2 to 0.6 percent of its norm, where torch's TF32 moves it by 0.05 to 0.5.
"""

import math
from collections.abc import Sequence
from functools import partial

import torch
from jaxtyping import Float, Int64
from tensordict import TensorDictBase
from torch import Tensor

from ksim_rl import ranks
from ksim_rl.objectives.algorithm_cfg import PPOCfg
from ksim_rl.objectives.fused_ppo.dataset import FusedDataset, Observe
from ksim_rl.objectives.fused_ppo.layout import (
    ACTIVATIONS,
    FusedLayout,
    FusedNetworks,
    Tuning,
    launch,
    parts,
    power_of_two,
)
from ksim_rl.objectives.fused_ppo.mlp_kernels import minibatch_gradients, state_values, weight_gradients
from ksim_rl.objectives.fused_ppo.step_kernels import SUMMARY, adam_step, sum_gradients
from ksim_rl.objectives.gradient_step import StepGuard, adapt_learning_rate_

# Sums that each block leaves beside its gradients.
NUM_STATISTICS = 16


class FusedParameters:
    """Flat and padded forms (see `FusedLayout`) of what an update changes.

    Between updates the modules and the optimizer hold the state, so that checkpoints, evaluation and collection see
    what they always see.
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
        # Parameters, and the optimizer's means and variances, each [N].
        self.flat = [torch.zeros(layout.num_flat, device=device) for _ in range(3)]
        self._views = [layout.flat_views(flat, networks) for flat in self.flat]
        self.places = layout.padded_index(networks).to(device)
        # The parameters in padded form, in float32 and in the dtype of the products.
        self.exact = torch.zeros(2, layout.num_padded, device=device)
        self.weights = torch.zeros(2, layout.num_padded, dtype=dtype, device=device)
        # The optimizer's number of steps before the first gradient step of the update, and after each.
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


class FusedPPO:
    """Makes the gradient steps of one update after another; all memory is allocated once, and nothing syncs.

    `why_not_fused` has no reason against its config. The first layers take what `observe_actor` and `observe_critic`
    give, [..., L]. Moments, step counts and learning rate are those of `optimizer`, from `make_optimizer`.
    """

    def __init__(
        self,
        cfg: PPOCfg,
        networks: FusedNetworks,
        *,
        observe_actor: Observe,
        observe_critic: Observe,
        optimizer: torch.optim.Adam,
        guard: StepGuard,
        num_env_states_per_minibatch: int,
        num_minibatches: int,
        tuning: Tuning | None = None,
    ) -> None:
        self.cfg, self.networks, self.optimizer, self.guard = cfg, networks, optimizer, guard
        self.layout = layout = FusedLayout(networks)
        self.tuning = tuning = tuning or Tuning.of(layout)
        self.batch = num_env_states_per_minibatch
        num_steps = cfg.num_epochs * num_minibatches
        device, dtype = networks.std_A.device, getattr(torch, cfg.precision)
        self.parameters = FusedParameters(
            networks, layout, optimizer=optimizer, dtype=dtype, num_steps=num_steps
        )
        self.dataset = FusedDataset(
            cfg,
            layout,
            observe_actor=observe_actor,
            observe_critic=observe_critic,
            size=num_env_states_per_minibatch * num_minibatches,
            dtype=dtype,
            device=device,
        )

        zeros = partial(torch.zeros, device=device)

        self._blocks = parts(self.batch, tuning.block)
        self._tiles = layout.weight_tiles(tuning.tile).to(device)
        # Tiles at the edge read past the last row.
        self._inputs = zeros(2 * self.batch * layout.input_columns + tuning.tile, dtype=dtype)
        self._slopes = zeros(2 * self.batch * layout.gradient_columns + tuning.tile, dtype=dtype)
        self._weight_partials = zeros(tuning.splits, 2, layout.num_weights)
        self._block_partials = zeros(self._blocks, 2, layout.num_biases + NUM_STATISTICS)
        self._gradients = zeros(2, layout.num_padded)
        programs = parts(layout.num_weights, tuning.size) + parts(layout.num_biases, tuning.columns)
        self._squares = zeros(2 * programs)
        self._summary = zeros(num_steps, power_of_two(len(SUMMARY)))

    def __call__(
        self, rollout_ET: TensorDictBase, orders: Sequence[Int64[Tensor, " D"]]
    ) -> tuple[dict[str, Float[Tensor, " steps"]], Int64[Tensor, ""]]:
        """Make all gradient steps of an update.

        `rollout_ET`, `["E","T"]`, may be time-major in memory, as that of a collector. `orders` has for each epoch the
        env states in the order of the minibatches, counted env by env. Returned are what each gradient step measured,
        by the names of `SUMMARY`, and how many env states took no part because an element was not finite.
        """
        num_envs, length = rollout_ET.batch_size
        self.parameters.load()
        left_out = self.dataset.read(rollout_ET, evaluate=self._evaluate)
        step = 0
        for order_D in orders:
            # From env by env to step by step.
            index_D = (order_D % length) * num_envs + order_D.div(length, rounding_mode="floor")
            for index_B in index_D.to(torch.int32).split(self.batch):
                self._multiply(index_B)
                self._improve(step)
                step += 1
        self.parameters.store()
        return dict(zip(SUMMARY, self._summary.unbind(1), strict=False)), left_out

    def _multiply(self, index_B: Tensor) -> None:
        """Run a minibatch through both networks and back, up to the gradients of the weights, in parts."""
        cfg, layout, tuning = self.cfg, self.layout, self.tuning
        clip_value = cfg.clip_epsilon if cfg.clip_value is True else float(cfg.clip_value)
        launch(
            minibatch_gradients,
            (self._blocks, 2),
            self.dataset.obs,
            self.dataset.records,
            index_B,
            self.parameters.weights,
            self.parameters.biases_2N,
            self._inputs,
            self._slopes,
            self._block_partials,
            self.batch,
            self.dataset.records.shape[0],
            math.log1p(-cfg.clip_epsilon) if cfg.clip_epsilon < 1.0 else -math.inf,
            math.log1p(cfg.clip_epsilon),
            clip_value,
            cfg.entropy_coeff,
            cfg.critic_coeff,
            NUM_PADDED=layout.num_padded,
            NUM_BIASES=layout.num_biases,
            NUM_STATISTICS=NUM_STATISTICS,
            RECORD=self.dataset.records.shape[1],
            INPUTS=layout.input_columns,
            GRADIENTS=layout.gradient_columns,
            ACTIONS=layout.action_dim,
            LOG_STD=self.networks.log_std,
            MIN_STD=self.networks.min_std,
            CLIP_VALUE=clip_value > 0.0,
            num_warps=tuning.warps,
            **self._sizes,
        )
        launch(
            weight_gradients,
            (len(self._tiles), tuning.splits),
            self._tiles,
            self._inputs,
            self._slopes,
            self._weight_partials,
            self.batch,
            NUM_WEIGHTS=layout.num_weights,
            INPUTS=layout.input_columns,
            GRADIENTS=layout.gradient_columns,
            ROWS=parts(self.batch, tuning.splits * tuning.depth) * tuning.depth,
            TILE=tuning.tile,
            DEPTH=tuning.depth,
            STAGES=tuning.tile_stages,
            num_warps=tuning.tile_warps,
        )

    def _improve(self, step: int) -> None:
        """Add the parts up, and make the step of the optimizer."""
        cfg, layout, tuning = self.cfg, self.layout, self.tuning
        group = self.optimizer.param_groups[0]
        launch(
            sum_gradients,
            (len(self._squares) + 1,),
            self._weight_partials,
            self._block_partials,
            self._gradients,
            self._squares,
            self.parameters.biases_2N,
            group["lr"],
            self._summary[step],
            cfg.entropy_coeff,
            cfg.critic_coeff,
            cfg.desired_kl,
            cfg.learning_rate_min,
            cfg.learning_rate_max,
            SPLITS=tuning.splits,
            BLOCKS=self._blocks,
            NUM_WEIGHTS=layout.num_weights,
            NUM_BIASES=layout.num_biases,
            NUM_STATISTICS=NUM_STATISTICS,
            ACTIONS=layout.action_dim,
            OUT=layout.out_width,
            LOG_STD=self.networks.log_std,
            MIN_STD=self.networks.min_std,
            ADAPTIVE=cfg.schedule == "adaptive" and ranks.size() == 1,
            SIZE=tuning.size,
            COLUMNS=tuning.columns,
            ROWS=tuning.rows,
        )
        if ranks.size() > 1:
            self._take_means(self._summary[step], group["lr"])
        beta1, beta2 = cfg.betas
        launch(
            adam_step,
            (parts(layout.num_flat, tuning.size),),
            *self.parameters.flat,
            self.parameters.places,
            self._gradients,
            self.parameters.weights,
            self.parameters.exact,
            self._squares,
            self._summary[step],
            self.parameters.steps[step:],
            self.guard.skipped,
            self.guard.skipped_in_a_row,
            beta1,
            beta2,
            _log(beta1),
            _log(beta2),
            cfg.adam_eps,
            cfg.weight_decay,
            cfg.max_grad_norm or 0.0,
            SIZE=layout.num_flat,
            NUM_SQUARES=len(self._squares),
            SQUARES=power_of_two(len(self._squares)),
            CLIP=cfg.max_grad_norm is not None,
            BLOCK=tuning.size,
        )

    def _take_means(self, summary: Tensor, learning_rate: Tensor) -> None:
        """Take the means over all ranks of the gradients and of what the step measured, and adapt the learning rate."""
        cfg = self.cfg
        ranks.mean_([self._gradients, summary])
        self._squares.zero_()
        self._squares[0].copy_(self._gradients.square().sum())
        if cfg.schedule == "adaptive":
            bounds = {"lr_min": cfg.learning_rate_min, "lr_max": cfg.learning_rate_max}
            kl = summary[SUMMARY.index("kl")]
            adapt_learning_rate_(learning_rate, kl, desired_kl=cfg.desired_kl, **bounds)
            summary[SUMMARY.index("learning_rate")].copy_(learning_rate)

    def _evaluate(self, obs_DL: Tensor, values_D: Tensor) -> None:
        launch(
            state_values,
            (parts(len(values_D), self.tuning.block),),
            obs_DL,
            self.parameters.weights[1],
            self.parameters.biases_2N[1],
            values_D,
            len(values_D),
            num_warps=self.tuning.warps,
            **self._sizes,
        )

    @property
    def _sizes(self) -> dict[str, int]:
        layout, tuning = self.layout, self.tuning
        first, second, third = layout.hidden
        widths = {"H1": first, "H2": second, "H3": third}
        widths |= {
            "ACTIVATION": ACTIVATIONS.index(self.networks.activation),
            "OBS": layout.obs_width,
            "OUT": layout.out_width,
        }
        return widths | {"BLOCK": tuning.block, "CHUNK": tuning.chunk, "STAGES": tuning.stages}


def _log(beta: float) -> float:
    return math.log(beta) if beta > 0.0 else -math.inf
