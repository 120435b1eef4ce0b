"""Judges many generated models, in child processes, and sums up the findings."""

import dataclasses
import time
import traceback
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import mujoco
import warp as wp

from benchmarks.judge.comparison import Finding
from benchmarks.judge.generator import FEATURES, Generated, generate
from benchmarks.judge.shrinking import shrunk
from benchmarks.judge.trial import Kernels, Verdict, judge
from benchmarks.judge.workers import in_processes

MOST_SECONDS = 600.0
SHOWN = 6


@dataclasses.dataclass(frozen=True, kw_only=True)
class Task:
    """One model of a hunt.

    Args:
        seed, number: which one.
        device: where its worlds are.
        shrinks: whether it is made small if it fails.
    """

    seed: int
    number: int
    device: str = "cpu"
    shrinks: bool = False


@dataclasses.dataclass(frozen=True, kw_only=True)
class Outcome:
    """What became of a model.

    Attributes:
        generated: the model.
        verdict: what was found.
        error: what was raised, which no model should.
        smallest: the model made small, and its fields, where it failed and that was asked for.
    """

    generated: Generated
    verdict: Verdict = Verdict()
    error: str = ""
    smallest: tuple[str, tuple[str, ...]] | None = None

    @property
    def fails(self) -> bool:
        """Whether something differs from C, or was raised."""
        return bool(self.error or self.verdict.findings)


def kernels_of(number: int) -> Kernels:
    """Return whose kernels a model is asked to run by: mostly ours, which not all models can."""
    return "our solver" if number % 8 == 7 else "ours"


def compile_quickly(device: str) -> None:
    """Let kernels of the CPU compile in less time: most of it goes into that, and they run for an instant."""
    # On GPUs it takes as long at any level, and kernels are to be those that others run.
    if device == "cpu":
        wp.config.optimization_level = 0


def judged(task: Task) -> Outcome:
    """Judge a model of a hunt."""
    compile_quickly(task.device)
    found = generate(task.seed, task.number)
    try:
        verdict = _judge(found, found.xml, found.fields, task.device)
    except Exception:
        return Outcome(generated=found, error=traceback.format_exc(limit=-6))
    if not (task.shrinks and verdict.findings):
        return Outcome(generated=found, verdict=verdict)
    kind = verdict.findings[0].kind

    def fails(xml: str, fields: tuple[str, ...]) -> bool:
        try:
            mujoco.MjModel.from_xml_string(xml)
            smaller = _judge(found, xml, fields, task.device)
        except Exception:
            # What is left out may be what another part needs.
            return False
        return any(finding.kind == kind for finding in smaller.findings)

    return Outcome(
        generated=found, verdict=verdict, smallest=shrunk(found.xml, found.fields, fails)
    )


def _judge(found: Generated, xml: str, fields: tuple[str, ...], device: str) -> Verdict:
    return judge(
        xml,
        fields=fields,
        kernels=kernels_of(found.number),
        forces="forces" in found.features,
        seed=found.number,
        device=device,
    )


def hunt(
    count: int,
    *,
    seed: int,
    device: str,
    jobs: int,
    shrinks: bool = False,
    most_minutes: float = float("inf"),
) -> list[Outcome]:
    """Judge `count` models, as many of them as begin in time, and print each that fails."""
    tasks = [
        Task(seed=seed, number=number, device=device, shrinks=shrinks) for number in range(count)
    ]
    until = time.monotonic() + 60.0 * most_minutes
    outcomes = []
    for task, result in in_processes(
        judged, tasks, jobs=jobs, most_seconds=MOST_SECONDS, until=until, spoils=has_error
    ):
        outcome = result
        if isinstance(result, RuntimeError):
            outcome = Outcome(generated=generate(task.seed, task.number), error=str(result))
        outcomes.append(outcome)
        if outcome.fails:
            print("\n".join(told(outcome)), flush=True)
    return outcomes


def has_error(result: object) -> bool:
    """Whether something was raised, after which a GPU may compute nothing further in that process."""
    return bool(getattr(result, "error", True))


def told(outcome: Outcome) -> list[str]:
    """Return the lines that tell how a model fails."""
    found, verdict = outcome.generated, outcome.verdict
    lines = [
        f"model {found.number} of seed {found.seed}, by {verdict.kernels or 'none'}, fields {found.fields}"
    ]
    if outcome.error:
        lines.append(outcome.error)
    lines += told_of(verdict.findings)
    if outcome.smallest is not None:
        lines += [outcome.smallest[0], f"    fields {outcome.smallest[1]}"]
    return lines


def told_of(findings: Sequence[Finding]) -> list[str]:
    """Return a line for the first finding of each kind."""
    first: dict[str, Finding] = {}
    for finding in findings:
        first.setdefault(finding.kind, finding)
    return [
        f"    {finding.quantity}: {finding.error:.3g} apart, allowed {finding.limit:.3g}, in world "
        f"{finding.world} after {finding.when}"
        for finding in list(first.values())[:SHOWN]
    ]


def stepped(outcomes: Sequence[Outcome]) -> list[Outcome]:
    """Return the outcomes of models that were built and stepped."""
    return [outcome for outcome in outcomes if outcome.verdict.states > 0]


def figures(outcomes: Sequence[Outcome]) -> dict[str, float]:
    """Return the figures of a hunt by name: `models` were built and stepped, and what raised is worse, too."""
    ran = stepped(outcomes)
    refused = sum(bool(outcome.verdict.refused) for outcome in outcomes)
    features = Counter(name for outcome in ran for name in outcome.generated.features)
    states = sum(outcome.verdict.states for outcome in ran)
    by = Counter(outcome.verdict.kernels for outcome in ran)
    return {
        "models": len(ran),
        "states": states,
        "refused": refused,
        "refused_share": refused / max(1, len(outcomes)),
        "worse": sum(outcome.fails for outcome in outcomes),
        "resets": sum(outcome.verdict.reset for outcome in ran),
        "compiled_worlds": sum(outcome.verdict.compiled for outcome in ran),
        "short_of_room": sum(outcome.verdict.short_of_room for outcome in ran),
        "overflows_told": sum(bool(outcome.verdict.overflow) for outcome in ran),
        "least_of_a_feature": min(features[name] for name in FEATURES),
        "touching_share": sum(outcome.verdict.touching for outcome in ran) / max(1, len(ran)),
        "accepted_states": sum(outcome.verdict.accepted for outcome in ran),
        "unsteady_states": sum(outcome.verdict.unsteady for outcome in ran),
        "by_our_kernels": by["ours"],
        "by_our_solver": by["our solver"],
        "by_mujoco_warp": by["theirs"],
    }


def refusals(outcomes: Sequence[Outcome]) -> dict[str, int]:
    """Return how many models were refused, by reason."""
    reasons = Counter(outcome.verdict.refused for outcome in outcomes if outcome.verdict.refused)
    return dict(reasons.most_common())


def features_of(outcomes: Sequence[Outcome]) -> dict[str, int]:
    """Return in how many models that ran each feature was."""
    ran = stepped(outcomes)
    counts = Counter(name for outcome in ran for name in outcome.generated.features)
    return {name: counts[name] for name in sorted(FEATURES)}


def keep_failures(outcomes: Sequence[Outcome], folder: Path) -> None:
    """Write the models that fail into a folder: as generated, and made small."""
    for outcome in outcomes:
        if not outcome.fails:
            continue
        folder.mkdir(parents=True, exist_ok=True)
        name = f"seed{outcome.generated.seed}_{outcome.generated.number}"
        (folder / f"{name}.xml").write_text(outcome.generated.xml)
        (folder / f"{name}.txt").write_text("\n".join(told(outcome)) + "\n")
        if outcome.smallest is not None:
            (folder / f"{name}_small.xml").write_text(outcome.smallest[0])
