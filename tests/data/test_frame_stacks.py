"""A replay that stores each frame once, against one that stores whole stacks: equal bits."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import TransformedEnv

from ksim_rl.data import MASK_KEY, ReplayCfg, ReplayRing, ReplayStorage
from ksim_rl.testing import count_syncs
from ksim_rl.transforms import ObservationHistory
from tests.transforms.leaf_env import LeafEnv

NUM_ENVS, CAPACITY = 3, 13
STACKS = {"rgb": (4, 2, 0), "depth": (1, 0)}
OBSERVATIONS = ["rgb", "depth", "joints"]


class _Camera:
    """Makes rollouts of random pictures, stacked by plain lists, whose episodes end at random."""

    def __init__(self, *, end=0.3, colours=256):
        self.generator = torch.Generator().manual_seed(0)
        self.end = end
        self.colours = colours
        self.frames = [[] for _ in range(NUM_ENVS)]
        self.reset(range(NUM_ENVS))

    def reset(self, rows):
        for row in rows:
            self.frames[row] = [self._picture()] * 5

    def _picture(self):
        return torch.randint(self.colours, (2, 2, 3), generator=self.generator).to(torch.uint8)

    def _observed(self):
        rgb = torch.stack([torch.stack(own[-5::2]) for own in self.frames])
        return {
            "rgb": rgb,
            "depth": torch.stack([torch.stack(own[-2:])[..., 0] for own in self.frames]).float()
            / 8,
            "joints": rgb[:, -1, 0, 0, :1].float(),
        }

    def rollout(self, length):
        steps = []
        for _ in range(length):
            now = self._observed()
            for own in self.frames:
                own.append(self._picture())
            done = torch.rand(NUM_ENVS, 1, generator=self.generator) < self.end
            following = self._observed() | {
                "reward": torch.rand(NUM_ENVS, 1, generator=self.generator),
                "done": done,
                "terminated": done & (torch.rand(NUM_ENVS, 1, generator=self.generator) < 0.5),
            }
            steps.append(TensorDict({**now, "next": following}, batch_size=[NUM_ENVS]))
            self.reset([row for row in range(NUM_ENVS) if done[row]])
        return torch.stack(steps, 1)


def _rings(**options):
    shared = {"num_envs": NUM_ENVS, "capacity": CAPACITY, "observations": OBSERVATIONS, **options}
    return ReplayStorage(stacks=STACKS, **shared), ReplayStorage(**shared)


def _by_age(storage):
    """All env states of all envs, newest first, with what is masked set to zero."""
    age = torch.arange(1, CAPACITY + 1).repeat_interleave(NUM_ENVS)
    env = torch.arange(NUM_ENVS).repeat(CAPACITY)
    sample = storage.get(storage.index(env, age))
    kept = sample[MASK_KEY]
    return sample.apply(lambda leaf: leaf * kept.reshape(-1, *[1] * (leaf.ndim - 1)))


def _assert_equal(first, second):
    first, second = _by_age(first), _by_age(second)
    assert sorted(map(str, first.keys(True, True))) == sorted(map(str, second.keys(True, True)))
    assert bool(second[MASK_KEY].any())
    for key, leaf in second.items(True, True):
        assert leaf.dtype == first[key].dtype and torch.equal(leaf, first[key]), key


# Of two colours, many frames are equal by chance.
@pytest.mark.parametrize(
    ("n_step", "colours", "lengths"),
    [(1, 256, (1,) * 24), (3, 256, (4, 2, 5) * 3), (3, 2, (4, 2, 5) * 3)],
)
def test_stacks_have_the_bits_of_stored_ones(n_step, lengths, colours):
    camera = _Camera(colours=colours)
    frames, stacks = _rings(n_step=n_step)
    for number, length in enumerate(lengths):
        # Now and then someone resets an env between rollouts.
        if number % 5 == 4:
            camera.reset([1])
        rollout = camera.rollout(length)
        frames.write(rollout), stacks.write(rollout)
        if number % 4 == 3:
            _assert_equal(frames, stacks)
        # Places that are kept for their frames alone hold no env state any more, which priorities would draw.
        assert int(frames.available.sum()) == int(stacks.available.sum())
    assert torch.equal(frames.filled_E, stacks.filled_E)


def test_after_a_gap_stacks_are_left_out_until_their_frames_were_written():
    """Rollouts begin in the middle of an episode, as where a run goes on without its replay, or one is not kept."""
    camera = _Camera(end=0.0)
    camera.rollout(2)
    frames, stacks = _rings()
    for _ in range(3):
        rollout = camera.rollout(6)
        frames.write(rollout), stacks.write(rollout)
        camera.rollout(1)
    first, second = _by_age(frames), _by_age(stacks)
    kept_AE = first[MASK_KEY].reshape(CAPACITY, NUM_ENVS)
    # The oldest frame is from four steps ago; the last env state before a gap has lost what followed it.
    for age, is_kept_E in enumerate(kept_AE, start=1):
        assert bool((is_kept_E == (age in (1, 2, 8))).all()), age
    kept = first[MASK_KEY].squeeze(-1)
    assert bool((first[kept] == second[kept]).all())
    # The next rollout goes on where the last one ended, so all is known again.
    frames, stacks = _rings()
    for _ in range(3):
        rollout = camera.rollout(6)
        frames.write(rollout), stacks.write(rollout)
    _assert_equal(frames, stacks)


def test_a_stack_that_is_not_finite_is_refused_with_each_env_state_that_shows_it():
    camera = _Camera(end=0.0)
    frames, stacks = _rings()
    for number in range(3):
        rollout = camera.rollout(4)
        if number == 1:
            # One frame, where it is the newest and where it is the older one.
            for leaf, steps in ((rollout, (2, 3)), (rollout["next"], (1, 2))):
                leaf["depth"][0, steps[0], 1] = float("nan")
                leaf["depth"][0, steps[1], 0] = float("nan")
        frames.write(rollout), stacks.write(rollout)
    assert int(frames.non_finite_count) == int(stacks.non_finite_count) == 3
    _assert_equal(frames, stacks)


def test_the_same_are_drawn_without_a_sync_and_a_state_continues_exactly():
    cfg = ReplayCfg(
        num_env_states_per_minibatch=64, num_minibatches=1, num_steps=2, capacity=CAPACITY
    )
    shared = {"num_envs": NUM_ENVS, "observations": OBSERVATIONS}
    frames, stacks = ReplayRing(cfg, stacks=STACKS, **shared), ReplayRing(cfg, **shared)
    resumed = ReplayRing(cfg, stacks=STACKS, **shared)
    camera = _Camera()
    for number in range(8):
        rollout = camera.rollout(2)
        drawn = []
        for ring in (stacks, frames, resumed):
            if ring is resumed and number < 6:
                continue
            torch.manual_seed(number)
            with count_syncs() as syncs:
                ring.extend(rollout)
                drawn.append(next(ring.minibatches(1)))
            assert syncs.total == 0, syncs.report()
        for other in drawn[1:]:
            assert bool((drawn[0] == other).all())
        if number == 5:
            resumed.load_state_dict(frames.state_dict())
    with pytest.raises(ValueError, match="stacked frames must be the checkpoint's"):
        stacks.load_state_dict(frames.state_dict())


def test_each_frame_costs_its_bytes_once():
    frames, stacks = _rings()
    rollout = _Camera().rollout(2)
    frames.write(rollout), stacks.write(rollout)

    def bytes_per_place(storage):
        return sum(leaf.nbytes for leaf in storage.content.values(True, True)) // storage.max_size

    # Colours, distances, joints, and reward with two flags.
    assert bytes_per_place(stacks) == 3 * 12 + 2 * 16 + 4 + 6
    assert bytes_per_place(frames) == 12 + 16 + 4 + 6


def test_what_the_transform_of_the_library_stacks():
    """Rows end after 3 and 4 steps; episodes begin within rollouts and between them."""
    env = TransformedEnv(
        LeafEnv([2], (2, 2, 3), torch.uint8),
        ObservationHistory(["x"], length=3, stride=2, flat=False),
    )
    shared = {"num_envs": 2, "capacity": 16, "observations": ["x"]}
    frames, stacks = ReplayStorage(stacks={"x": (4, 2, 0)}, **shared), ReplayStorage(**shared)
    root = env.reset()
    for _ in range(4):
        rollout = env.rollout(5, auto_reset=False, tensordict=root, break_when_any_done=False)
        root = env.step_mdp(rollout[:, -1])
        frames.write(rollout), stacks.write(rollout)
        if bool(rollout["next", "done"][:, -1].any()):
            root = env.reset(root.set("_reset", rollout["next", "done"][:, -1]))
    index = torch.arange(1, 17).repeat_interleave(2), torch.arange(2).repeat(16)
    first, second = (ring.get(ring.index(index[1], index[0])) for ring in (frames, stacks))
    assert torch.equal(first[MASK_KEY], second[MASK_KEY])
    kept = first[MASK_KEY].squeeze(-1)
    assert int(kept.sum()) > 16 and bool((first[kept] == second[kept]).all())
