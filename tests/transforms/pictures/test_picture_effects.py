"""Pictures of envs after effects: keyed draws, episodes, evaluations, layouts, configs, and what is refused."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Unbounded
from torchrl.envs import TransformedEnv
from torchrl.envs.transforms import Compose, ToTensorImage

from ksim_rl.device import random
from ksim_rl.envs.masked_transformed_env import MaskedTransformedEnv
from ksim_rl.testing import CounterEnv
from ksim_rl.transforms import (
    Brightness,
    DepthHoles,
    DepthRange,
    DepthSteps,
    ObservationHistory,
    PictureEffects,
    PixelNoise,
    RandomCrop,
    RandomShift,
    TransformCfg,
)
from ksim_rl.transforms.pictures.effects import PictureEffect
from tests.transforms.chains import fixed_rollout

SIZE = (6, 8, 3)
LENGTHS = (3, 5, 4)


def env_with(*transforms, stock=False, seed=1):
    wrapper = TransformedEnv if stock else MaskedTransformedEnv
    env = wrapper(CounterEnv(LENGTHS, picture=SIZE), Compose(*transforms))
    env.set_seed(seed)
    return env


class Shade(PictureEffect):
    """Each pixel is the draw of its env, in 1 / 200: what was drawn can be read."""

    def __call__(self, pictures_ENHWC, draws_EK):
        shade_E = (200 * draws_EK[:, 0]).to(torch.uint8)
        return torch.zeros_like(pictures_ENHWC) + shade_E[:, None, None, None, None]


def test_draws_are_keyed_by_name_step_and_episode():
    effects = {"now": Shade()}, {"long": Shade(each="episode")}
    env = env_with(
        PictureEffects("rgb", "now", effects=effects[0], stream="eye"),
        PictureEffects("rgb", "long", effects=effects[1], stream="eye"),
    )
    rollout_ET = fixed_rollout(env, 10)
    seed = env.transform[0].seed_value

    def drawn(name, count):
        keys = random.row_keys(seed, random.stream_id(f"eye/{name}"), count, len(LENGTHS))
        return (200 * random.uniform(keys, 1)[:, 0]).to(torch.uint8)

    now_ET = rollout_ET["next", "now"][..., 0, 0, 0]
    for t in range(10):
        assert torch.equal(now_ET[:, t], drawn("now/step", torch.tensor(t + 1)))
    # Every episode has its own, the next one another.
    episode_ET = rollout_ET["next", "episode"][..., 0].long()
    for t in range(10):
        expected = drawn("long/episode", episode_ET[:, t])
        assert torch.equal(rollout_ET["next", "long"][:, t, 0, 0, 0], expected)
        assert torch.equal(rollout_ET["long"][:, t, 0, 0, 0], expected)
    # The first picture of an episode has draws of its own reset.
    starts = rollout_ET["count"][..., 0] == 0
    expected = torch.stack([drawn("now/reset", episode_ET[:, t]) for t in range(10)], 1)
    assert torch.equal(rollout_ET["now"][..., 0, 0, 0][starts], expected[starts])


class Tile(Shade):
    """A user's own, of another size: pixels are 100, and ten times a standard normal draw."""

    is_normal = True

    def new_shape(self, shape):
        return (shape[0], 2, 2, shape[3])

    def __call__(self, pictures_ENHWC, draws_EK):
        tile_E1111 = (100 + 10 * draws_EK)[:, :, None, None, None]
        return tile_E1111.expand(-1, *self.new_shape(pictures_ENHWC.shape[1:])).to(torch.uint8)


class Faulty(Shade):
    """A user's own, whose results are floats."""

    def __call__(self, pictures_ENHWC, draws_EK):
        return pictures_ENHWC * 0.5


def test_effects_of_a_user_keep_what_they_promise():
    env = env_with(PictureEffects("rgb", "tile", effects={"tile": Tile()}))
    env.eval()
    # The mean of what is drawn, as crops are of the middle.
    assert bool((env.reset()["tile"] == 100).all())
    env = env_with(PictureEffects("rgb", effects={"half": Faulty()}))
    with pytest.raises(ValueError, match=r"effects\.half: Faulty gives torch.float32.*torch.uint8"):
        env.reset()


def test_stacked_pictures_are_changed_alike_and_stay_bytes():
    env = env_with(
        ObservationHistory("rgb", "frames", length=3, flat=False),
        PictureEffects("frames", "moved", effects={"shift": RandomShift(pixels=2)}),
        PictureEffects("frames", "crop", effects={"crop": RandomCrop(height=4, width=3)}),
    )
    rollout_ET = fixed_rollout(env, 6)
    assert rollout_ET["moved"].dtype == torch.uint8
    assert rollout_ET["crop"].shape == (3, 6, 3, 4, 3, 3)
    clean, moved = rollout_ET["frames"].long(), rollout_ET["moved"].long()
    # Frames differ by 40 in each byte, modulo 256, and do so still.
    assert torch.equal(
        (moved[:, :, 1:] - moved[:, :, :-1]) % 256, (clean[:, :, 1:] - clean[:, :, :-1]) % 256
    )
    assert not torch.equal(moved, clean)


def test_an_evaluation_sees_clean_pictures_and_crops_of_the_middle():
    env = env_with(
        PictureEffects(
            "rgb", "seen", effects={"noise": PixelNoise(std=0.2), "shift": RandomShift()}
        ),
        PictureEffects("rgb", "crop", effects={"crop": RandomCrop(height=4, width=4)}),
    )
    assert not torch.equal(env.reset()["seen"], env.reset()["rgb"])
    env.eval()
    root = env.reset()
    assert torch.equal(root["seen"], root["rgb"])
    assert torch.equal(root["crop"], root["rgb"][:, 1:5, 2:6])
    env.train()
    assert not torch.equal(env.reset()["seen"], env.reset()["rgb"])
    env.transform[0].enable_(False)
    root = env.reset()
    assert torch.equal(root["seen"], root["rgb"])


def test_pictures_of_torchrl_have_their_channels_first():
    bright = {"light": Brightness(factor=(0.5, 0.5))}
    env = env_with(
        PictureEffects("rgb", "bytes", effects=bright),
        ToTensorImage(in_keys=["rgb"], out_keys=["floats"]),
        PictureEffects("floats", effects=bright, layout="CHW"),
        stock=True,
    )
    root = env.reset()
    torch.testing.assert_close(root["floats"], 0.5 * root["rgb"].movedim(-1, -3) / 255)
    assert (root["bytes"].float() - 0.5 * root["rgb"]).abs().max() < 0.51
    assert env.observation_spec["floats"].is_in(root["floats"])


def test_bounds_of_distances_are_those_that_can_come():
    faults = {
        "range": DepthRange(reach=(0.1, 0.84)),
        "steps": DepthSteps(step=0.1),
        "holes": DepthHoles(missing=-1.0),
    }
    env = env_with(
        ToTensorImage(in_keys=["rgb"], out_keys=["distance"]),
        PictureEffects("distance", effects=faults, layout="CHW"),
    )
    spec = env.observation_spec["distance"]
    low, high = spec.space.low, spec.space.high
    assert bool((low == -1.0).all()) and bool((high - 0.8).abs().max() < 1e-6)
    rollout_ET = fixed_rollout(env, 9)
    values = rollout_ET["distance"]
    assert spec.is_in(values[:, 4])
    assert float(values.min()) == -1.0 and values.max() == high.max()


def test_samples_get_draws_of_their_own():
    batch = TensorDict({"rgb": torch.zeros(16, *SIZE, dtype=torch.uint8)}, [16])
    shade = PictureEffects("rgb", effects={"now": Shade()}, seed=3)
    first, second = (shade(batch.clone())["rgb"][:, 0, 0, 0] for _ in range(2))
    assert len(set(first.tolist())) > 8 and not torch.equal(first, second)


@pytest.mark.parametrize(
    ("dtype", "effect", "message"),
    [
        (torch.uint8, DepthSteps(), r"effects\.it: DepthSteps.*bytes are amounts of light"),
        (torch.int64, PixelNoise(), "torch.int64: expected floating-point values"),
        (torch.float32, RandomCrop(height=7, width=2), r"effects\.it: height=7"),
    ],
)
def test_samples_that_an_effect_is_not_for_are_refused(dtype, effect, message):
    batch = TensorDict({"rgb": torch.zeros(4, *SIZE, dtype=dtype)}, [4])
    with pytest.raises(ValueError, match=message):
        PictureEffects("rgb", effects={"it": effect})(batch)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"layout": "WHC"}, "layout='WHC': did you mean 'HWC'"),
        ({"effects": {"it": RandomShift}}, r"effects\.it=.*expected a PictureEffect"),
        ({"effects": {}}, "expected at least one"),
    ],
)
def test_settings_that_are_none_are_refused(fields, message):
    with pytest.raises(ValueError, match=message):
        PictureEffects("rgb", **{"effects": {"it": RandomShift()}, **fields})


def test_a_config_names_effects_by_their_classes():
    cfg = TransformCfg(
        PictureEffects,
        in_keys=["rgb"],
        effects={"shift": RandomShift(pixels=2), "light": Brightness()},
    )
    tree = cfg.to_tree()
    assert tree["effects"]["shift"] == {
        "_target_": "ksim_rl.transforms.RandomShift", "pixels": 2, "each": "step"
    }  # fmt: skip
    assert TransformCfg.from_tree(tree, "task.transforms.look") == cfg
    tree["effects"]["shift"]["pixel"] = 3
    with pytest.raises(ValueError, match=r"effects\.shift\.pixel'?.*pixels"):
        TransformCfg.from_tree(tree, "task.transforms.look")


def test_it_compiles_without_a_graph_break():
    effects = {"shift": RandomShift(), "light": Brightness(each="episode"), "noise": PixelNoise()}
    env = env_with(PictureEffects("rgb", effects=effects))
    reached = env.base_env.rand_step(env.reset())["next"]
    transform = env.transform[0]
    count = transform.step_count.clone()
    expected = transform._step(reached, reached.clone(False))["rgb"]
    transform.step_count.copy_(count)
    compiled = torch.compile(transform._step, fullgraph=True, backend="aot_eager")
    assert torch.equal(compiled(reached, reached.clone(False))["rgb"], expected)


@pytest.mark.parametrize(
    ("spec", "effect", "message"),
    [
        (Unbounded((3, 4, 5, 3), dtype=torch.uint8), DepthHoles(), "bytes are amounts of light"),
        (Unbounded((3, 4, 5)), PixelNoise(), "within \\[0, 1\\]; these may be from -inf to inf"),
        (Bounded(0.0, 2.0, (3, 4, 5)), Brightness(), "these may be from 0.0 to 2.0"),
        (Unbounded((3, 9)), RandomShift(), r"these are \[9\]"),
        # Frames of a depth camera would be taken for rows.
        (Unbounded((3, 3, 6, 8)), RandomShift(), r"stacked \[N, H, W\]"),
        (Unbounded((3, 4, 5)), RandomCrop(height=5, width=5), r"effects\.it: height=5"),
    ],
)  # fmt: skip
def test_effects_that_have_no_meaning_are_refused(spec, effect, message):
    env = CounterEnv(LENGTHS)
    observed = env.observation_spec.clone()
    observed["eye"] = spec
    with pytest.raises(ValueError, match=rf"'eye': .*{message}"):
        PictureEffects("eye", effects={"it": effect}).transform_observation_spec(observed)
