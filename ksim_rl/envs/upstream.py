"""Undocumented interfaces of TorchRL 0.14.1 and tensordict 0.14.3 that the envs use.

Beside that they override `_step_proc_data`, `_make_output_spec` and `_make_input_spec`, whose results they label.
`tests/envs/test_upstream.py` names the part that a new version moved.
"""

import functools
from typing import Any

from tensordict import TensorDictBase
from torchrl.envs import EnvBase
from torchrl.envs.batched_envs import BatchedEnvBase
from torchrl.envs.common import _EnvWrapper

from ksim_rl.transforms.innermost import innermost


def can_reset_nothing(env: EnvBase) -> bool:
    """Whether an env resets the rows of any mask: simulators of others and batches of processes reset at least one."""
    # Their reset is a call of foreign code, which resets at least one.
    if isinstance(innermost(env), _EnvWrapper | BatchedEnvBase):
        return False
    # One "done" at the root, next to "terminated".
    return bool(env.batch_size) and env.reset_keys == ["_reset"] and env._simple_done


def resolved_set_state(
    env: EnvBase, tensordict: TensorDictBase | None, set_state: bool | None, select_reset_only: bool
) -> bool | None:
    """Interpret `reset(set_state=...)` for this tensordict, which must have the env's batch size."""
    if tensordict is not None:
        env._assert_tensordict_shape(tensordict)
    return env._resolve_set_state(set_state, tensordict, select_reset_only)


def complete_done(env: EnvBase, root: TensorDictBase) -> None:
    """Write the flags of the done spec that a reset left out."""
    env._complete_done(env.full_done_spec, root)


def let_none_keep_names() -> None:
    """Let `TensorDictBase.refine_names` keep the names of dims for which it is given None, instead of refusing them.

    `MultiSyncCollector` names the time dim of stacked data by `refine_names(None, None, "time")`, and so would
    crash on the "E" of any env that labels its dims.
    """
    refine_names: Any = TensorDictBase.refine_names
    if refine_names.__module__ == __name__:
        return

    @functools.wraps(refine_names, assigned=("__name__", "__qualname__", "__doc__"))
    def keeping(self: TensorDictBase, *names: Any) -> TensorDictBase:
        if len(names) == self.batch_dims and Ellipsis not in names:
            refined = []
            for new, old in zip(names, self.names, strict=True):
                # None keeps the present name.
                refined.append(old if new is None else new)
            names = tuple(refined)
        return refine_names(self, *names)

    TensorDictBase.refine_names = keeping  # pyright: ignore[reportAttributeAccessIssue]
