"""What TorchRL asks of every transform, in our own words, for each of ours on envs of many shapes.

TorchRL's tests name eleven checks (`TransformBase`): specs alone, in and around serial and parallel envs, samples
without an env, in a `Compose`, in front of a model, in a replay buffer, the inverse, and what reset and step return.
Each case either holds or is refused while the specs are made, by a sentence; which are refused is written here.
`python -m tests.transforms.protocol` runs all and prints the counts.
"""

import sys
import warnings
from collections import Counter
from collections.abc import Callable
from functools import partial

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs import ParallelEnv, SerialEnv, TransformedEnv
from torchrl.envs.transforms import Compose, Transform
from torchrl.envs.utils import check_env_specs

from ksim_rl.transforms import (
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
    PictureEffects,
    RandomShift,
    RewardClip,
    RewardScale,
    SuccessTracker,
    TimeAwareObservation,
    UniformNoise,
)
from tests.transforms.leaf_env import LeafEnv
from tests.transforms.transform_checks import has_episodes

LATE = DelayCfg(min_lag=1, max_lag=1)
NOISE = GaussianNoise(std=0.1, bias=UniformNoise(low=0.0, high=1.0))
TURNED, SWAPPED = MirrorMap(source=(2, 1, 0)), MirrorMap(source=(1, 0))

SHAPES: dict[str, Callable[[], LeafEnv]] = {
    "no batch": partial(LeafEnv, ()),
    "rows": partial(LeafEnv, (3,)),
    "grid": partial(LeafEnv, (2, 3)),
    "matrix, no batch": partial(LeafEnv, (), (4, 3)),
    "images in a grid": partial(LeafEnv, (2, 3), (2, 4, 3)),
    "scalars": partial(LeafEnv, (3,), (), action_leaf=()),
    "scalars, no batch": partial(LeafEnv, (), ()),
    "nested": partial(LeafEnv, (3,), (4, 3), nested=True),
    "agents": partial(LeafEnv, (3,), (3,), agents=True),
    "agents, no batch": partial(LeafEnv, (), (4, 3), agents=True),
    "double": partial(LeafEnv, (3,), (3,), torch.float64, action_dtype=torch.float64),
    "whole": partial(LeafEnv, (3,), (4, 3), torch.int64, action_dtype=torch.int64),
    "flags": partial(LeafEnv, (), (3,), torch.bool),
}
SHORT = ("no batch", "rows", "grid", "matrix, no batch", "scalars", "agents", "whole")

KINDS: dict[str, Callable[[LeafEnv], Transform]] = {
    "ObservationNoise": lambda env: ObservationNoise(env.key, noise=NOISE),
    "ObservationClip": lambda env: ObservationClip(env.key, clip=(1.0, 150.0)),
    "ObservationScale": lambda env: ObservationScale(env.key, scale=2.0),
    "ObservationDelay": lambda env: ObservationDelay(env.key, delay=LATE),
    "ObservationDelay of two": lambda env: ObservationDelay([env.key, "again"], delay=LATE),
    "ObservationHold": lambda env: ObservationHold(env.key, every=2, fresh_key="fresh"),
    "PictureEffects": lambda env: PictureEffects(env.key, effects={"shift": RandomShift(pixels=1)}),
    "ObservationHistory": lambda env: ObservationHistory(env.key, length=3),
    "ObservationHistory of two": lambda env: ObservationHistory([env.key, "again"], length=3),
    "ObservationHistory stacked": lambda env: ObservationHistory(env.key, length=3, flat=False),
    "ObservationGroups": lambda env: ObservationGroups({"actor": [env.key, "again"]}),
    "ObservationNormalization": lambda env: ObservationNormalization(env.key),
    "ActionDelay": lambda env: ActionDelay(env.action_name, delay=LATE, initial=1.0),
    "ActionClip": lambda env: ActionClip(env.action_name, clip=(-0.5, 0.25)),
    "ActionScale": lambda env: ActionScale(env.action_name, scale=0.5, offset=0.25),
    "ActionScale to bounds": lambda env: ActionScale(env.action_name),
    "ActionLowPass": lambda env: ActionLowPass(env.action_name, alpha=0.5, initial=0.0),
    "RewardScale": lambda env: RewardScale(env.reward_name, scale=0.5),
    "RewardClip": lambda env: RewardClip(env.reward_name, clip=(-1.0, 0.5)),
    "TimeAwareObservation": lambda env: TimeAwareObservation(horizon=4, normalize=False),
    "EpisodeTracker": lambda env: EpisodeTracker(env.reward_name),
    "SuccessTracker": lambda env: SuccessTracker(env.key, threshold=0.5),
    "Mirror": lambda env: Mirror(
        env.key,
        None,
        env.action_name,
        maps={env.key: TURNED, env.action_name: SWAPPED},
        probability=1.0,
    ),
}


def is_refused(kind: str, shape: str) -> bool:
    """Whether a transform has no meaning for an env: functions of reals for others, columns where there are none."""
    reals = ("ObservationNoise", "ObservationClip", "ObservationScale", "ObservationNormalization")
    if kind in reals:
        return shape in ("whole", "flags")
    if kind.startswith(("ActionClip", "ActionScale", "ActionLowPass")):
        return shape == "whole"
    if kind == "PictureEffects":
        return shape not in ("matrix, no batch", "nested", "agents, no batch")
    return kind == "Mirror" and shape.startswith("scalars")


def build(kind: str, env: LeafEnv) -> Transform:
    """Return a transform for an env; the env writes its observation twice for transforms that read two."""
    return KINDS[kind](env)


def transformed(kind: str, shape: str) -> TransformedEnv:
    env = SHAPES[shape]()
    return TransformedEnv(env, build(kind, env))


def _steps(env: TransformedEnv, count: int) -> list[Tensor]:
    generator = torch.Generator().manual_seed(7)
    spec = env.full_action_spec[env.action_keys[0]]
    draws = [torch.rand(spec.shape, generator=generator) * 2 - 1 for _ in range(count)]
    return [(3 * draw).to(spec.dtype) for draw in draws] if not spec.dtype.is_floating_point else [
        draw.to(spec.dtype) for draw in draws
    ]  # fmt: skip


def specs_alone(kind: str, shape: str) -> None:
    check_env_specs(transformed(kind, shape))


def specs_in_a_serial_env(kind: str, shape: str) -> None:
    env = SerialEnv(2, partial(transformed, kind, shape))
    check_env_specs(env)
    env.close()


def specs_around_a_serial_env(kind: str, shape: str) -> None:
    env = TransformedEnv(SerialEnv(2, SHAPES[shape]), build(kind, SHAPES[shape]()))
    check_env_specs(env)
    env.close()


def specs_in_a_parallel_env(kind: str, shape: str) -> None:
    env = ParallelEnv(2, partial(transformed, kind, shape), mp_start_method="fork")
    try:
        check_env_specs(env)
    finally:
        env.close()


def specs_around_a_parallel_env(kind: str, shape: str) -> None:
    inside = ParallelEnv(2, SHAPES[shape], mp_start_method="fork")
    env = TransformedEnv(inside, build(kind, SHAPES[shape]()))
    try:
        check_env_specs(env)
    finally:
        env.close()


def reset_and_steps(kind: str, shape: str) -> None:
    """What reset and steps return and what action arrives, against closed forms, over ends of episodes."""
    env = transformed(kind, shape)
    inner: LeafEnv = env.base_env
    name = kind.split(" ")[0]
    root = env.reset()
    batch = inner.batch_size
    before = torch.ones_like(inner.full_action_spec[inner.action_name].zero())
    filtered = torch.zeros_like(before)
    fresh = torch.ones(inner.num_rows, dtype=torch.bool)
    for action in _steps(env, 9):
        count_E = torch.where(fresh, 0, inner.count_E)
        _check_seen(name, kind, env, root, count_E)
        stepped, root = env.step_and_maybe_reset(
            root.clone().set(inner.action_name, action.clone())
        )
        assert torch.equal(stepped.get(inner.action_name), action)
        rows = fresh.reshape(*batch, *[1] * (action.ndim - len(batch)))
        expected = action
        if name == "ActionDelay":
            expected = torch.where(rows, torch.ones_like(action), before)
        elif name == "ActionClip":
            expected = action.clamp(-0.5, 0.25)
        elif kind == "ActionScale":
            expected = 0.5 * action + 0.25
        elif name == "ActionLowPass":
            filtered = torch.where(rows, 0.0, filtered)
            filtered = expected = (filtered + 0.5 * (action - filtered)).to(action.dtype)
        elif name == "Mirror":
            expected = action.flip(-1)
        torch.testing.assert_close(inner.received, expected)
        before, fresh = action, stepped["next", "done"].reshape(-1)
        reached_E = torch.where(fresh, inner.length_E, inner.count_E)
        _check_seen(name, kind, env, stepped["next"], reached_E)
        for key, spec in env.full_observation_spec.items(True, True):
            value = stepped["next"].get(key)
            assert value.shape == spec.shape and value.dtype == spec.dtype and spec.is_in(value), (
                key
            )


def _check_seen(name: str, kind: str, env: TransformedEnv, td: TensorDict, count_E: Tensor) -> None:
    inner: LeafEnv = env.base_env
    batch, agents = inner.batch_size, list(inner.inner)

    def at(lag: int) -> Tensor:
        value_E = inner.value((count_E - lag).clamp(min=0))
        return value_E.reshape((*batch, *value_E.shape[1:]))

    found = {
        "ObservationClip": lambda: at(0).clamp(1.0, 150.0),
        "ObservationScale": lambda: at(0) * 2.0,
        "ObservationDelay": lambda: at(1),
        "Mirror": lambda: at(0).flip(-1),
    }
    if name in found:
        torch.testing.assert_close(td.get(inner.key), found[name]())
    if kind.endswith("of two"):
        theirs = td.get("again").reshape(td.get(inner.key).shape)
        assert torch.equal(td.get(inner.key), theirs) or agents
    if name == "ObservationHistory":
        width = len(batch) + len(agents)
        frames = torch.stack([at(lag) for lag in (2, 1, 0)], width)
        assert torch.equal(
            td.get(inner.key), frames if kind.endswith("stacked") else frames.flatten(width)
        )
    if name == "ObservationGroups":
        one = at(0).reshape(*batch, -1)
        assert torch.equal(td.get("actor"), torch.cat((one, one), -1))
    if name == "TimeAwareObservation":
        assert torch.equal(td.get("remaining_time"), (4.0 - count_E).reshape(*batch, 1))
    if name == "EpisodeTracker":
        assert torch.equal(td.get("episode_length"), count_E.reshape(*batch, 1))


def _samples(env: LeafEnv) -> TensorDict:
    """Return eight samples with the leaves of an env, without its batch size."""
    torch.manual_seed(0)
    td = env.rand_action(env.reset())
    td = env.step(td)
    td.set(env.reward_name, td.get(("next", *_path(env.reward_name))))
    one = td.select(env.key, "again", env.action_name, env.reward_name).reshape(-1)[0]
    return torch.stack([one.clone() for _ in range(8)])


def _path(key: str | tuple[str, ...]) -> tuple[str, ...]:
    return key if isinstance(key, tuple) else (key,)


def _ready(kind: str, env: LeafEnv) -> Transform:
    transform = build(kind, env)
    if isinstance(transform, ObservationNormalization):
        size = _samples(env)[0].get(env.key).numel()
        transform._size_moments([size], None)
        transform.moments[0].update(torch.randn(50, size))
    return transform


def _on_samples(kind: str, shape: str, run: Callable[[Transform, TensorDict], TensorDict]) -> None:
    env = SHAPES[shape]()
    transform = _ready(kind, env)
    if has_episodes(transform):
        try:
            run(transform, _samples(env))
        except RuntimeError as error:
            assert "has state per env: use it in an env, not on a batch of samples" in str(error)
            return
        raise AssertionError("samples were not refused")
    found = run(transform, _samples(env))
    for key, value in _samples(env).items(True, True):
        if key not in transform.out_keys:
            assert torch.equal(found.get(key), value), key


def samples_alone(kind: str, shape: str) -> None:
    _on_samples(kind, shape, lambda transform, td: transform(td))


def samples_in_a_compose(kind: str, shape: str) -> None:
    _on_samples(kind, shape, lambda transform, td: Compose(transform)(td))


def samples_before_a_model(kind: str, shape: str) -> None:
    def run(transform: Transform, td: TensorDict) -> TensorDict:
        reads = transform.out_keys[0] if transform.out_keys else SHAPES[shape]().key
        module = TensorDictModule(
            lambda x: x.float().reshape(8, -1).sum(-1), in_keys=[reads], out_keys=["y"]
        )
        found = torch.nn.Sequential(transform, module)(td)
        assert found["y"].shape == (8,)
        return found

    _on_samples(kind, shape, run)


def samples_from_a_buffer(kind: str, shape: str) -> None:
    def run(transform: Transform, td: TensorDict) -> TensorDict:
        buffer = ReplayBuffer(storage=LazyTensorStorage(8), batch_size=8, transform=transform)
        buffer.extend(td)
        return buffer.sample()

    _on_samples(kind, shape, run)


def inverse_of_samples(kind: str, shape: str) -> None:
    env = SHAPES[shape]()
    transform, td = _ready(kind, env), _samples(env)
    try:
        found = transform.inv(td)
    except RuntimeError as error:
        assert transform.in_keys_inv and "env" in str(error)
        return
    for key, value in _samples(env).items(True, True):
        if key not in transform.in_keys_inv:
            assert torch.equal(found.get(key), value), key


CHECKS: dict[str, Callable[[str, str], None]] = {
    check.__name__: check
    for check in (
        specs_alone, specs_in_a_serial_env, specs_around_a_serial_env, specs_in_a_parallel_env,
        specs_around_a_parallel_env, reset_and_steps, samples_alone, samples_in_a_compose, samples_before_a_model,
        samples_from_a_buffer, inverse_of_samples,
    )
}  # fmt: skip
PARALLEL = ("specs_in_a_parallel_env", "specs_around_a_parallel_env")
SAMPLES = tuple(name for name in CHECKS if "sample" in name)


def outcome(check: str, kind: str, shape: str) -> str:
    """Run a case, and return "holds" or "refused"; raise what fails.

    What specs refuse is "not asked" of samples, which have none.
    """
    if is_refused(kind, shape) and check not in SAMPLES:
        env = transformed(kind, shape)
        try:
            env.output_spec, env.input_spec  # noqa: B018
        except ValueError as error:
            assert "\n" not in str(error) and len(str(error)) < 160
            return "refused"
        raise AssertionError("not refused while the specs are made")
    if is_refused(kind, shape):
        return "not asked"
    CHECKS[check](kind, shape)
    return "holds"


def main() -> None:
    """Run all cases, parallel envs on two shapes, and print how many hold, are refused, and fail."""
    warnings.filterwarnings("ignore")
    counts: dict[str, Counter[str]] = {}
    for check in CHECKS:
        shapes = ("rows", "agents") if check in PARALLEL else tuple(SHAPES)
        counts[check] = Counter()
        for kind in KINDS:
            for shape in shapes:
                try:
                    counts[check][outcome(check, kind, shape)] += 1
                except Exception as error:
                    counts[check]["fails"] += 1
                    print(f"{check}, {kind}, {shape}: {type(error).__name__}: {str(error)[:200]}")
        print(
            f"{check:32} "
            + ", ".join(f"{number} {word}" for word, number in sorted(counts[check].items()))
        )
        sys.stdout.flush()
    total = sum(counts.values(), Counter())
    print(f"{'all':32} " + ", ".join(f"{number} {word}" for word, number in sorted(total.items())))


if __name__ == "__main__":
    main()
