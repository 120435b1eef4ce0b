"""Transforms, losses, networks and data serve any env of TorchRL, beside torch and TorchRL alone."""

import pytest

from tests.integration.alone import run_each_with

PACKAGES = ("torch", "torchrl", "tensordict", "jaxtyping", "gymnasium")
# Some of them come with torch or TorchRL on some machines.
ABSENT = ("mujoco", "mujoco_warp", "warp", "triton", "hydra", "omegaconf", "rich", "safetensors")

IMPORTS = """
from ksim_rl import data, modules, objectives, transforms
print(*sorted({name.split(".")[1] for name in sys.modules if name.startswith("ksim_rl.")}))
"""

TRANSFORMS = """
import warnings

import torch
from torchrl.envs import GymEnv, TransformedEnv
from torchrl.envs.transforms import Compose, UnsqueezeTransform
from torchrl.envs.utils import check_env_specs
from ksim_rl.transforms import DepthSteps, PictureEffects, RandomShift
from tests.transforms.portable import PORTABLE


def seen(key):
    # Three numbers are a picture of three pixels, one above the other.
    effects = {"shift": RandomShift(pixels=1), "steps": DepthSteps(step=0.5)}
    shown = UnsqueezeTransform(-1, in_keys=[key], out_keys=["picture"])
    return Compose(shown, PictureEffects("picture", effects=effects))


PORTABLE["PictureEffects"] = seen
for name, make in PORTABLE.items():
    env = TransformedEnv(GymEnv("Pendulum-v1"), make("observation"))
    check_env_specs(env)
    rollout_T = env.rollout(20)
    assert all(leaf.isfinite().all() for leaf in rollout_T.values(True, True)), name
    print(name)
"""

LEARNING = """
import torch
from torchrl.envs import GymEnv, TransformedEnv
from ksim_rl.data import DatasetBuffer, DatasetCfg
from ksim_rl.modules import ActorCfg, CriticCfg, make_actor, make_critic
from ksim_rl.objectives import GAE, ClipPPOLoss
from ksim_rl.transforms import ObservationNormalization

env = TransformedEnv(GymEnv("Pendulum-v1"), ObservationNormalization("observation"))
env.set_seed(0)
torch.manual_seed(0)
sizes = dict(in_keys=("observation",), hidden_dims=(16,))
actor = make_actor(
    ActorCfg(distribution="tanh_gaussian", **sizes), obs_dim=3, action_spec=env.full_action_spec
)
critic = make_critic(CriticCfg(**sizes), obs_dim=3)
loss = ClipPPOLoss(actor, critic, entropy_bonus=False)
with torch.no_grad():
    rollout_ET = env.rollout(32, actor)[None]
    GAE(gamma=0.95, lmbda=0.9, value_network=critic)(rollout_ET)
dataset = DatasetBuffer(DatasetCfg(num_env_states_per_minibatch=16, num_minibatches=2))
dataset.extend(rollout_ET)
optimizer = torch.optim.Adam(loss.parameters(), lr=3e-2)
for _ in range(20):
    for _ in range(2):
        out = loss(dataset.sample())
        optimizer.zero_grad()
        (out["loss_objective"] + out["loss_critic"]).backward()
        optimizer.step()
    print(out["loss_critic"].item())
"""


@pytest.fixture(scope="module")
def printed():
    """What the programs print, by name."""
    programs = {"imports": IMPORTS, "transforms": TRANSFORMS, "learning": LEARNING}
    found = run_each_with(PACKAGES, [*programs.values()], without=ABSENT)
    return dict(zip(programs, found, strict=True))


def test_its_rooms_load_nothing_of_the_engine(printed):
    rooms = set(printed["imports"].split())
    assert {"data", "modules", "objectives", "transforms"} <= rooms
    assert not {"physics", "compiled", "scene", "envs", "conf", "cli"} & rooms


def test_each_transform_serves_an_env_of_gymnasium(printed):
    from tests.transforms.portable import exported_transforms

    names = printed["transforms"].split()
    assert exported_transforms() <= set(names)


def test_a_policy_learns_from_a_batch(printed):
    losses = [float(line) for line in printed["learning"].split()]
    assert losses[-1] < 0.5 * losses[0]
