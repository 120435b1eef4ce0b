"""Two problems of pure torch: one on which imitation of recorded states drifts off, one whose motion is a circle."""

import math

import torch
from tensordict import TensorDict
from torchrl.data import Binary, Composite, Unbounded

from ksim_rl.algorithms.amp.update import AMPUpdate
from ksim_rl.algorithms.bc.demonstration import Demonstration
from ksim_rl.algorithms.bc.update import BCUpdate
from ksim_rl.algorithms.distillation.teacher import Teacher
from ksim_rl.algorithms.distillation.update import DistillationUpdate
from ksim_rl.collectors import RolloutCollector
from ksim_rl.data import DatasetCfg
from ksim_rl.device import random
from ksim_rl.envs.masked_reset import MaskedReset
from ksim_rl.modules import ActorCfg, CriticCfg, make_actor, make_critic
from ksim_rl.objectives import AMPCfg, BCCfg, DistillationCfg
from ksim_rl.trainers import PPOUpdate, Trainer, TrainerCfg

GAIN, LIMIT = 1.3, 2.0
BINS = torch.linspace(-LIMIT, LIMIT, 21)
INDEX = torch.arange(21)
TURN = 0.5


class StateEnv(MaskedReset):
    """E points `x_EL` that move as a subclass says and are reset after `length` steps; the reward is zero."""

    def __init__(self, num_envs, *, dim, length, widths):
        super().__init__(device=torch.device("cpu"), batch_size=[num_envs])
        self.length = length
        self.seed_value = torch.tensor(0)
        self.x_EL = torch.zeros(num_envs, dim)
        self.step_E, self.episode_E = (torch.zeros(num_envs, dtype=torch.int64) for _ in range(2))
        shape, flag = [num_envs], Binary(1, (num_envs, 1), dtype=torch.bool)
        vectors = {name: Unbounded((num_envs, width)) for name, width in widths.items()}
        self.observation_spec = Composite(vectors, shape=shape)
        self.full_action_spec = Composite(action=Unbounded((num_envs, dim)), shape=shape)
        self.full_reward_spec = Composite(reward=Unbounded((num_envs, 1)), shape=shape)
        self.full_done_spec = Composite(
            done=flag, terminated=flag.clone(), truncated=flag.clone(), shape=shape
        )

    def _step(self, tensordict):
        self.x_EL.copy_(self.move(self.x_EL, tensordict["action"]))
        self.step_E += 1
        over_E1 = (self.step_E >= self.length)[:, None]
        reward = torch.zeros(*self.batch_size, 1)
        return self._env_state(
            reward=reward, done=over_E1, terminated=torch.zeros_like(over_E1), truncated=over_E1
        )

    def _reset(self, tensordict=None, **_):
        mask_E = torch.ones(self.batch_size, dtype=torch.bool)
        if tensordict is not None and "_reset" in tensordict.keys():
            mask_E = tensordict["_reset"].reshape(-1)
        self.step_E.masked_fill_(mask_E, 0)
        self.episode_E += mask_E
        unit_E1 = random.uniform(
            random.row_keys(self.seed_value, 1, self.episode_E, len(mask_E)), 1, 0.0, 1.0
        )
        self.x_EL.copy_(torch.where(mask_E[:, None], self.start(unit_E1), self.x_EL))
        no_E1 = torch.zeros(*self.batch_size, 1, dtype=torch.bool)
        return self._env_state(done=no_E1, terminated=no_E1.clone(), truncated=no_E1.clone())

    def _env_state(self, **leaves):
        return TensorDict({**self.observe(), **leaves}, batch_size=self.batch_size)

    def _set_seed(self, seed):
        self.seed_value.fill_(seed or 0)
        self.episode_E.zero_()

    def state_dict(self, *_, **__):
        names = ("seed_value", "x_EL", "step_E", "episode_E")
        return {name: getattr(self, name).clone() for name in names}

    def load_state_dict(self, state_dict, *_, **__):
        for name, value in state_dict.items():
            getattr(self, name).copy_(value)


class DriftEnv(StateEnv):
    """An offset grows by 30 % per step unless the action takes it back: x' = 1.3 x + a, |x| <= 2.

    The teacher sees x and acts -1.3 x, which ends in 0 at once. The student sees in which of 21 bins x lies, so that it
    knows nothing of bins that it has not seen.
    """

    def __init__(self, num_envs=64):
        super().__init__(num_envs, dim=1, length=12, widths={"actor": len(BINS), "privileged": 1})

    def start(self, unit_E1):
        return 0.2 * unit_E1 - 0.1

    def move(self, x_EL, action_EL):
        return (GAIN * x_EL + action_EL).clamp(-LIMIT, LIMIT)

    def observe(self):
        nearest_E1 = (self.x_EL - BINS).abs().argmin(-1, keepdim=True)
        return {"actor": (nearest_E1 == INDEX).float(), "privileged": self.x_EL.clone()}


class EchoEnv(DriftEnv):
    """A point goes where the action says, and the student sees it twenty times as large: its own last action."""

    def move(self, x_EL, action_EL):
        return action_EL.clone()

    def observe(self):
        return {"actor": 20.0 * self.x_EL.expand(-1, len(BINS)), "privileged": self.x_EL.clone()}


class PlaneEnv(StateEnv):
    """A point in the plane moves by its action, at most 1 along each axis; episodes begin on the unit circle."""

    def __init__(self, num_envs=64):
        super().__init__(num_envs, dim=2, length=16, widths={"actor": 2, "critic": 2, "style": 2})

    def start(self, unit_E1):
        return on_circle(2.0 * math.pi * unit_E1[:, 0])

    def move(self, x_EL, action_EL):
        return (x_EL + action_EL.clamp(-1.0, 1.0)).clamp(-4.0, 4.0)

    def observe(self):
        return {name: self.x_EL.clone() for name in ("actor", "critic", "style")}


def on_circle(angle):
    return torch.stack((angle.cos(), angle.sin()), -1)


def circling(count=128):
    """Return transitions [N, 2, 2] of a point that turns by `TURN` per step, counterclockwise."""
    angle = torch.linspace(0.0, 2.0 * math.pi, count)
    return torch.stack((on_circle(angle), on_circle(angle + TURN)), 1)


def linear_teacher(gain=-GAIN, *, key="privileged"):
    actor = make_actor(
        ActorCfg(in_keys=(key,), hidden_dims=(), obs_normalization=False, init_std=0.3),
        obs_dim=1,
        action_dim=1,
    )
    with torch.no_grad():
        actor[0].module.head.loc.weight.fill_(gain)
    return Teacher(policy=actor.requires_grad_(False).eval())


def make_distillation(
    folder=None,
    *,
    seed=0,
    iterations=6,
    teacher=None,
    num_envs=64,
    shards=1,
    cfg=None,
    student=None,
    env=None,
):
    torch.manual_seed(seed)
    env = (env or DriftEnv)(num_envs)
    env.set_seed(seed)
    actor = student or ActorCfg(hidden_dims=(), obs_normalization=False, init_std=0.5)
    data = DatasetCfg(num_env_states_per_minibatch=2 * num_envs, num_minibatches=4, shards=shards)
    update = DistillationUpdate(
        DistillationCfg(
            **{"teacher": "toy", "learning_rate": 0.05, "num_epochs": 4, **(cfg or {})}
        ),
        actor=make_actor(actor, obs_dim=len(BINS), action_dim=1),
        teacher=teacher or linear_teacher(),
        data=data,
        seed=seed,
    )
    return _trainer(env, update, data, folder, iterations)


def linear_demonstration(num=4096, *, noise=0.3, held_out=512):
    """Env states whose actions are (2 x - y + 0.5, y) of what "actor" shows, with noise of this deviation."""
    generator = torch.Generator().manual_seed(5)
    obs_N2 = torch.randn(num, 2, generator=generator)
    mean_N2 = torch.stack((2.0 * obs_N2[:, 0] - obs_N2[:, 1] + 0.5, obs_N2[:, 1]), 1)
    action_N2 = mean_N2 + noise * torch.randn(num, 2, generator=generator)
    env_states_N = TensorDict({"actor": obs_N2, "action": action_N2}, [num])
    return Demonstration(learned_N=env_states_N[held_out:], held_out_N=env_states_N[:held_out])


def make_bc(
    folder=None,
    *,
    seed=0,
    iterations=6,
    num_envs=64,
    cfg=None,
    demonstration=None,
    normalizes=False,
):
    torch.manual_seed(seed)
    env = PlaneEnv(num_envs)
    env.set_seed(seed)
    actor = ActorCfg(hidden_dims=(), obs_normalization=normalizes, output_gain=1.0)
    data = DatasetCfg(num_env_states_per_minibatch=4 * num_envs, num_minibatches=4)
    update = BCUpdate(
        BCCfg(**{"episodes": "made_up", "learning_rate": 0.05, **(cfg or {})}),
        actor=make_actor(actor, obs_dim=2, action_dim=2),
        critic=make_critic(CriticCfg(hidden_dims=(32,)), obs_dim=2),
        demonstration=demonstration or linear_demonstration(),
        data=data,
        seed=seed,
    )
    return _trainer(env, update, data, folder, iterations)


def make_amp(folder=None, *, seed=0, iterations=6, num_envs=64, reference=None, shards=1, cfg=None):
    torch.manual_seed(seed)
    env = PlaneEnv(num_envs)
    env.set_seed(seed)
    actor = make_actor(ActorCfg(hidden_dims=(32, 32), init_std=0.4), obs_dim=2, action_dim=2)
    critic = make_critic(CriticCfg(hidden_dims=(32, 32)), obs_dim=2)
    data = DatasetCfg(num_env_states_per_minibatch=4 * num_envs, num_minibatches=4, shards=shards)
    fields = {
        "motions": ("circle",),
        "task_coeff": 0.0,
        "style_coeff": 1.0,
        "discriminator_hidden_dims": (64, 64),
        "discriminator_learning_rate": 1e-3,
        "gradient_penalty": 2.0,
        "num_transitions_per_step": 4 * num_envs,
        "num_discriminator_steps": 8,
        "num_epochs": 4,
        "gamma": 0.9,
        "learning_rate": 3e-3,
        "entropy_coeff": 0.0,
        "desired_kl": 0.02,
        **(cfg or {}),
    }
    amp = AMPCfg(**fields)
    ppo = PPOUpdate(amp, actor=actor, critic=critic, data=data, seed=seed)
    reference_N2L = circling() if reference is None else reference
    update = AMPUpdate(amp, ppo=ppo, reference_N2L=reference_N2L, num_envs=num_envs)
    return _trainer(env, update, data, folder, iterations)


def _trainer(env, update, data, folder, iterations):
    length = data.rollout_length(env.batch_size[0])
    collector = RolloutCollector(
        env, update.behavior, rollout_length=length, keys=update.rollout_keys
    )
    cfg = TrainerCfg(num_iterations=iterations, eval_interval=0, checkpoint_interval=0)
    return Trainer(cfg, collector=collector, update=update, folder=folder)
