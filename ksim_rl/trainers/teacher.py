"""The policy of another run, as a teacher: its weights, and all that is needed to build it once more."""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from ksim_rl.envs.transforms import observation_columns
from ksim_rl.modules import memories
from ksim_rl.trainers import checkpoint, state_tree
from ksim_rl.trainers.columns import check_columns
from ksim_rl.trainers.run_cfg import RunCfg

MakePolicy = Callable[[RunCfg, EnvBase], TensorDictModuleBase]


@dataclass(frozen=True, kw_only=True)
class Teacher:
    """A policy that does not change, with what a checkpoint says of it.

    Attributes:
        policy: the network, its normalizers included.
        cfg: of its run.
        columns: which columns of its groups belong to which term.
    """

    policy: TensorDictModuleBase
    cfg: RunCfg
    columns: Mapping[str, Any]

    def state_dict(self) -> state_tree.State:
        """Return weights and config: `restored_teacher` builds the same one, without the folder of its run."""
        return {
            "actor": self.policy.state_dict(),
            # As text, because lists of a config may hold more than plain data.
            "config": json.dumps(self.cfg.to_tree()),
            "columns": json.dumps(self.columns),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Take the weights of a `state_dict`; tensors keep their addresses.

        Raises:
            ValueError: naming the tensor that does not fit.
        """
        state_tree.copy_into(self.policy.state_dict(), state["actor"], what="teacher")


def load_teacher(path: Path, env: EnvBase, *, cfg: RunCfg, make_policy: MakePolicy) -> Teacher:
    """Read the policy of a run folder or a checkpoint, for the env of a student.

    Args:
        cfg: of the student's run, for the device.
        make_policy: builds the policy of a run.

    Raises:
        CheckpointError: when there is none, or it is damaged.
        ValueError: naming the observations or the tensor that this env does not have, or has otherwise.
    """
    saved = checkpoint.load(checkpoint.latest(path))
    state = {
        "actor": saved.state["update"]["actor"],
        "config": json.dumps(saved.config),
        "columns": json.dumps(saved.state["observation_columns"]),
    }
    try:
        return restored_teacher(state, env, cfg=cfg, make_policy=make_policy)
    except ValueError as error:
        raise ValueError(f"objective.teacher={str(path)!r}: {error}") from error


def restored_teacher(
    state: Mapping[str, Any], env: EnvBase, *, cfg: RunCfg, make_policy: MakePolicy
) -> Teacher:
    """Build the teacher of a `Teacher.state_dict`.

    Raises:
        ValueError: as `load_teacher`.
    """
    teacher_cfg = RunCfg.from_tree({**json.loads(state["config"]), "device": str(cfg.resolved_device())})
    columns = json.loads(state["columns"])
    read = teacher_cfg.modules.actor_keys()
    groups = [key for key in read if isinstance(key, str)]
    own: Any = observation_columns(env)
    shown: Any = env.observation_spec
    missing = [key for key in read if key not in shown.keys(True)]
    if missing:
        raise ValueError(
            f"the teacher reads {missing[0]!r}, and this env shows {', '.join(map(repr, own))}: add the group to "
            "task.observations as the teacher's run has it"
        )
    check_columns(
        {group: columns[group] for group in groups if group in columns},
        {group: own[group] for group in groups if group in own},
    )
    policy = make_policy(teacher_cfg, env)
    if memories(policy):
        raise ValueError("the teacher has a memory, and labels single env states: use a teacher without one")
    state_tree.copy_into(policy.state_dict(), state["actor"], what="teacher")
    return Teacher(policy=policy.requires_grad_(False).eval(), cfg=teacher_cfg, columns=columns)
