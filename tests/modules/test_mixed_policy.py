"""Who acts while a student learns from a teacher."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.envs.utils import ExplorationType, set_exploration_type

from ksim_rl.modules import ActorCfg, MixedPolicy, make_actor
from ksim_rl.testing import count_syncs

E = 4000


def networks():
    torch.manual_seed(0)
    student = make_actor(ActorCfg(hidden_dims=(), init_std=0.5), obs_dim=3, action_dim=2)
    teacher = TensorDictModule(nn.Linear(1, 2), in_keys=["privileged"], out_keys=["action"])
    nn.init.constant_(teacher.module.bias, 100.0)
    return student, teacher


def env_states():
    return TensorDict({"actor": torch.randn(E, 3), "privileged": torch.randn(E, 1)}, [E])


@torch.no_grad()
def test_the_share_of_the_teacher_is_that_of_its_actions():
    student, teacher = networks()
    share = torch.tensor(0.0)
    policy = MixedPolicy(student, teacher, share=share, teacher_keys=["privileged"], explores=False)
    seen_E = env_states()
    best_E = student[0](seen_E.clone())["loc"]
    shown_E = teacher(seen_E.clone())["action"]
    for expected in (0.25, 0.0, 1.0):
        share.fill_(expected)
        with count_syncs() as syncs:
            acted_E = policy(seen_E.clone())
        assert syncs.total == 0, syncs.report()
        helped_E = acted_E["action"][:, 0] > 50.0
        assert helped_E.float().mean().item() == pytest.approx(expected, abs=0.03)
        # Whole actions, not some of their elements; and what training needs is the student's.
        assert torch.equal(acted_E["action"], torch.where(helped_E[:, None], shown_E, best_E))
        assert torch.equal(acted_E["loc"], best_E)


@torch.no_grad()
def test_the_student_samples_only_where_it_explores():
    student, _ = networks()
    share, seen_E = torch.tensor(0.0), env_states()
    best_E = student[0](seen_E.clone())["loc"]
    for explores, kind, std in (
        (True, ExplorationType.RANDOM, 0.5),
        (True, ExplorationType.DETERMINISTIC, 0.0),
        (False, ExplorationType.RANDOM, 0.0),
    ):
        policy = MixedPolicy(student, share=share, explores=explores)
        with set_exploration_type(kind):
            error_E = policy(seen_E.clone())["action"] - best_E
        assert error_E.std().item() == pytest.approx(std, abs=0.02)
