"""Shows an env as rsl_rl's `VecEnv`, so that rsl_rl's runners train on it."""

from jaxtyping import Float, Int64
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs import EnvBase

from ksim_rl.adapters.stepper import Infos, Keys, Observations, Stepper
from ksim_rl.envs.contract import part
from ksim_rl.envs.manager_based_rl_env import ManagerBasedRlEnv
from ksim_rl.transforms.innermost import innermost

try:
    from rsl_rl.env import VecEnv
except ImportError as error:
    raise ImportError('rsl_rl is not installed: pip install "ksim_rl[rsl_rl]"') from error


class RslRlVecEnv(VecEnv):
    """Steps a `ManagerBasedRlEnv`, transformed or not, for rsl_rl.

    Observations are a TensorDict [E] of the env's groups (or `keys`, see `Stepper`), which `obs_groups` of the runner's
    config refers to by name (`{"actor": ["actor"], "critic": ["critic"]}`). `extras["time_outs"]` marks truncations,
    which rsl_rl bootstraps; `extras["log"]` holds, every `log_interval` steps (best the runner's `num_steps_per_env`),
    figures of the episodes that ended since then: per-term reward sums, metrics and shares of each termination.
    """

    def __init__(self, env: EnvBase, *, keys: Keys = None, log_interval: int = 24) -> None:
        base_env = part(env, ManagerBasedRlEnv)
        if base_env is None:
            raise ValueError(
                f"env is a {type(innermost(env)).__name__} inside: rsl_rl needs a ManagerBasedRlEnv"
            )
        if log_interval < 1:
            raise ValueError(f"log_interval={log_interval}: expected at least 1")
        # The names that rsl_rl reads from its envs.
        self.env = env
        self.unwrapped = base_env
        self.num_envs = base_env.num_envs
        self.device = base_env.device
        self.cfg = base_env.cfg
        self.num_actions = int(env.full_action_spec[env.action_key].shape[-1])
        self.max_episode_length = base_env.max_episode_length
        # One graph for the env and all its transforms.
        self._stepper = Stepper(env, keys)
        self._log_interval = log_interval
        self._steps = 0

    @property
    def episode_length_buf(self) -> Int64[Tensor, " E"]:
        """Env steps since each episode's start; rsl_rl writes it to spread the time-outs."""
        return self.unwrapped.view.episode_step_E

    @episode_length_buf.setter
    def episode_length_buf(self, steps_E: Int64[Tensor, " E"]) -> None:
        # In place: the env and its recorded step hold this tensor.
        self.unwrapped.view.episode_step_E.copy_(steps_E)

    def get_observations(self) -> TensorDict:
        """Return the observations that the next action answers to, [E]."""
        return self._tensordict(self._stepper.read(self._stepper.root))

    def reset(self) -> tuple[TensorDict, Infos]:
        """Reset all envs."""
        return self._tensordict(self._stepper.reset()), {}

    def step(
        self, action_EL: Float[Tensor, "E L"]
    ) -> tuple[TensorDict, Float[Tensor, " E"], Int64[Tensor, " E"], Infos]:
        """Step all envs; rows that ended come back with the first observation of their next episode."""
        step = self._stepper.step(action_EL)
        # A row that also failed has no value to bootstrap.
        extras: Infos = {"time_outs": step.truncated_E & ~step.terminated_E}
        self._steps += 1
        # Rarely, as figures are read back from the device.
        if self._steps % self._log_interval == 0:
            extras["log"] = self._episode_means()
        return self._tensordict(step.obs), step.reward_E, step.done_E.long(), extras

    def close(self) -> None:
        """Free the env's memory."""
        self.env.close()

    def _tensordict(self, obs: Observations) -> TensorDict:
        return TensorDict(dict(obs), batch_size=[self.num_envs], device=self.device)

    def _episode_means(self) -> dict[str, Tensor]:
        """Return means over the episodes that ended since the last call; zeros where none has."""
        sums = {name: total.clone() for name, total in self.unwrapped.episode_log().items()}
        self.unwrapped.episode_log_reset_()
        episodes = sums.pop("episodes").clamp(min=1.0)
        return {
            f"Episode/{name.removesuffix('_sum')}": total / episodes for name, total in sums.items()
        }
