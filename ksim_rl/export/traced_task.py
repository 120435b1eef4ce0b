"""Traces what a policy observes, and the rewards, terminations and metrics that a simulator rates it by."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Shaped
from torch import Tensor

from ksim_rl.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg
from ksim_rl.export.refusal import NotDescribedError
from ksim_rl.export.standalone.files import Json
from ksim_rl.export.standalone.network import Network
from ksim_rl.export.tracing import Called, Traced, trace

# Steps and rows of an env over which the observations of a file are compared with the env's own.
COMPARED_STEPS = 20
COMPARED_ROWS = 4
# Greatest difference, relative to observations above 1, which float32 holds no better.
TOLERANCE = 1e-4


@dataclass(frozen=True, kw_only=True)
class TracedTask:
    """The terms of a task as functions of a robot's measurements.

    Attributes:
        obs: the terms that the policy observes, before noise, clip, scale, delay and history; None if it only sees.
        scores: terminations, then rewards, then metrics; None for a task without any.
        scored: names of these, by kind, in this order.
        left_out: those that cannot be traced, such as "rewards.riddle".
    """

    obs: Traced | None
    scores: Traced | None
    scored: Mapping[str, Sequence[str]]
    left_out: Sequence[str]

    def reads(self, name: str) -> list[str]:
        """Return the inputs of obs.onnx that an observation term reads."""
        assert self.obs is not None  # it has the term
        return list(self.obs.reads[f"observations/{name}"])

    def described(self) -> Json:
        """Return the entries of `export.json`."""
        return {
            "obs": self.obs.described() if self.obs else None,
            "scores": self.scores.described() if self.scores else None,
        }


def trace_task(
    env: ManagerBasedRlEnv, groups: Sequence[str], note: Callable[[str], None]
) -> TracedTask:
    """Trace the terms of vector groups, and the terms that rate an episode; of these, untraceable ones are left out.

    Raises NotDescribedError, naming the term, for one that the policy observes.
    """
    observed: list[tuple[str, Called]] = []
    for group in groups:
        for name, cfg in env.cfg.observations[group].terms.items():
            term = (f"observations/{name}", cfg.term)
            # Each by itself first, so that a refusal can say where it stands.
            try:
                trace(env, [term], output="obs")
            except NotDescribedError as error:
                raise NotDescribedError(
                    f"task.observations.{group}.terms.{name}: {error}; or leave the term out"
                ) from None
            observed.append(term)
    scored: dict[str, list[str]] = {}
    scores: list[tuple[str, Called]] = []
    left_out: list[str] = []
    for kind, terms in _scoring(env.cfg).items():
        scored[kind] = []
        for name, term in terms.items():
            try:
                trace(env, [(f"{kind}/{name}", term)], output="scores")
            except NotDescribedError as error:
                left_out.append(f"{kind}.{name}")
                note(f"task.{kind}.{name} is left out of sim2sim: {error}")
                continue
            scored[kind].append(name)
            scores.append((f"{kind}/{name}", term))
    return TracedTask(
        obs=trace(env, observed, output="obs") if observed else None,
        scores=trace(env, scores, output="scores") if scores else None,
        scored=scored,
        left_out=left_out,
    )


def _scoring(cfg: ManagerBasedRlEnvCfg) -> dict[str, dict[str, Called]]:
    """Return the terms that rate an episode, by kind and name, in the order in which they run."""
    return {
        # The runner knows the time limit from `episode_steps`.
        "terminations": {
            n: term for n, term in cfg.terminations.items() if type(term).__name__ != "TimeOut"
        },
        # A reward of weight 0 is not computed.
        "rewards": {n: term for n, term in cfg.rewards.items() if term.weight != 0.0},
        "metrics": {n: term for n, term in cfg.metrics.items() if term.reduce == "mean"},
    }


@torch.no_grad()
def greatest_difference(
    traced: Traced, env: ManagerBasedRlEnv, path: Path, names: Sequence[str]
) -> float:
    """Return the greatest difference of a file's observations from the env's own, over some steps of some rows.

    It is relative to observations above 1. Actions are random, so that episodes end meanwhile; `names` are the terms in
    the order of the file. Raises NotDescribedError, naming the term, where it is above `TOLERANCE`.
    """
    described = traced.described()
    rows = range(min(COMPARED_ROWS, env.num_envs))
    networks = [Network(path, described["states"], traced.output) for _ in rows]
    worst = 0.0
    current = env.reset()
    for step in range(COMPARED_STEPS + 1):
        given = {one.name: _numbers(one.measurement.read(env.view)) for one in traced.inputs}
        wanted_EL = {name: _numbers(current["obs", name]) for name in names}
        for row, network in zip(rows, networks, strict=True):
            found_L = network.run({name: value[row] for name, value in given.items()})
            network.advance()
            wanted = {name: value_EL[row] for name, value_EL in wanted_EL.items()}
            for name, error in _errors(found_L, wanted).items():
                # Written so that NaN is refused, too.
                if not error <= TOLERANCE:
                    raise NotDescribedError(
                        f"task.observations: term {name!r} differs by {error:.2g} at step {step} from what {path.name} "
                        "makes of the same quantities: it reads something that changes and is none of the view's "
                        "quantities; keep it in `view.buffer`, or leave the term out"
                    )
                worst = max(worst, error)
        done_E = torch.zeros(env.num_envs, dtype=torch.bool)
        if step < COMPARED_STEPS:
            stepped, current = env.step_and_maybe_reset(env.rand_action(current))
            done_E = stepped["next", "done"][:, 0].cpu()
        for row, network in zip(rows, networks, strict=True):
            if done_E[row]:
                network.reset()
    return worst


def _errors(found_L: np.ndarray, wanted: Mapping[str, np.ndarray]) -> dict[str, float]:
    """Return the greatest error of each term; the numbers of the terms are concatenated in `found`."""
    errors = {}
    start = 0
    for name, wanted_L in wanted.items():
        found_of_term_L = found_L[start : start + len(wanted_L)]
        start += len(wanted_L)
        error_L = np.abs(found_of_term_L - wanted_L) / np.maximum(np.abs(wanted_L), 1.0)
        errors[name] = float(error_L.max(initial=0.0))
    return errors


def _numbers(values: Shaped[Tensor, "*shape"]) -> np.ndarray:
    return values.detach().cpu().numpy()
