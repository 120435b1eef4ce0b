"""Gymnasium's pendulum (`Pendulum-v1`) for many envs in pure torch, so that learning is tested without physics."""

import math

import torch
from tensordict import TensorDict
from torchrl.data import Binary, Bounded, Composite, Unbounded

from ksim_rl.envs.masked_reset import MaskedReset

LENGTH = 200
# A policy that does nothing gets about -1200; good ones -150 on average over all starts.
SOLVED_AT = -250.0


class PendulumEnv(MaskedReset):
    """Swing up and balance: the reward is -(angle^2 + 0.1 speed^2 + 0.001 torque^2), torques lie in [-2, 2].

    An episode lasts 200 steps of 0.05 s and is truncated.
    """

    max_episode_length = LENGTH

    def __init__(self, num_envs):
        super().__init__(device=torch.device("cpu"), batch_size=[num_envs])
        self.angle_E1, self.speed_E1 = torch.zeros(num_envs, 1), torch.zeros(num_envs, 1)
        self.step_E1 = torch.zeros(num_envs, 1, dtype=torch.int64)
        self.generator = torch.Generator().manual_seed(0)
        shape = [num_envs]
        vector, flag = Unbounded((num_envs, 3)), Binary(1, (num_envs, 1), dtype=torch.bool)
        self.observation_spec = Composite(actor=vector, critic=vector.clone(), shape=shape)
        self.full_action_spec = Composite(action=Bounded(-2.0, 2.0, (num_envs, 1)), shape=shape)
        self.full_reward_spec = Composite(reward=Unbounded((num_envs, 1)), shape=shape)
        self.full_done_spec = Composite(
            done=flag, terminated=flag.clone(), truncated=flag.clone(), shape=shape
        )

    def _observe(self, **more):
        seen = torch.cat((self.angle_E1.cos(), self.angle_E1.sin(), self.speed_E1 / 8.0), -1)
        return TensorDict(
            {"actor": seen, "critic": seen.clone(), **more}, batch_size=self.batch_size
        )

    def _step(self, tensordict):
        torque = tensordict["action"].clamp(-2.0, 2.0)
        angle = (self.angle_E1 + math.pi) % (2 * math.pi) - math.pi
        reward = -(angle.square() + 0.1 * self.speed_E1.square() + 0.001 * torque.square())
        # A rod of 1 kg and 1 m, gravity 10 m/s^2, as Gymnasium integrates it.
        speed = self.speed_E1 + (15.0 * angle.sin() + 3.0 * torque) * 0.05
        self.speed_E1 = speed.clamp(-8.0, 8.0)
        self.angle_E1 = self.angle_E1 + self.speed_E1 * 0.05
        self.step_E1 = self.step_E1 + 1
        truncated = self.step_E1 >= LENGTH
        return self._observe(
            reward=reward,
            done=truncated,
            truncated=truncated.clone(),
            terminated=torch.zeros_like(truncated),
        )

    def _reset(self, tensordict=None, **_):
        mask = torch.ones(*self.batch_size, 1, dtype=torch.bool)
        if tensordict is not None and "_reset" in tensordict.keys():
            mask = tensordict["_reset"].reshape(-1, 1)
        draw = torch.rand(*self.batch_size, 2, generator=self.generator) * 2 - 1
        self.angle_E1 = torch.where(mask, draw[:, :1] * math.pi, self.angle_E1)
        self.speed_E1 = torch.where(mask, draw[:, 1:], self.speed_E1)
        self.step_E1 = torch.where(mask, 0, self.step_E1)
        no = torch.zeros_like(mask)
        return self._observe(done=no, terminated=no.clone(), truncated=no.clone())

    def _set_seed(self, seed):
        self.generator.manual_seed(seed or 0)
