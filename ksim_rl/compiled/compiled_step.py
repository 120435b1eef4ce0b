"""This module compiles the step of an env, resets included, whatever terms and transforms it is made of."""

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from ksim_rl.compiled.tape import Tape
from ksim_rl.device.copying import copy_rows
from ksim_rl.device.recording import recorded

SHARE, TOLERANCE = 0.99, 1e-3


class CompiledStep:
    """`env.step_and_maybe_reset` in few kernels: what torch computes between the launches of physics is compiled.

    `tensordict` is what a policy makes of `root_E`, the EnvState before the step, in whose memory the step writes the
    one after it; the policy's leaves may lie elsewhere each time. Making it takes steps of the env and leaves it as it
    was. A RuntimeError where the step cannot be recorded, or where it or the next one gives something else when
    compiled: 1 % of the numbers of a leaf may differ by more than 0.1 %, as where rounding decides between branches.
    """

    def __init__(self, env: EnvBase, root_E: TensorDictBase, tensordict: TensorDictBase) -> None:
        root_keys = list(root_E.keys(True, True))
        self._changing = [key for key in tensordict.keys(True, True) if key not in root_keys]
        # Dense and in memory of their own, as later ones are copied here.
        self._given = [
            tensordict.get(key).clone(memory_format=torch.contiguous_format) for key in self._changing
        ]
        tensordict = tensordict.copy()
        for key, leaf in zip(self._changing, self._given, strict=True):
            tensordict.set(key, leaf)
        before, root_before_E = env.state_dict(), root_E.clone()

        def step() -> TensorDictBase:
            env_state_E, next_root_E = env.step_and_maybe_reset(tensordict.copy())
            for key in root_keys:
                root_E.get(key).copy_(next_root_E.get(key))
            return env_state_E

        with recorded() as recorder:
            self.env_state_E = step()
        self._next_E = self.env_state_E.select("next")
        returned = list(self._next_E.values(True, True))
        self._tape = Tape(recorder, num_rows=env.batch_size[0], returned=returned)
        # The second step shows what the first one kept elsewhere than in tensors.
        expected = [_state(env, root_E, self._next_E), _state(env, root_E, step().select("next"))]
        try:
            env.load_state_dict(before)
            root_E.update_(root_before_E)
            for true in expected:  # one by one, as a state of many envs takes much memory
                _compare(_state(env, root_E, self(tensordict)), true)
        finally:
            env.load_state_dict(before)
            root_E.update_(root_before_E)

    def __call__(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Make a step, and reset the rows that are done: return the EnvState's `next`, and write the next root.

        The leaves lie in the same memory each time.
        """
        copy_rows(self._given, [tensordict.get(key) for key in self._changing])
        self._tape()
        return self._next_E


def _state(env: EnvBase, root_E: TensorDictBase, next_E: TensorDictBase) -> dict[str, Tensor]:
    named = {f"{key}": leaf.clone() for key, leaf in next_E.items(True, True)}
    named |= {f"root {key}": leaf.clone() for key, leaf in root_E.items(True, True)}
    # What the env last returned is no state of its own, and a compiled step returns it otherwise; how many contacts of
    # all worlds there were at most changes with the smallest difference in one.
    left_out = "last_root.", "overflow/"
    own = {name: value for name, value in env.state_dict().items() if not any(n in name for n in left_out)}
    return named | {name: value for name, value in own.items() if isinstance(value, Tensor)}


def _compare(found: dict[str, Tensor], expected: dict[str, Tensor]) -> None:
    for name, true in expected.items():
        own = found[name]
        same = own == true
        if true.is_floating_point():
            same |= (own - true).abs() <= TOLERANCE * (1.0 + true.abs())
            same |= own.isnan() & true.isnan()
        if same.numel() and (share := float(same.float().mean())) < SHARE:
            raise RuntimeError(
                f"the compiled step gives another {name} than the env in {1.0 - share:.1%} of places"
            )
