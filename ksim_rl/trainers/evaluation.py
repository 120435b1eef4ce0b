"""Evaluates a policy by its deterministic actions in separate envs, one whole episode in each."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from ksim_rl import ranks
from ksim_rl.device.capture import Captured
from ksim_rl.envs.recorded_python import FollowedGraph
from ksim_rl.envs.signal_keys import signal_keys


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """Statistics over episodes. `unfinished` ones were cut at the step limit, and count with their returns so far.

    In `lost_worlds` envs, at least, the physics had no room for all contacts and constraints, as far as it was asked.
    """

    return_mean: float
    return_std: float
    length_mean: float
    episodes: int
    unfinished: int
    lost_worlds: int = 0


class Evaluator:
    """Runs the first episode of each env from the same seed, with the policy's deterministic action; all ranks share.

    The envs `["E"]` are stepped by nothing else. Their own `max_episode_length` is the natural `max_steps`.
    After a call `return_E` and `length_E`, float64 [E], have the return and the steps of each episode, and
    `terminated_E`, bool [E], tells which ones a termination ended.
    """

    def __init__(
        self, env: EnvBase, policy: TensorDictModuleBase, *, max_steps: int, seed: int
    ) -> None:
        self.env = env
        self.policy = policy
        self._signals = signal_keys(env)
        self.max_steps = max_steps
        self.seed = seed
        num_envs = env.batch_size[0]
        device = env.device or torch.device("cpu")
        # float64: sums over many steps must not depend on their order.
        self.return_E = torch.zeros(num_envs, dtype=torch.float64, device=device)
        self.length_E = torch.zeros(num_envs, dtype=torch.float64, device=device)
        self.terminated_E = torch.zeros(num_envs, dtype=torch.bool, device=device)
        self._running_E = torch.ones(num_envs, dtype=torch.bool, device=device)
        self._current_E: TensorDictBase | None = None
        # One step is captured, and replayed for each step of an episode.
        self._step = Captured(self._count_one_step, device=device)
        self._followed = FollowedGraph(env, self._step, {"policy": policy})

    def __call__(self, *, stop: Callable[[], bool] = lambda: False) -> Evaluation | None:
        """Evaluate, reading the device once at the end; None if `stop` says so before that."""
        self._followed.follow()
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            self._start()
            for _ in range(self.max_steps):
                if stop():
                    return None
                self._step()
        # Of all ranks, in one order, so that each rank computes the same figures.
        own = self.return_E, self.length_E, self._running_E.to(torch.float64)
        return_E, length_E, running_E = (torch.cat(ranks.gather(figure_E)) for figure_E in own)
        figures = torch.stack(
            [*torch.std_mean(return_E, correction=0), length_E.mean(), running_E.sum()]
        )
        std, mean, length, unfinished = figures.tolist()
        return Evaluation(
            return_mean=mean,
            return_std=std,
            length_mean=length,
            episodes=return_E.numel(),
            unfinished=int(unfinished),
        )

    def _start(self) -> None:
        # The same initial states at each evaluation, so that figures can be compared.
        self.env.set_seed(self.seed)
        first_E = self.env.reset()
        # The first root makes the buffers, and later ones are copied into them.
        if self._current_E is None:
            self._current_E = first_E.clone()
        else:
            self._keep(first_E)
        self.return_E.zero_()
        self.length_E.zero_()
        self.terminated_E.zero_()
        self._running_E.fill_(True)

    def _count_one_step(self) -> None:
        assert self._current_E is not None
        with self._followed.calling():
            acting_E = self.policy(self._current_E.copy())
            stepped_E, current_E = self.env.step_and_maybe_reset(acting_E)
        next_E = stepped_E.get("next")
        reward_E, done_E, terminated_E = (next_E.get(key).reshape(-1) for key in self._signals[:3])
        # Only the first episode of each env counts: after its end the env goes on unseen.
        self.return_E.add_(torch.where(self._running_E, reward_E.to(torch.float64), 0.0))
        self.length_E.add_(self._running_E)
        self.terminated_E.logical_or_(self._running_E & terminated_E)
        # After the sums, so that the last step of an episode counts.
        self._running_E.logical_and_(~done_E)
        self._keep(current_E)

    def _keep(self, source_E: TensorDictBase) -> None:
        """Copy into the buffers that a captured step reads, which stay where they are."""
        assert self._current_E is not None
        for key in self._current_E.keys(True, True):
            self._current_E.get(key).copy_(source_E.get(key))
