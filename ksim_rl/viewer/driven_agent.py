"""An agent whose actions a person drives, by the sliders of the viewer, keys or a gamepad."""

from collections.abc import Mapping

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from ksim_rl.envs import ManagerBasedRlEnv
from ksim_rl.envs.contract import part

HAND = "hand"
"""The kind of agent, as `ksim-rl play --agent hand` names it."""


class DrivenAgent(TensorDictModuleBase):
    """Writes "action" into the roots of an env: the same in all envs, 0 until it is driven.

    Attributes:
        ranges: low and high of each column, by name; -1 and 1 where the action has no bounds.
    """

    def __init__(self, env: EnvBase) -> None:
        super().__init__()
        spec = env.action_spec
        self._action_EL = spec.zero()
        ours = part(env, ManagerBasedRlEnv)
        assert ours is not None
        names: list[str] = []
        for term, size in ours.action_manager.sizes.items():
            # A number behind the term's name only where there are several.
            if size == 1:
                names.append(term)
            else:
                names += [f"{term}.{column}" for column in range(size)]
        # A transform of the env may give the action another size.
        if len(names) != self._action_EL.shape[-1]:
            names = [str(column) for column in range(self._action_EL.shape[-1])]
        bounds_L2 = ours.action_manager.bounds_L2
        if bounds_L2 is None or len(bounds_L2) != len(names):
            bounds_L2 = torch.tensor((-1.0, 1.0)).expand(len(names), 2)
        self.ranges = dict(zip(names, map(tuple, bounds_L2.tolist()), strict=True))

    def drive(self, values: Mapping[int, float]) -> None:
        """Hold columns of the action at values, in all envs."""
        for column, value in values.items():
            self._action_EL[:, column] = value

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action."""
        return tensordict.set("action", self._action_EL.clone())
