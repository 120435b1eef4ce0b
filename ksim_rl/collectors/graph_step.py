"""Records one step of an env as a CUDA graph, so that it can be compared with a later step in Python."""

from collections.abc import Callable, Mapping

import torch
from jaxtyping import Shaped
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from ksim_rl.collectors.step_check import StepCheck
from ksim_rl.device.capture import Captured


class GraphStep:
    """`env.step_and_maybe_reset` as it was when a graph of whole rollouts was recorded.

    The arguments are the same as of `CompiledStep`; making it leaves the env as it was. Without CUDA graphs it is
    the env's own step, and never differs.
    """

    def __init__(
        self,
        env: EnvBase,
        root_E: TensorDictBase,
        tensordict: TensorDictBase,
        *,
        nan_ends_rows: bool = False,
        by_term: Callable[[], Mapping[str, Shaped[Tensor, "*?shape"]]] = dict,
    ) -> None:
        self._check = StepCheck(
            env, root_E, tensordict, nan_ends_rows=nan_ends_rows, by_term=by_term
        )
        self._run = Captured(self._step, device=env.device or torch.device("cpu"))
        # A placeholder until the first call of `_step`.
        self._env_state_E = tensordict
        with self._check.left_alone():
            # The eager calls, and one more that captures.
            for _ in range(self._run.warmup + 1):
                self._run()

    def differences(self) -> list[str]:
        """Return the differences from the env's own step in the present state, in which some rows end."""
        with self._check.rows_ending():
            return self._check.differences(self._replayed)

    def _replayed(self) -> TensorDictBase:
        # A replay runs no Python: `_env_state_E` still names the graph's static output, which it fills.
        self._run()
        return self._env_state_E

    def _step(self) -> None:
        self._env_state_E = self._check.own_step()
