"""Makes each gradient step of a PPO update in a few Triton kernels, for most networks.

It has the results of `GAE`, `ClipPPOLoss` and `ppo_step` for an actor and a critic of `FusedNetworks`, from the same
config, in the same order of env states, and on the state of the same optimizer: a run can change from one to the other
at any update. Where they are multiplied, weights, observations, hidden layers and their gradients are rounded to 8
significant bits with bfloat16, with float32 to 11 (TF32); parameters, sums, losses and Adam stay float32.
"""

import itertools
import math
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int32, Int64
from numpy.polynomial.hermite_e import hermegauss
from tensordict import TensorDictBase
from torch import Tensor
from torch.nn import functional

from ksim_rl import ranks
from ksim_rl.device.memory import ROLLOUT_PARTS
from ksim_rl.device.streams import beside, warp_scope, warp_stream
from ksim_rl.objectives.algorithm_cfg import PPOCfg
from ksim_rl.objectives.fused_ppo.ahead import Ahead
from ksim_rl.objectives.fused_ppo.dataset import FusedDataset
from ksim_rl.objectives.fused_ppo.layer_kernels import layer, output_gradients
from ksim_rl.objectives.fused_ppo.layout import (
    ACTIVATIONS,
    FusedLayout,
    FusedNetworks,
    LayerPlace,
    Tuning,
    launch,
    parts,
    power_of_two,
)
from ksim_rl.objectives.fused_ppo.mlp_kernels import (
    lower_gradients,
    minibatch_gradients,
    network_outputs,
    weight_gradients,
)
from ksim_rl.objectives.fused_ppo.parameters import FusedParameters
from ksim_rl.objectives.fused_ppo.step_kernels import (
    SUMMARY,
    adam_step,
    mean_steps,
    sum_gradients,
    take_means,
)
from ksim_rl.objectives.gradient_step import StepGuard, rate_bounds
from ksim_rl.objectives.symmetry import SymmetricAugmentation

# Sums that each block leaves in addition to its gradients.
NUM_STATISTICS = 16
# Points of the quadrature for the entropy of squashed actions: it is good to 1e-3 nats for standard deviations to 1.5
# before the tanh.
NODES = 16
# As TF32, observations in two pieces take more registers than in one, up to so many columns.
TF32_PIECE = 256


def _squashing(networks: FusedNetworks, zeros_A: Tensor) -> dict[str, Any]:
    """Return the arguments of kernels for the entropy of squashed actions."""
    if networks.squashed is None:
        return {"nodes": None, "log_range": 0.0, "NODES": 0}
    policy = networks.squashed(zeros_A, zeros_A + 1.0)
    points, weights = hermegauss(NODES)
    nodes = torch.tensor(
        np.stack((points, weights / math.sqrt(2.0 * math.pi)), 1), dtype=torch.float32
    )
    # At the median only the range sets both densities apart.
    log_range = policy.base.log_prob(zeros_A) - policy.log_prob(policy.median)
    return {"nodes": nodes.to(zeros_A.device), "log_range": log_range.item(), "NODES": NODES}


class FusedPPO:
    """Makes the gradient steps of one update after another; all memory is allocated once, and nothing syncs.

    `why_not_fused` has no reason against its config. Moments, step counts and learning rate belong to `optimizer`,
    from `make_optimizer`. A symmetry of the config needs the `mirror`; else a ValueError is raised.
    """

    def __init__(
        self,
        cfg: PPOCfg,
        networks: FusedNetworks,
        *,
        optimizer: torch.optim.Adam,
        guard: StepGuard,
        num_env_states_per_minibatch: int,
        num_minibatches: int,
        mirror: SymmetricAugmentation | None = None,
        tuning: Tuning | None = None,
    ) -> None:
        if (mirror is None) != (cfg.symmetry == "none"):
            raise ValueError(
                f"mirror={mirror}: symmetry={cfg.symmetry!r} needs one, and 'none' has none"
            )
        self.cfg = cfg
        self.networks = networks
        self.optimizer = optimizer
        self.guard = guard
        self._mirrored = cfg.symmetry == "loss"
        self.layout = layout = FusedLayout(
            networks, chained=networks.chained and not self._mirrored
        )
        device = networks.parameters[0].device
        dtype = getattr(torch, cfg.precision)
        tf32 = self._tf32 = (
            dtype is torch.float32 and torch.get_float32_matmul_precision() != "highest"
        )
        self.tuning = tuning = tuning or Tuning.of(layout, dtype)
        self.batch = num_env_states_per_minibatch
        # With the mirror images behind.
        rows = self.batch if mirror is None else 2 * self.batch
        steps = cfg.num_epochs * num_minibatches
        self._side = warp_stream(torch.cuda.Stream(device)) if device.type == "cuda" else None
        self.parameters = FusedParameters(
            networks,
            layout,
            optimizer=optimizer,
            dtype=dtype,
            tf32=tf32,
            num_steps=steps,
            size=tuning.size,
        )
        self.dataset = FusedDataset(
            cfg,
            layout,
            networks=networks,
            size=num_env_states_per_minibatch * num_minibatches,
            dtype=dtype,
            tf32=tf32,
            device=device,
            mirror=mirror,
        )
        self._summary = torch.zeros(steps, power_of_two(len(SUMMARY) + 1), device=device)
        self._step_means = torch.zeros_like(self._summary[0])
        self._longest_skip = torch.zeros((), dtype=torch.int64, device=device)
        self._rows: Tensor | None = None
        # Splits whose layer inputs and gradients exist at a time. The loss of a mirror image reads the whole minibatch;
        # chained kernels leave out half of its columns.
        self._splits = (
            tuning.splits if self._mirrored or layout.chained else parts(tuning.splits, 2)
        )
        self._arguments = self._all_arguments(rows, mirror)

        def launch_all() -> None:
            self._multiply(torch.zeros(rows, dtype=torch.int32, device=device))
            self._improve(0)
            launch(mean_steps, (1,), self._arguments, summary=self._summary)
            for listed in ({}, self.dataset.listed):
                self._evaluate(
                    self.dataset.obs[1], self.dataset.records[:, 0].contiguous(), **listed
                )
            self.means(torch.zeros(rows, layout.obs_dims[0], device=device))

        # Until the first update. One after another, kernels took ten of a cold start's seconds.
        self._ahead = (
            Ahead(ThreadPoolExecutor()) if device.type == "cuda" and layout.chained else None
        )
        if self._ahead is not None:
            self._ahead.add(launch_all)

    def _all_arguments(self, rows: int, mirror: SymmetricAugmentation | None) -> dict[str, Any]:
        """Return the arguments of kernels in every step, by name; `rows` is the number of rows of a minibatch."""
        cfg = self.cfg
        layout = self.layout
        tuning = self.tuning
        dataset = self.dataset
        parameters = self.parameters
        zeros = partial(torch.zeros, device=dataset.records.device)
        blocks = parts(rows, tuning.block)
        dtype = dataset.obs.dtype
        held = min(rows, self._splits * self._split(rows))
        programs = 2 * parts(layout.num_padded, tuning.size) + 2
        # Where the image of each action comes from, counted from 1, times its sign; see `output_gradients`.
        image_of = torch.arange(1, layout.out + 1, device=dataset.records.device, dtype=torch.int32)
        if mirror is not None:
            actions = image_of[None, : layout.actions].to(torch.float32)
            image_of[: layout.actions] = mirror.image_of("action", actions)[0]
        clip_value = cfg.clip_epsilon if cfg.clip_value is True else float(cfg.clip_value)
        described = (self.networks, layout, tuning)
        return {
            **vars(cfg),
            **{name.upper(): value for part in described for name, value in vars(part).items()},
            **dict(zip(("H1", "H2", "H3"), layout.hidden, strict=False)),
            **({"HEAD": layout.obs, "REST": 0} if self._tf32 and layout.obs <= TF32_PIECE else {}),
            **dict(zip(("parameters", "means", "variances"), parameters.flat, strict=True)),
            **dict(zip(("beta1", "beta2"), cfg.betas, strict=True)),
            **{
                f"log_beta{i}": math.log(beta) if beta > 0.0 else -math.inf
                for i, beta in enumerate(cfg.betas, 1)
            },
            "places": parameters.places,
            "weights": parameters.weights,
            "exact_weights": parameters.exact,
            "biases": parameters.biases_2N,
            "obs": dataset.obs,
            "records": dataset.records,
            "num_obs": len(dataset.records),
            "num_rows": rows,
            "step_means": self._step_means,
            "longest_skip": self._longest_skip,
            "tiles": layout.weight_tiles(tuning.tile).to(dataset.records.device),
            "inputs": zeros(2 * held * layout.inputs, dtype=dtype),
            "slopes": zeros(2 * held * layout.gradients, dtype=dtype),
            "weight_partials": zeros(tuning.splits, 2, layout.num_padded),
            "block_partials": zeros(blocks, 2, layout.out + NUM_STATISTICS),
            # Of both networks; ranks add them up together with the summary behind them.
            "gradients": zeros(2 * layout.num_padded + self._summary.shape[1]),
            "squares": zeros(programs),
            "image_of": image_of,
            "rate_bounds": rate_bounds(cfg, self.optimizer),
            "skipped": self.guard.skipped,
            "skipped_in_a_row": self.guard.skipped_in_a_row,
            "clip_value": clip_value,
            "log_ratio_low": math.log1p(-cfg.clip_epsilon) if cfg.clip_epsilon < 1.0 else -math.inf,
            "log_ratio_high": math.log1p(cfg.clip_epsilon),
            "max_grad_norm": cfg.max_grad_norm or 0.0,
            "ACTIVATION": ACTIVATIONS.index(self.networks.activation),
            "STATE_STD": self.networks.std_layer is not None,
            **_squashing(self.networks, zeros(layout.actions)),
            "RECORD": dataset.records.shape[1],
            "NUM_STATISTICS": NUM_STATISTICS,
            "STEPS": len(self._summary),
            "POWER_OF_STEPS": power_of_two(len(self._summary)),
            "COLUMNS": self._summary.shape[1],
            "NUM_GRADIENTS": 2 * layout.num_padded,
            "NUM_SQUARES": programs,
            "SQUARES": power_of_two(programs),
            "BLOCKS": blocks,
            "MIRROR": self._mirrored,
            "CLIP_VALUE": clip_value > 0.0,
            "TF32": self._tf32,
            "ADAPTIVE": cfg.schedule == "adaptive",
            "RANKS": ranks.size(),
            "CLIP": cfg.max_grad_norm is not None,
        }

    def __call__(
        self,
        rollout_ET: TensorDictBase,
        orders_KD: Int64[Tensor, "K D"],
        *meanwhile: Callable[[], None],
    ) -> tuple[dict[str, Float[Tensor, ""]], Int64[Tensor, ""], Int32[Tensor, ""]]:
        """Make all gradient steps of an update.

        `rollout_ET`, `["E","T"]`, may be time-major in memory, as a collector's. `orders_KD` has for each epoch the
        env states in the order of the minibatches, counted env by env; a GPU calls `meanwhile` during the steps.
        Returned are means over the steps that were made, by the names of `SUMMARY`, how many in a row were not at most,
        both in the same memory each time, and how many env states took no part as an element was not finite.
        """
        num_envs, length = rollout_ET.batch_size
        with warp_scope(self._summary.device):
            if self._ahead is not None:
                self._ahead.add(lambda: self.dataset.read(rollout_ET, evaluate=self._evaluate))
                self._ahead.wait()
                self._ahead = None
            # One after the other: of two branches, a graph sends the longer one first, with all its steps, and the
            # other starts 0.17 ms later. Drawing takes a third of that.
            if self._rows is None:
                # From env by env to step by step.
                rows = torch.arange(num_envs * length, dtype=torch.int32, device=orders_KD.device)
                self._rows = rows.view(length, num_envs).t().flatten()
            indices = self._rows[orders_KD.flatten()].split(self.batch)
            self.parameters.load()
            left_out = self.dataset.read(rollout_ET, evaluate=self._evaluate)
            with beside(self._side, *meanwhile):
                for step, index_B in enumerate(indices):
                    if len(self.dataset.records) > self.dataset.size:
                        index_B = torch.cat([index_B, index_B + self.dataset.size])
                    self._multiply(index_B)
                    self._improve(step)
            self.parameters.store()
            launch(mean_steps, (1,), self._arguments, summary=self._summary)
        names = SUMMARY if self._mirrored else SUMMARY[:-1]
        return (
            dict(zip(names, self._step_means.unbind(), strict=False)),
            self._longest_skip,
            left_out,
        )

    @torch.no_grad()
    def means(self, obs_EL: Float[Tensor, "*batch L"]) -> Float[Tensor, "*batch A"]:
        """Return mean actions for raw observations, as chained kernels have them, with the weights loaded last."""
        means_EA = obs_EL.new_empty(*obs_EL.shape[:-1], self.layout.actions)
        rows_EL = obs_EL.flatten(0, -2).contiguous()
        self._answer(
            0, rows_EL, means_EA.flatten(0, -2), **self.networks.observers[0].moments_given
        )
        return means_EA

    def _answer(self, network: int, obs: Tensor, outputs: Tensor, **given: Any) -> None:
        """Write the outputs of a network of chained kernels for `obs` [D, L], as many columns as `outputs` has."""
        own = {"obs": obs, "outputs": outputs, "num_rows": len(obs), "LISTED": "count" in given}
        own |= {
            "WIDTH": obs.shape[1],
            "COLUMNS": outputs.stride(0),
            "NORMALIZED": False,
            "eps": 0.0,
        }
        own |= {
            "weights": self.parameters.weights[network],
            "biases": self.parameters.biases_2N[network],
        }
        own |= {"mean": None, "var": None, "count": None, **given}
        grid = (parts(len(obs), self.tuning.block),)
        launch(network_outputs, grid, self._arguments, num_warps=self.tuning.warps, **own)

    def _split(self, rows: int) -> int:
        """Return how many rows of a minibatch are a split: a whole number of steps of `weight_gradients`."""
        tuning = self.tuning
        return parts(rows, tuning.splits * tuning.depth) * tuning.depth

    def _multiply(self, index_B: Tensor) -> None:
        """Run a minibatch through both networks and back, up to the gradients of the weights, some splits at a time."""
        tuning = self.tuning
        split = self._split(len(index_B))
        own = self._arguments
        for number, part_B in enumerate(index_B.split(self._splits * split)):
            first = number * self._splits
            given = own | {
                "order": part_B,
                "num_rows": len(part_B),
                "BLOCKS": parts(len(part_B), tuning.block),
                "block_partials": own["block_partials"][first * split // tuning.block :],
                "weight_partials": own["weight_partials"][first:],
            }
            if self.layout.chained:
                launch(minibatch_gradients, (given["BLOCKS"], 2), given, num_warps=tuning.warps)
                grid = self.layout.hidden[0] // tuning.lower, self._splits, 2
                launch(lower_gradients, grid, given, num_warps=tuning.lower_warps, ROWS=split)
            else:
                self._multiply_by_layers(given)
            grid = len(given["tiles"]), self._splits
            launch(weight_gradients, grid, given, num_warps=tuning.tile_warps, ROWS=split)

    def _multiply_by_layers(self, given: Mapping[str, Any]) -> None:
        """Leave the results of `minibatch_gradients`, with kernels of each layer."""
        layout = self.layout
        tuning = self.tuning
        index_B = given["order"]
        weights = self.parameters.weights
        biases = self.parameters.biases_2N
        seen = given["inputs"][: 2 * len(index_B) * layout.inputs].view(2, len(index_B), -1)
        seen[..., : layout.obs] = self.dataset.obs[:, index_B]

        def run(at: LayerPlace, following: LayerPlace, *, forward: bool) -> None:
            own = at if forward else following
            grid = given["BLOCKS"], parts(at.fan_out, tuning.tile), 2
            places = {
                "weights": weights[:, own.weight :],
                "biases": biases[:, at.bias :],
                "width": at.fan_out,
                "length": at.fan_in if forward else following.fan_out,
                "read_at": at.input if forward else following.gradient,
                "slope_at": at.gradient,
                "output_at": following.input,
            }
            launch(layer, grid, given, num_warps=tuning.tile_warps, FORWARD=forward, **places)

        pairs = list(itertools.pairwise(layout.places))
        for at, following in pairs:
            run(at, following, forward=True)
        last = layout.places[-1]
        places = {
            "weights": weights[:, last.weight :],
            "biases": biases[:, last.bias :],
            "fan_in": last.fan_in,
            "input_at": last.input,
            "slope_at": last.gradient,
        }
        grid = given["BLOCKS"], 2
        launch(output_gradients, grid, given, num_warps=tuning.tile_warps, **places)
        for at, following in reversed(pairs):
            run(at, following, forward=False)

    def _improve(self, step: int) -> None:
        """Add the parts up, over all ranks by one collective, and make the step of the optimizer."""
        summary = self._summary[step]
        given = self._arguments
        rate = self.optimizer.param_groups[0]["lr"]
        own = summary if ranks.size() == 1 else given["gradients"][given["NUM_GRADIENTS"] :]
        programs = len(given["squares"])
        launch(sum_gradients, (programs,), given, learning_rate=rate, summary=own)
        if ranks.size() > 1:
            ranks.sum_(given["gradients"])
            launch(take_means, (programs,), given, learning_rate=rate, summary=summary)
        sizes = {"SIZE": self.layout.num_flat, "BLOCK": self.tuning.size}
        grid = (parts(self.layout.num_flat, self.tuning.size),)
        launch(adam_step, grid, given, summary=summary, steps=self.parameters.steps[step:], **sizes)

    def _evaluate(self, obs_DL: Tensor, values_D: Tensor, **listed: Tensor) -> None:
        """Write the values of observations; `listed`, of some rows to some places (see `network_outputs`)."""
        if self.layout.chained:
            return self._answer(1, obs_DL, values_D, **listed)
        *layers, last = self.networks.critic
        activation = self.networks.activation()
        # The hidden layers of some env states at a time: they take several times the memory of these.
        for obs_BL, values_B in zip(
            obs_DL.chunk(ROLLOUT_PARTS), values_D.chunk(ROLLOUT_PARTS), strict=True
        ):
            hidden_BL = obs_BL[:, : self.layout.obs_dims[1]]
            for below in layers:
                weight = below.weight.to(obs_DL.dtype)
                bias = below.bias.to(obs_DL.dtype)
                hidden_BL = activation(functional.linear(hidden_BL, weight, bias))
            values_B.copy_(last(hidden_BL.to(values_D.dtype)).squeeze(-1))
