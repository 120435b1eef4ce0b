"""One transform of each class that we export, for any env of TorchRL."""

from collections.abc import Callable

from tensordict import NestedKey
from torchrl.envs.transforms import Transform

import ksim_rl.transforms as ours
from ksim_rl.transforms import (
    POLAR,
    ActionClip,
    ActionDelay,
    ActionLowPass,
    ActionScale,
    DelayCfg,
    EpisodeTracker,
    GaussianNoise,
    Mirror,
    MirrorMap,
    ObservationClip,
    ObservationDelay,
    ObservationGroups,
    ObservationHistory,
    ObservationHold,
    ObservationNoise,
    ObservationNormalization,
    ObservationScale,
    RewardClip,
    RewardScale,
    SuccessTracker,
    TimeAwareObservation,
    UniformNoise,
)

UNIFORM = UniformNoise(low=-1.0, high=1.0)
TURN = MirrorMap(source=(0,), signs=(-1.0,))

# One per class, for any env with three observed numbers under a key and one action in [-2, 2].
PORTABLE: dict[str, Callable[[NestedKey], Transform]] = {
    "ObservationNoise": lambda key: ObservationNoise(
        key, noise=GaussianNoise(std=0.1, bias=UNIFORM)
    ),
    "ObservationClip": lambda key: ObservationClip(key, clip=(-0.5, 0.5)),
    "ObservationScale": lambda key: ObservationScale(key, "scaled", scale=(1.0, 2.0, -3.0)),
    "ObservationDelay": lambda key: ObservationDelay(key, delay=DelayCfg(max_lag=3)),
    "ObservationHold": lambda key: ObservationHold(key, every=2, dropped=0.3, fresh_key="fresh"),
    "ObservationHistory": lambda key: ObservationHistory(key, "history", length=4),
    "ObservationGroups": lambda key: ObservationGroups({"actor": [key]}),
    "ObservationNormalization": lambda key: ObservationNormalization(key),
    "ActionDelay": lambda key: ActionDelay(delay=DelayCfg(max_lag=2)),
    "ActionClip": lambda key: ActionClip(clip=(-1.0, 1.0)),
    "ActionScale": lambda key: ActionScale(),
    "ActionLowPass": lambda key: ActionLowPass(alpha=0.5),
    "RewardScale": lambda key: RewardScale(scale=0.1),
    "RewardClip": lambda key: RewardClip(clip=(-1.0, 1.0)),
    "TimeAwareObservation": lambda key: TimeAwareObservation(horizon=200),
    "EpisodeTracker": lambda key: EpisodeTracker(),
    "SuccessTracker": lambda key: SuccessTracker("reward", threshold=-0.1),
    "Mirror": lambda key: Mirror(key, maps={key: POLAR, "action": TURN}),
}


def exported_transforms() -> set[str]:
    """Return the names of the transform classes that we export, without those that others are based on."""
    exported = [getattr(ours, name) for name in ours.__all__]
    classes = {
        value for value in exported if isinstance(value, type) and issubclass(value, Transform)
    }
    return {
        c.__name__ for c in classes if not any(issubclass(d, c) and d is not c for d in classes)
    }
