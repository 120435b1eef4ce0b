"""A TorchRL env with none of the optional parts trains, and the run says what it goes without."""

import torch
from tensordict import TensorDict
from torchrl.data import Binary, Composite, Unbounded
from torchrl.envs import EnvBase

from ksim_rl.envs.contract import PARTS
from ksim_rl.trainers import RunProgress
from tests.trainers.target_env import make_trainer

E = 16


class ForeignEnv(EnvBase):
    """An env as TorchRL's manual has them, of batch size [16]: an episode is 8 steps towards a target that it shows."""

    def __init__(self):
        super().__init__(batch_size=[E])
        one, flag = Unbounded((E, 1)), Binary(1, (E, 1), dtype=torch.bool)
        self.observation_spec = Composite(actor=one.clone(), critic=one.clone(), shape=[E])
        self.action_spec, self.reward_spec = one.clone(), one.clone()
        self.full_done_spec = Composite(
            done=flag, terminated=flag.clone(), truncated=flag.clone(), shape=[E]
        )
        self.step_E1 = torch.zeros(E, 1)
        self.target_E1 = torch.zeros(E, 1)

    def _shown(self, **more):
        done_E1 = self.step_E1 >= 8
        flags = {
            "done": done_E1,
            "truncated": done_E1.clone(),
            "terminated": torch.zeros_like(done_E1),
        }
        observed = {"actor": self.target_E1.clone(), "critic": self.target_E1.clone()}
        return TensorDict({**observed, **flags, **more}, batch_size=[E])

    def _step(self, tensordict):
        reward_E1 = 1.0 - (tensordict["action"] - self.target_E1).square()
        self.step_E1 = self.step_E1 + 1
        self.target_E1 = torch.rand(E, 1) * 2 - 1
        return self._shown(reward=reward_E1)

    def _reset(self, tensordict=None, **_):
        mask_E1 = torch.ones(E, 1, dtype=torch.bool)
        if tensordict is not None and "_reset" in tensordict.keys():
            mask_E1 = tensordict["_reset"].reshape(E, 1)
        self.step_E1 = torch.where(mask_E1, 0.0, self.step_E1)
        return self._shown()

    def _set_seed(self, seed):
        torch.manual_seed(seed or 0)


def test_it_learns_and_the_run_says_what_is_missing(tmp_path, capsys):
    trainer = make_trainer(tmp_path, env=ForeignEnv(), iterations=12)
    trainer.iterate()
    first = trainer.metrics["rollout/reward"]
    trainer.train(RunProgress(12))
    assert trainer.metrics["rollout/reward"] > first
    assert "episode/return" not in trainer.metrics and trainer.evaluation is not None
    said = " ".join(capsys.readouterr().out.split())
    for part in PARTS:
        assert f"ForeignEnv has {part.without.split(':')[0]}" in said
    resumed = make_trainer(env=ForeignEnv(), iterations=13)
    resumed.load(tmp_path)
    assert resumed.iteration == 12
