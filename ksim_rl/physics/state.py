"""This module names the arrays that the next steps of a world depend on, and restores saved ones."""

import mujoco_warp as mjw
import warp as wp
from jaxtyping import Shaped
from torch import Tensor

from ksim_rl.physics.views import ACCELERATION_STAGE

# Integrated or set by the user; empty arrays are left out.
STATE = (
    "time",
    "qpos",
    "qvel",
    "act",
    "history",
    "plastic",
    "qacc_warmstart",
    "ctrl",
    "qfrc_applied",
    "xfrc_applied",
    "eq_active",
    "mocap_pos",
    "mocap_quat",
    "userdata",
    "tree_asleep",
    "tree_awake",
    "body_awake",
    "body_awake_ind",
    "dof_awake_ind",
    "ntree_awake",
    "nbody_awake",
    "nv_awake",
    "overflow",
)
# Results of the last substep that `refresh` does not recompute, but terms may read before the next one.
LAST_SUBSTEP = (
    "sensordata",
    "qacc",
    "act_dot",
    *ACCELERATION_STAGE,
    "actuator_length",
    "actuator_velocity",
)


def data_tensors(warp_data_E: mjw.Data) -> dict[str, Shaped[Tensor, "*?leaf"]]:
    """Return views of the arrays that make up the state of a world."""
    tensors = {name: wp.to_torch(getattr(warp_data_E, name)) for name in (*STATE, *LAST_SUBSTEP)}
    return {name: tensor for name, tensor in tensors.items() if tensor.numel()}


def load(present: dict[str, Shaped[Tensor, "*?leaf"]], saved: dict[str, Shaped[Tensor, "*?leaf"]]) -> None:
    """Copy `saved` into `present`, in place, after checking all of it.

    Raises:
        ValueError: if a tensor is missing, unknown, or of another shape or dtype.
    """
    missing, unknown = sorted(present.keys() - saved.keys()), sorted(saved.keys() - present.keys())
    if missing or unknown:
        raise ValueError(
            f"this state is of another model or version: missing {missing}, unknown {unknown}; load it into a world "
            "built from the same model with the same per_world_fields"
        )
    for name, tensor in present.items():
        if saved[name].shape != tensor.shape or saved[name].dtype != tensor.dtype:
            raise ValueError(
                f"state {name!r} is {saved[name].dtype} of shape {tuple(saved[name].shape)}, but this world has "
                f"{tensor.dtype} of shape {tuple(tensor.shape)}: build it with the same model and num_envs"
            )
    for name, tensor in present.items():
        tensor.copy_(saved[name])
