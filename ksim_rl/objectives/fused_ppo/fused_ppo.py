"""All gradient steps of a PPO update in four Triton kernels each, for the networks that most runs have.

It computes what `GAE`, `ClipPPOLoss` and `ppo_step` compute for an actor and a critic of `FusedNetworks`, from the same
config, in the same order of env states, and on the state of the same optimizer: a run can change from one to the other
at any update. With bfloat16 the weights, observations, hidden layers and their gradients are rounded to 8 significant
bits where they are multiplied; parameters, sums, losses and Adam stay float32. For networks of 512, 256 and 128 that
moved the gradient of each parameter by 0.2 to 0.6 percent of its norm, where torch's TF32 moves it by 0.05 to 0.5.
"""

import math
from collections.abc import Callable, Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor

from ksim_rl.objectives.fused_ppo.advantage_kernel import estimate_advantages
from ksim_rl.objectives.fused_ppo.layout import FusedLayout, FusedNetworks, power_of_two
from ksim_rl.objectives.fused_ppo.loss_kernels import LOG_PROB, MASK
from ksim_rl.objectives.fused_ppo.mlp_kernels import minibatch_gradients, state_values, weight_gradients
from ksim_rl.objectives.fused_ppo.step_kernels import SUMMARY, adam_step, sum_gradients
from ksim_rl.objectives.fused_ppo.tuning import Tuning
from ksim_rl.objectives.ppo_cfg import PPOCfg
from ksim_rl.objectives.rollout_estimator import standardized
from ksim_rl.objectives.step_guard import StepGuard

# Sums that each block leaves beside its gradients.
NUM_STATISTICS = 16


class FusedPPO:
    """Makes the gradient steps of one update after another; all memory is allocated once, and nothing syncs.

    Args:
        cfg: of the objective; GAE, no symmetry, no new estimate in each epoch.
        networks: what learns.
        observe_actor, observe_critic: from a TensorDict to what the first layers of actor and critic take, [..., L].
        optimizer: Adam from `make_optimizer`; its moments, step counts and learning rate are used and kept.
        guard: counts skipped steps.
        num_env_states_per_minibatch, num_minibatches: B, and how many there are in an epoch.
        tuning: sizes of blocks; None takes those that suit the networks.
    """

    def __init__(
        self,
        cfg: PPOCfg,
        networks: FusedNetworks,
        *,
        observe_actor: Callable[[TensorDictBase], Tensor],
        observe_critic: Callable[[TensorDictBase], Tensor],
        optimizer: torch.optim.Adam,
        guard: StepGuard,
        num_env_states_per_minibatch: int,
        num_minibatches: int,
        tuning: Tuning | None = None,
    ) -> None:
        self.cfg, self.networks, self.optimizer, self.guard = cfg, networks, optimizer, guard
        self.layout = layout = FusedLayout(networks)
        product_dtype: torch.dtype = getattr(torch, cfg.precision)
        self.tuning = tuning = tuning or Tuning.of(layout)
        self._observe = observe_actor, observe_critic
        self._parameters = networks.parameters
        self._device = device = self._parameters[0].device
        self.batch, self.num_minibatches = num_env_states_per_minibatch, num_minibatches
        self.size = num_env_states_per_minibatch * num_minibatches
        self._blocks = -(-self.batch // tuning.block)
        self._rows_per_split = -(-self.batch // (tuning.splits * tuning.depth)) * tuning.depth

        def zeros(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
            return torch.zeros(shape, dtype=dtype, device=device)

        num_steps = cfg.num_epochs * num_minibatches
        self._flat = [zeros(layout.num_flat) for _ in range(3)]
        self._views = [layout.flat_views(flat, networks) for flat in self._flat]
        self._places = layout.padded_index(networks).to(device)
        self._exact = zeros(2, layout.num_padded)
        self._weights = zeros(2, layout.num_padded, dtype=product_dtype)
        self._gradients = zeros(2, layout.num_padded)
        self._tiles = layout.weight_tiles(tuning.tile).to(device)
        # Tiles at the edge read past the last row.
        self._inputs = zeros(2 * self.batch * layout.input_columns + tuning.tile, dtype=product_dtype)
        self._slopes = zeros(2 * self.batch * layout.gradient_columns + tuning.tile, dtype=product_dtype)
        self._weight_partials = zeros(tuning.splits, 2, layout.num_weights)
        self._block_partials = zeros(self._blocks, 2, layout.num_biases + NUM_STATISTICS)
        weight_programs = -(-layout.num_weights // tuning.size)
        bias_programs = -(-layout.num_biases // tuning.columns)
        self._squares = zeros(2 * (weight_programs + bias_programs))
        self._summary = zeros(num_steps, power_of_two(len(SUMMARY)))
        self._steps = zeros(num_steps + 1)
        self._obs = zeros(2, self.size, layout.obs_width, dtype=product_dtype)
        self._next_obs = zeros(self.size, layout.obs_width, dtype=product_dtype)
        self._values, self._next_values = zeros(self.size), zeros(self.size)
        self._advantages, self._targets = zeros(self.size), zeros(self.size)
        self._neutral = zeros(3 * layout.out_width + 16)
        self._neutral[2 * layout.out_width : 3 * layout.out_width] = 1.0
        self._records = self._neutral.repeat(self.size, 1)
        self._start_moments()

    def __call__(self, rollout_ET: TensorDictBase, orders: Sequence[Tensor]) -> tuple[dict[str, Tensor], Tensor]:
        """Make all gradient steps of an update.

        Args:
            rollout_ET: `["E","T"]`; its memory may be time-major, as that of a collector.
            orders: of each epoch, the env states in the order of the minibatches, int64 [D], counted env by env.

        Returns:
            What each gradient step measured, by the names of `SUMMARY`, each [steps]; and how many env states were left
            out because an element was not finite, int64 [].
        """
        num_envs, length = rollout_ET.batch_size
        self._load()
        left_out = self._read(rollout_ET)
        step = 0
        for order_D in orders:
            # The records are in the order of the memory, time step by time step.
            index_D = ((order_D % length) * num_envs + order_D.div(length, rounding_mode="floor")).to(torch.int32)
            for index_B in index_D.split(self.batch):
                self._step(step, index_B)
                step += 1
        self._store()
        return dict(zip(SUMMARY, self._summary.unbind(1), strict=False)), left_out

    # -- one gradient step ---------------------------------------------------------------------------------------

    def _step(self, step: int, index_B: Tensor) -> None:
        self._gradient(index_B)
        self._improve(step)

    def _gradient(self, index_B: Tensor) -> None:
        cfg, layout, tuning = self.cfg, self.layout, self.tuning
        clip_value = cfg.clip_epsilon if cfg.clip_value is True else float(cfg.clip_value)
        minibatch_gradients[(self._blocks, 2)](
            self._obs,
            self._records,
            index_B,
            self._weights,
            self._biases,
            self._inputs,
            self._slopes,
            self._block_partials,
            self.batch,
            self.size,
            math.log1p(-cfg.clip_epsilon),
            math.log1p(cfg.clip_epsilon),
            clip_value,
            cfg.entropy_coeff,
            cfg.critic_coeff,
            NUM_PADDED=layout.num_padded,
            NUM_BIASES=layout.num_biases,
            NUM_STATISTICS=NUM_STATISTICS,
            RECORD=self._records.shape[1],
            INPUTS=layout.input_columns,
            GRADIENTS=layout.gradient_columns,
            A=layout.action_dim,
            LOG_STD=self.networks.log_std,
            MIN_STD=self.networks.min_std,
            CLIP_VALUE=clip_value > 0.0,
            num_warps=tuning.warps,
            **self._sizes,
        )
        weight_gradients[(len(self._tiles), tuning.splits)](
            self._tiles,
            self._inputs,
            self._slopes,
            self._weight_partials,
            self.batch,
            NUM_WEIGHTS=layout.num_weights,
            INPUTS=layout.input_columns,
            GRADIENTS=layout.gradient_columns,
            ROWS=self._rows_per_split,
            TILE=tuning.tile,
            DEPTH=tuning.depth,
            STAGES=tuning.tile_stages,
            num_warps=tuning.tile_warps,
        )

    def _improve(self, step: int) -> None:
        cfg, layout, tuning = self.cfg, self.layout, self.tuning
        group = self.optimizer.param_groups[0]
        sum_gradients[(len(self._squares) + 1,)](
            self._weight_partials,
            self._block_partials,
            self._gradients,
            self._squares,
            self._biases,
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
            A=layout.action_dim,
            O=layout.out_width,
            LOG_STD=self.networks.log_std,
            MIN_STD=self.networks.min_std,
            ADAPTIVE=cfg.schedule == "adaptive",
            SIZE=tuning.size,
            COLUMNS=tuning.columns,
            ROWS=tuning.rows,
        )
        beta1, beta2 = cfg.betas
        adam_step[(-(-layout.num_flat // tuning.size),)](
            *self._flat,
            self._places,
            self._gradients,
            self._weights,
            self._exact,
            self._squares,
            self._summary[step],
            self._steps[step:],
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

    @property
    def _biases(self) -> Tensor:
        return self._exact[0, self.layout.num_weights :]

    @property
    def _sizes(self) -> dict[str, int]:
        layout, tuning = self.layout, self.tuning
        first, second, third = layout.hidden
        widths = {"L": layout.obs_width, "H1": first, "H2": second, "H3": third, "O": layout.out_width}
        return widths | {"BLOCK": tuning.block, "CHUNK": tuning.chunk, "STAGES": tuning.stages}

    # -- what the steps read -------------------------------------------------------------------------------------

    @torch.no_grad()
    def _read(self, rollout_ET: TensorDictBase) -> Tensor:
        """Normalize, estimate advantages, and lay down what the steps read; return the number of env states left out."""
        cfg, layout = self.cfg, self.layout
        num_envs, length = rollout_ET.batch_size
        following = rollout_ET.get("next")
        for obs_DL, observe, dim in zip(self._obs, self._observe, layout.obs_dims, strict=True):
            obs_DL[:, :dim] = _time_major(observe(rollout_ET))
        self._next_obs[:, : layout.obs_dims[1]] = _time_major(self._observe[1](following))
        self._evaluate(self._obs[1], self._values)
        self._evaluate(self._next_obs, self._next_values)
        signals = [_time_major(following.get(key)) for key in ("reward", "done", "terminated")]
        estimate_advantages[(-(-num_envs // self.tuning.envs),)](
            self._values,
            self._next_values,
            *signals,
            self._advantages,
            self._targets,
            num_envs,
            cfg.gamma,
            cfg.gamma * cfg.lmbda,
            STEPS=length,
            BLOCK=self.tuning.envs,
            num_warps=1,
        )
        advantages_D = self._advantages
        if cfg.normalize_advantage == "dataset":
            estimated_D = advantages_D.isfinite()
            normal_D = standardized(advantages_D, estimated_D)
            advantages_D = torch.where(estimated_D, normal_D, torch.nan)
        return self._record(rollout_ET, advantages_D)

    def _record(self, rollout_ET: TensorDictBase, advantages_D: Tensor) -> Tensor:
        width, actions = self.layout.out_width, self.layout.action_dim
        for place, key in enumerate(("action", "loc", "scale")):
            self._records[:, place * width : place * width + actions] = _time_major(rollout_ET.get(key))
        log_prob_D = rollout_ET.get("action_log_prob").transpose(0, 1).flatten()
        numbers = torch.stack([log_prob_D, advantages_D, self._values, self._targets], 1)
        self._records[:, 3 * width + LOG_PROB.value : 3 * width + MASK.value] = numbers
        self._records[:, 3 * width + MASK.value] = 1.0
        finite_D = _finite_rows(self._records) & _finite_rows(self._obs[0]) & _finite_rows(self._obs[1])
        # What takes no part must still be finite, since a zero times NaN is NaN. The mask of this row is zero.
        torch.where(finite_D[:, None], self._records, self._neutral, out=self._records)
        self._obs.masked_fill_(~finite_D[None, :, None], 0.0)
        return (~finite_D).sum()

    def _evaluate(self, obs_DL: Tensor, values_D: Tensor) -> None:
        state_values[(-(-self.size // self.tuning.block),)](
            obs_DL,
            self._weights[1],
            self._exact[1, self.layout.num_weights :],
            values_D,
            self.size,
            num_warps=self.tuning.warps,
            **self._sizes,
        )

    # -- the state, which is that of the modules and the optimizer ------------------------------------------------

    def _start_moments(self) -> None:
        for parameter in self._parameters:
            if parameter not in self.optimizer.state:
                self.optimizer.state[parameter] = {
                    "step": torch.zeros((), device=self._device),
                    "exp_avg": torch.zeros_like(parameter),
                    "exp_avg_sq": torch.zeros_like(parameter),
                }

    def _state(self) -> list[list[Tensor]]:
        states = [self.optimizer.state[parameter] for parameter in self._parameters]
        return [self._parameters, *([state[name] for state in states] for name in ("exp_avg", "exp_avg_sq"))]

    @torch.no_grad()
    def _load(self) -> None:
        for views, tensors in zip(self._views, self._state(), strict=True):
            torch._foreach_copy_(views, tensors)
        self._steps[0].copy_(self.optimizer.state[self._parameters[0]]["step"])
        self._exact.view(-1)[self._places] = self._flat[0]
        self._weights.copy_(self._exact)

    @torch.no_grad()
    def _store(self) -> None:
        for views, tensors in zip(self._views, self._state(), strict=True):
            torch._foreach_copy_(tensors, views)
        counts = [self.optimizer.state[parameter]["step"] for parameter in self._parameters]
        torch._foreach_copy_(counts, [self._steps[-1]] * len(counts))


def _time_major(leaf_ET: Tensor) -> Tensor:
    """Return `["E","T", L]` as [T * E, L]; a view where the memory is time-major."""
    return leaf_ET.transpose(0, 1).flatten(0, 1)


def _finite_rows(table_DL: Tensor) -> Tensor:
    """Return whether all elements of a row are finite, bool [D]: a sum is not where one of them is not."""
    # A product with ones reads the table at full speed, which a reduction of its short rows does not.
    return (table_DL @ table_DL.new_ones(table_DL.shape[1])).isfinite()


def _log(beta: float) -> float:
    return math.log(beta) if beta > 0.0 else -math.inf
