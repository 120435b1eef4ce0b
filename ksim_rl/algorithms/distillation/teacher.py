"""A teacher is the policy of another run: its weights, and all that is needed to build it again."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tensordict.nn import TensorDictModuleBase
from torchrl.data import Composite
from torchrl.envs import EnvBase

from ksim_rl.checks import naming
from ksim_rl.device import state_tree
from ksim_rl.device.state_tree import State, branch, text
from ksim_rl.modules import recurrent_modules
from ksim_rl.trainers import checkpoint
from ksim_rl.trainers.algorithm import make_policy
from ksim_rl.trainers.run_cfg import RunCfg
from ksim_rl.transforms import observation_columns


@dataclass(frozen=True, kw_only=True)
class Teacher:
    """A policy that does not change, its normalizers included."""

    policy: TensorDictModuleBase
    # The config of its run and the columns of its observations, as JSON: enough to build it again.
    description: Mapping[str, str] = field(default_factory=dict)

    def state_dict(self) -> state_tree.State:
        """Return weights and description: `restored_teacher` builds the same one, without the folder of its run."""
        return {"actor": self.policy.state_dict(), **self.description}

    def load_state_dict(self, state: State) -> None:
        """Take the weights of a `state_dict`; tensors keep their addresses."""
        state_tree.copy_into(self.policy.state_dict(), branch(state, "actor"), what="teacher")


def load_teacher(path: Path, env: EnvBase, *, cfg: RunCfg) -> Teacher:
    """Read the policy of a run folder or a checkpoint, for the env of a student, whose config gives the device.

    A ValueError names what is absent or damaged, or an observation or tensor that this env lacks or has otherwise.
    """
    with naming(f"objective.teacher={str(path)!r}"):
        saved = checkpoint.load_latest(path)
        state = {
            "actor": branch(branch(saved.state, "update"), "actor"),
            "config": json.dumps(saved.config),
            "columns": json.dumps(saved.state["observation_columns"]),
        }
        return restored_teacher(state, env, cfg=cfg)


def restored_teacher(state: State, env: EnvBase, *, cfg: RunCfg) -> Teacher:
    """Build the teacher of a `Teacher.state_dict`; see `load_teacher`."""
    # Built by the config of its own run, on the device of this one.
    teacher_cfg = RunCfg.from_tree(
        {**json.loads(text(state, "config")), "device": str(cfg.resolved_device())}
    )
    read = teacher_cfg.modules.observation_keys("actor")
    theirs: Any = json.loads(text(state, "columns"))
    ours: Any = observation_columns(env)
    shown: Composite = env.observation_spec
    # The groups that it reads have to exist here, and to have the same columns.
    for key in read:
        if key not in shown.keys(True):
            raise ValueError(
                f"the teacher reads {key!r}, and this env shows {', '.join(map(repr, ours))}: add it to "
                "task.observations as the teacher's run has it"
            )
    # Only groups of the vector kind have columns; nested keys are single observations.
    groups = [key for key in read if isinstance(key, str)]
    checkpoint.check_columns(
        *(
            {group: columns[group] for group in groups if group in columns}
            for columns in (theirs, ours)
        )
    )
    policy = make_policy(teacher_cfg, env)
    # Labels are made for single env states, from which no recurrent state can be known.
    if recurrent_modules(policy):
        raise ValueError(
            "the teacher is recurrent, and has to label single env states: take one without"
        )
    state_tree.copy_into(policy.state_dict(), branch(state, "actor"), what="teacher")
    description = {name: text(state, name) for name in ("config", "columns")}
    return Teacher(policy=policy.requires_grad_(False).eval(), description=description)
