"""Bends a robot's joints at the start of an episode, by poses in which its limbs do not lie inside of each other."""

from dataclasses import dataclass

import mujoco
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ksim_rl.checked import Count, NonNegative, Range, Seed
from ksim_rl.envs.term import EventTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.fields import OfJoints
from ksim_rl.mdp.start_banks import bank_of

# Of each pose of a bank: far more than robots need whose limbs can be apart at all.
MOST_DRAWS = 1000


@dataclass(frozen=True, kw_only=True)
class BendJointsApart(OfJoints, EventTerm):
    """Put joints at default positions plus an offset, rad or m, where no limb reaches into another one, at rest.

    Poses are drawn on the host when the env is made, again and again until the robot does not touch itself; a start
    takes one of them. Bodies of one robot count, not the ground or objects.

    Attributes:
        position_range: of the offsets; positions stay in the soft limits.
        depth: by which limbs may reach into each other, m.
        size: poses that are drawn.
        bank_seed: of the poses; the env's own seed decides which one a start takes.
    """

    position_range: Range
    depth: NonNegative = 0.0
    size: Count = 2048
    bank_seed: Seed = 0

    def __call__(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        joints = view.joints(self.joints)

        def drawn() -> np.ndarray:
            return self.draw(
                view.world.mj_model,
                tuple(joints.names),
                default_M=view.default_qpos_L.double().cpu().numpy(),
                limits_L2=joints.soft_limits_L2.double().cpu().numpy(),
            )

        bank_NL = bank_of(view, repr(self), drawn)
        # A random row of the bank for each env.
        pos_EL = bank_NL[view.integers(1, 0, self.size - 1)[:, 0]]
        joints.write_pos(mask_E, pos_EL)
        joints.write_vel(mask_E, torch.zeros_like(pos_EL))

    def draw(
        self,
        mj_model: mujoco.MjModel,
        names: tuple[str, ...],
        *,
        default_M: Float[np.ndarray, " M"],
        limits_L2: Float[np.ndarray, "L 2"],
    ) -> Float[np.ndarray, "N L"]:
        """Return the positions of the joints of these names in each pose of the bank.

        `default_M` is qpos of the default pose, `limits_L2` are the joints' soft limits. A ValueError if limbs reach
        into each other again and again.
        """
        random = np.random.default_rng(self.bank_seed)
        data = mujoco.MjData(mj_model)
        places = [int(mj_model.joint(name).qposadr[0]) for name in names]
        bank_NL = np.zeros((self.size, len(names)))
        for row_L in bank_NL:
            for _ in range(MOST_DRAWS):
                offset_L = random.uniform(*self.position_range, size=len(names))
                pos_L = np.clip(default_M[places] + offset_L, limits_L2[:, 0], limits_L2[:, 1])
                data.qpos = default_M
                data.qpos[places] = pos_L
                if reach_of(mj_model, data) <= self.depth:
                    break
            else:
                raise ValueError(
                    f"position_range={self.position_range}: in {MOST_DRAWS} draws the limbs reach into each other by "
                    f"more than depth={self.depth:g} m: choose a smaller range, or a larger depth"
                )
            row_L[:] = pos_L
        return bank_NL


def reach_of(mj_model: mujoco.MjModel, data: mujoco.MjData) -> float:
    """Return by how much bodies of one robot reach into each other at `data.qpos`, m; 0 where they are apart."""
    # Contacts need positions only.
    mujoco.mj_kinematics(mj_model, data)
    mujoco.mj_comPos(mj_model, data)
    mujoco.mj_collision(mj_model, data)
    contact = data.contact
    if not len(contact.dist):
        return 0.0
    roots_N2 = mj_model.body_rootid[mj_model.geom_bodyid[contact.geom]]
    # The ground has the world as its root, and objects have roots of their own.
    is_own_N = (roots_N2[:, 0] == roots_N2[:, 1]) & (roots_N2[:, 0] != 0)
    return float(np.max(-contact.dist[is_own_N], initial=0.0))
