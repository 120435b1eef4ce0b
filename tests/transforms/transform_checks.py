"""Every transform that we export, in the variants that the checks of `test_every_transform` run over."""

from collections.abc import Callable, Sequence

from torchrl.envs.transforms import Transform

from ksim_rl.envs.masked_transformed_env import MaskedTransformedEnv
from ksim_rl.testing import CounterEnv
from ksim_rl.transforms import (
    AXIAL,
    POLAR,
    ActionClip,
    ActionDelay,
    ActionLowPass,
    ActionScale,
    Brightness,
    ConstantNoise,
    CutOut,
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
    PictureEffects,
    PixelNoise,
    RandomCrop,
    RandomShift,
    RewardClip,
    RewardScale,
    SuccessTracker,
    TimeAwareObservation,
)
from ksim_rl.transforms.row_transform import RowTransform
from tests.transforms.chains import VECTOR
from tests.transforms.portable import UNIFORM

NEW = ("other", "deeply", "vector")
SWAP = MirrorMap(source=(1, 0))

# For the counter env: variants of each class, with nested keys, new keys and several keys.
KINDS: dict[str, Callable[[], Transform]] = {
    "uniform": lambda: ObservationNoise("count", noise=UNIFORM),
    "gaussian": lambda: ObservationNoise(VECTOR, NEW, noise=GaussianNoise(std=(1.0, 2.0, 3.0))),
    "biased": lambda: ObservationNoise([VECTOR], noise=GaussianNoise(std=0.1, bias=UNIFORM)),
    "mixed": lambda: ObservationNoise(
        ["count", VECTOR, "row"],
        noise=[UNIFORM, GaussianNoise(std=1.0, operation="multiply"), ConstantNoise(value=2.0, bias=UNIFORM)],
    ),
    "imu": lambda: ObservationNoise(
        [VECTOR, "drawn"],
        [NEW, "drawn"],
        noise=[
            GaussianNoise(std=0.1, walk_std=0.2, dropout=0.3, by_level=True),
            ConstantNoise(value=0.0, resolution=0.25, dropout=0.5, lost="zero"),
        ],
    ),
    "clip": lambda: ObservationClip(
        [VECTOR, "count"], [NEW, "count"], clip={VECTOR: (None, 150.0), "count": (1.0, 2.0)}
    ),
    "scale": lambda: ObservationScale([VECTOR, "count"], scale={VECTOR: (1.0, 0.0, -2.0), "count": 3.0}),
    "delay": lambda: ObservationDelay(VECTOR, NEW, delay=DelayCfg(max_lag=3)),
    "delay_resampled": lambda: ObservationDelay(
        [VECTOR, "count"], delay=DelayCfg(max_lag=3, resample_every=2, hold_probability=0.5)
    ),
    "delay_shared": lambda: ObservationDelay("drawn", delay=DelayCfg(max_lag=3, per_env=False, resample_every=2)),
    "delay_by_level": lambda: ObservationDelay([VECTOR], delay=DelayCfg(max_lag=3, resample_every=2, by_level=True)),
    "history": lambda: ObservationHistory([VECTOR, "drawn"], [NEW, "drawn"], length=4),
    "history_stacked": lambda: ObservationHistory([VECTOR, "drawn"], length=4, flat=False),
    "history_strided": lambda: ObservationHistory([VECTOR, "drawn"], [NEW, "drawn"], length=3, stride=2),
    "groups": lambda: ObservationGroups({"actor": [VECTOR, "count"], ("my", "critic"): ["drawn"]}, drop=[VECTOR]),
    "groups_drop_all": lambda: ObservationGroups({"actor": [VECTOR, "count"]}, drop=True),
    "hold": lambda: ObservationHold([VECTOR, "count"], [NEW, "count"], every=3),
    "hold_dropped": lambda: ObservationHold("rgb", dropped=0.4, fresh_key=("my", "fresh")),
    "pictures": lambda: PictureEffects(
        "rgb", effects={"light": Brightness(), "shift": RandomShift(pixels=1, each="episode"), "noise": PixelNoise()}
    ),
    "pictures_cropped": lambda: PictureEffects(
        "rgb", ("my", "rgb"), effects={"crop": RandomCrop(height=4, width=5), "hole": CutOut(pixels=(1, 3))}
    ),
    "normalization": lambda: ObservationNormalization([VECTOR, "count"], [NEW, "count"]),
    "action_delay": lambda: ActionDelay(delay=DelayCfg(max_lag=2, resample_every=3)),
    "action_delay_renamed": lambda: ActionDelay("action", "wish", delay=DelayCfg(min_lag=1, max_lag=1)),
    "action_clip": lambda: ActionClip("action", "wish", clip=(-0.5, 0.25)),
    "action_scale": lambda: ActionScale(scale=(0.5, -2.0), offset=(0.0, 0.1)),
    "action_scale_bounds": lambda: ActionScale("action", ("my", "wish")),
    "action_low_pass": lambda: ActionLowPass(alpha=0.3),
    "action_low_pass_initial": lambda: ActionLowPass("action", "wish", alpha=0.3, initial=0.0),
    "reward_scale": lambda: RewardScale("reward", ("my", "reward"), scale=-2.0, offset=1.0),
    "reward_scale_by_level": lambda: RewardScale(scale=2.0, first_scale=0.5),
    "reward_clip": lambda: RewardClip(clip=(-0.5, None)),
    "time_aware": lambda: TimeAwareObservation(("my", "clock"), horizon=4),
    "time_aware_steps": lambda: TimeAwareObservation(horizon=6, normalize=False),
    "episode_tracker": lambda: EpisodeTracker("reward", ("episode_of", "return")),
    "success_tracker": lambda: SuccessTracker(["count", "terminated"], ["late", "ended"], threshold=1.5),
    "success_tracker_last": lambda: SuccessTracker("truncated", reduce="last"),
    "mirror": lambda: Mirror([VECTOR], [NEW], maps={VECTOR: POLAR, "action": SWAP}),
    "mirror_renamed": lambda: Mirror(
        VECTOR, None, "action", "wish", maps={VECTOR: AXIAL, "action": SWAP}, probability=1.0
    ),
}  # fmt: skip


def has_episodes(transform: Transform) -> bool:
    """Whether a transform follows episodes, and so has nothing to do with a batch of samples."""
    return isinstance(transform, RowTransform) and type(transform).forward is RowTransform.forward


def seen(lengths: Sequence[int]) -> CounterEnv:
    """Return the counter env of all kinds, which shows pictures, too."""
    return CounterEnv(lengths, picture=(6, 8, 3))


def masked(kind: str) -> MaskedTransformedEnv:
    """Return the counter env with a variant, seeded."""
    env = MaskedTransformedEnv(seen((3, 5, 4)), [KINDS[kind]()])
    env.set_seed(1)
    return env
