"""Sorts the transforms of a task for an export: stages of actions, parts of the policy, or left out."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import singledispatch
from typing import Any

import torch
from jaxtyping import Float
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor, nn
from torchrl.envs import EnvBase
from torchrl.envs.transforms import Transform

from ksim_rl.envs import ManagerBasedRlEnvCfg
from ksim_rl.export.refusal import NotDescribedError
from ksim_rl.export.standalone.description import (
    ClipStage,
    DelayStage,
    LagSpec,
    LowPassStage,
    ScaleStage,
    StageSpec,
)
from ksim_rl.modules.upstream import TensorModule
from ksim_rl.transforms import (
    ActionClip,
    ActionDelay,
    ActionLowPass,
    ActionScale,
    DelayCfg,
    ObservationNoise,
)
from ksim_rl.transforms.elementwise import ObservationMap

# Steps over which an env is compared with one whose transforms are parts of the policy.
COMPARED_STEPS = 20


@dataclass(frozen=True, kw_only=True)
class TaskTransforms:
    """The exported form of all transforms of a task that a policy or its robot notices.

    Attributes:
        stages: descriptions of what an action passes on its way to the action terms, in this order.
        in_policy: transforms of observations that become parts of the policy, in the order in which they run.
        training_only: names of those that do nothing in evaluation.
    """

    stages: list[StageSpec]
    in_policy: dict[str, Transform]
    training_only: list[str]

    @property
    def removed(self) -> set[str]:
        """Names of those that an env must not have that runs the policy of an export."""
        return {*self.in_policy, *self.training_only}


def lag(cfg: DelayCfg | None, shared: str | None = None) -> LagSpec | None:
    """Return a lag in env steps."""
    if cfg is None:
        return None
    # `initial` None: the first value of an episode fills the lag.
    return {
        "min": cfg.min_lag,
        "max": cfg.max_lag,
        "resample_every": cfg.resample_every,
        "hold_probability": cfg.hold_probability,
        "shared": shared,
        "initial": None,
    }


@singledispatch
def stage(transform: Any) -> StageSpec:
    """Return the description of a transform of actions; `stage.register(Kind)` adds one for transforms of yours.

    Kinds are "delay", "low_pass", "clip" and "scale", with the entries that the functions below give. Raises
    NotDescribedError where there is none.
    """
    kind = type(transform).__name__
    raise NotDescribedError(
        f"{kind} has no description: an export takes ActionDelay, ActionLowPass, ActionClip and ActionScale; write a "
        f"function (transform) that returns one of their stages, with @ksim_rl.export.stage.register({kind}) above, or "
        "use the fields of action terms"
    )


@stage.register
def _(transform: ActionDelay) -> DelayStage:
    steps = lag(transform.delay)
    # A transform without a delay would not be there.
    assert steps is not None
    return DelayStage(**{**steps, "initial": transform.initial}, kind="delay")


@stage.register
def _(transform: ActionLowPass) -> LowPassStage:
    return {"kind": "low_pass", "alpha": transform.alpha, "initial": transform.initial}


@stage.register
def _(transform: ActionClip) -> ClipStage:
    low, high = transform.ranges[0]
    return {"kind": "clip", "low": low, "high": high}


@stage.register
def _(transform: ActionScale) -> ScaleStage:
    # Bounds are known to an env only.
    if transform.scale is None:
        raise NotDescribedError(
            "ActionScale without scale takes the bounds of its env: give scale and offset"
        )
    return {"kind": "scale", "scale": transform.scale, "offset": transform.offset}


class PerObservation(nn.Module):
    """A transform as a function of each observation by itself: tensors [..., L] to as many [..., M]."""

    def __init__(self, transform: Transform) -> None:
        super().__init__()
        self.transform = transform

    def forward(
        self, *observations: Float[Tensor, "*batch ?L"]
    ) -> tuple[Float[Tensor, "*batch ?M"], ...]:
        """Return the new observations."""
        if isinstance(self.transform, ObservationMap):
            return tuple(self.transform.new_value(*indexed) for indexed in enumerate(observations))
        return tuple(self.transform._apply_transform(obs) for obs in observations)


def sort_transforms(cfg: ManagerBasedRlEnvCfg, groups: Sequence[NestedKey]) -> TaskTransforms:
    """Sort the transforms of a task whose policy reads some observation groups.

    Raises NotDescribedError, naming the transform and the way out, for one that an export can neither leave out, nor
    describe, nor run as a part of the policy.
    """
    stages: list[StageSpec] = []
    in_policy: dict[str, Transform] = {}
    training_only: list[str] = []
    given = {unravel_key(group) for group in groups}
    read = set(given)
    # The transform that was appended last meets an action first; and what reads an observation comes after its writer.
    for name, described in reversed(list(cfg.transforms.items())):
        transform = described.build(name)
        where = f"task.transforms.{name}"
        if transform.in_keys_inv:
            try:
                stages.append(stage(transform))
            except NotDescribedError as error:
                raise NotDescribedError(f"{where}: {error}") from None
        # Rewards, counters and other keys that the policy does not read are no matter of an export.
        if not read & {unravel_key(key) for key in transform.out_keys or ()}:
            continue
        if isinstance(transform, ObservationNoise) or getattr(
            transform, "acts_in_training_only", False
        ):
            training_only.insert(0, name)
            continue
        _check_per_observation(transform, where)
        in_policy = {name: transform, **in_policy}
        read |= {unravel_key(key) for key in transform.in_keys}
    missing = sorted(map(str, read - given))
    if missing:
        writers = ", ".join(f"task.transforms.{name}" for name in in_policy)
        raise NotDescribedError(
            f"{writers}: it makes what the policy reads of {missing[0]!r}, which the policy does not read: an export "
            f"takes transforms of {', '.join(map(str, groups))} alone"
        )
    return TaskTransforms(stages=stages, in_policy=in_policy, training_only=training_only)


def _check_per_observation(transform: Transform, where: str) -> None:
    kind = type(transform)
    if isinstance(transform, ObservationMap):
        return
    # A class with more than a function of one observation may keep something from step to step.
    own = [
        name
        for name in ("_call", "_step", "forward")
        if getattr(kind, name) is not getattr(Transform, name)
    ]
    if kind._apply_transform is Transform._apply_transform:
        own.append("no _apply_transform")
    if own:
        raise NotDescribedError(
            f"{where}: {kind.__name__} acts in evaluation, and is more than a function of each observation by itself "
            f"(it has {', '.join(own)}): an export takes transforms of observations whose `_apply_transform` does all; "
            "use the fields of observation groups (history, delay, clip, scale), or set `acts_in_training_only = True` "
            "in the class if that is so"
        )


def with_transforms(actor: TensorDictModuleBase, sorted_: TaskTransforms) -> TensorDictModuleBase:
    """Return a policy that runs the transforms of observations itself."""
    if not sorted_.in_policy:
        return actor
    parts: list[Any] = []
    for transform in sorted_.in_policy.values():
        keys: dict[str, Any] = {
            "in_keys": list(transform.in_keys),
            "out_keys": list(transform.out_keys),
        }
        parts.append(TensorModule(PerObservation(transform).eval(), **keys))
    parts.append(actor)
    return TensorDictSequential(*parts)


@torch.no_grad()
def check_equal(
    whole: EnvBase, reduced: EnvBase, sorted_: TaskTransforms, groups: Sequence[NestedKey]
) -> None:
    """Refuse transforms that give other observations as parts of a policy than in the env, over some steps.

    Both envs have the same seed and size; `reduced` has none of `sorted_.removed`. A NotDescribedError names them.
    """
    names = ", ".join(f"task.transforms.{name}" for name in sorted_.in_policy)
    run = with_transforms(
        TensorDictModule(nn.Identity(), in_keys=["done"], out_keys=["done"]), sorted_
    )
    whole.eval()
    reduced.eval()
    one = whole.reset()
    other = reduced.reset()
    for step in range(COMPARED_STEPS + 1):
        made = run(other.clone())
        for group in groups:
            if not torch.allclose(one[group], made[group], rtol=1e-5, atol=1e-6):
                raise NotDescribedError(
                    f"{names}: observation {group!r} differs at step {step} from what `_apply_transform` makes of a "
                    "single observation: an export takes transforms that keep nothing from step to step"
                )
        # The same actions; the last step's is of no use.
        action = whole.rand_action(one.clone())
        one = whole.step_and_maybe_reset(action)[1]
        for key in whole.action_keys:
            other.set(key, action[key])
        other = reduced.step_and_maybe_reset(other)[1]
