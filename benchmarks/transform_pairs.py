"""Each transform and the nearest one of TorchRL's own, for benchmarks.transforms."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import torch
from torch import Tensor
from torchrl.envs.transforms import (
    ActionScaling,
    CatFrames,
    CatTensors,
    ClipTransform,
    Compose,
    ObservationNorm,
    RewardClipping,
    RewardScaling,
    RewardSum,
    StepCounter,
    Transform,
    UnaryTransform,
    VecNormV2,
)

from benchmarks.transforms_env import TERMS
from ksim_rl import transforms as ours
from ksim_rl.transforms import DelayCfg, GaussianNoise, UniformNoise

NAMES = list(TERMS)
HISTORY = 10
MAX_LAG = 3
HORIZON = 1000
Build = Callable[[], Transform]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Pair:
    """A transform of ours, and TorchRL's nearest: its name and how it is made."""

    ours: Build
    nearest: str
    stock: Build


def _noisy(draw: Callable[[Tensor], Tensor]) -> Callable[[], Transform]:
    return lambda: UnaryTransform(
        in_keys=["observation"], out_keys=["observation"], fn=lambda x: x + 0.1 * draw(x)
    )


def _clock() -> Transform:
    left = UnaryTransform(
        in_keys=["step_count"],
        out_keys=["left"],
        fn=lambda n: ((HORIZON - n) / HORIZON).clamp_min(0.0),
    )
    return Compose([StepCounter(), left])


def _frames(length: int) -> Transform:
    return CatFrames(length, -1, in_keys=["observation"], out_keys=["frames"], padding="same")


def _chain() -> Transform:
    return Compose(
        [
            ours.ObservationNoise("observation", noise=GaussianNoise(std=0.1)),
            ours.ObservationDelay("observation", delay=DelayCfg(max_lag=MAX_LAG)),
            ours.ObservationHistory("observation", "frames", length=HISTORY),
            ours.ObservationGroups({"actor": ["frames", *NAMES]}),
        ]
    )


def _stock_chain() -> Transform:
    delay = CatFrames(MAX_LAG + 1, -1, in_keys=["observation"], out_keys=["late"], padding="same")
    cat = CatTensors(["frames", *NAMES], "actor", del_keys=False, sort=False)
    return Compose([_noisy(torch.randn_like)(), delay, _frames(HISTORY), cat])


PAIRS = {
    "ObservationNoise, normal": Pair(
        ours=lambda: ours.ObservationNoise("observation", noise=GaussianNoise(std=0.1)),
        nearest="UnaryTransform(randn_like)",
        stock=_noisy(torch.randn_like),
    ),
    "ObservationNoise, uniform": Pair(
        ours=lambda: ours.ObservationNoise("observation", noise=UniformNoise(low=-0.1, high=0.1)),
        nearest="UnaryTransform(rand_like)",
        stock=_noisy(torch.rand_like),
    ),
    "ObservationDelay": Pair(
        ours=lambda: ours.ObservationDelay("observation", "late", delay=DelayCfg(max_lag=MAX_LAG)),
        nearest=f"CatFrames({MAX_LAG + 1})",
        stock=lambda: _frames(MAX_LAG + 1),
    ),
    "ObservationHistory": Pair(
        ours=lambda: ours.ObservationHistory("observation", "frames", length=HISTORY),
        nearest=f"CatFrames({HISTORY})",
        stock=lambda: _frames(HISTORY),
    ),
    "ObservationGroups": Pair(
        ours=lambda: ours.ObservationGroups({"actor": NAMES}),
        nearest="CatTensors",
        stock=lambda: CatTensors(NAMES, "actor", del_keys=False, sort=False),
    ),
    "ObservationClip": Pair(
        ours=lambda: ours.ObservationClip("observation", clip=(-1.0, 1.0)),
        nearest="ClipTransform",
        stock=lambda: ClipTransform(in_keys=["observation"], low=-1.0, high=1.0),
    ),
    "ObservationScale": Pair(
        ours=lambda: ours.ObservationScale("observation", scale=0.05),
        nearest="ObservationNorm",
        stock=lambda: ObservationNorm(loc=0.0, scale=0.05, in_keys=["observation"]),
    ),
    "ObservationNormalization": Pair(
        ours=lambda: ours.ObservationNormalization("observation"),
        nearest="VecNormV2",
        stock=lambda: VecNormV2(in_keys=["observation"]),
    ),
    "ActionClip": Pair(
        ours=lambda: ours.ActionClip(clip=(-0.5, 0.5)),
        nearest="ClipTransform",
        stock=lambda: ClipTransform(in_keys=[], in_keys_inv=["action"], low=-0.5, high=0.5),
    ),
    "ActionScale": Pair(
        ours=lambda: ours.ActionScale(scale=0.25),
        nearest="ActionScaling",
        stock=lambda: ActionScaling(loc=0.0, scale=0.25),
    ),
    "RewardScale": Pair(
        ours=lambda: ours.RewardScale(scale=0.02),
        nearest="RewardScaling",
        stock=lambda: RewardScaling(loc=0.0, scale=0.02),
    ),
    "RewardClip": Pair(
        ours=lambda: ours.RewardClip(clip=(-1.0, 1.0)),
        nearest="RewardClipping",
        stock=lambda: RewardClipping(-1.0, 1.0),
    ),
    "TimeAwareObservation": Pair(
        ours=lambda: ours.TimeAwareObservation(horizon=HORIZON),
        nearest="StepCounter and UnaryTransform",
        stock=_clock,
    ),
    "EpisodeTracker": Pair(
        ours=lambda: ours.EpisodeTracker(),
        nearest="RewardSum and StepCounter",
        stock=lambda: Compose([RewardSum(), StepCounter()]),
    ),
    "chain": Pair(ours=_chain, nearest="the same of the parts above", stock=_stock_chain),
}
