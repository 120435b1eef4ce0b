"""These events draw the starts of episodes by the rules of the DeepMind Control Suite."""

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Literal
from weakref import WeakKeyDictionary

import mujoco
import numpy as np
import torch
from jaxtyping import Bool, Float
from mujoco import rollout
from torch import Tensor

from ksim_rl.checked import NonNegative, Range, Seed, WholeNumber, Within
from ksim_rl.envs.term import EventTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.constants import array_constant
from ksim_rl.mdp.start_banks import bank_of
from ksim_rl.physics import World
from ksim_rl.scene.names import match_names

# Of each start of a bank; dm_control gives up after as many.
MOST_DRAWS = 1000
# Of states that settle, which are kept for all steps.
ROWS_AT_ONCE = 256
# Of starts that are drawn on the device, by the text of their rule.
_BOUNDS: WeakKeyDictionary[World, dict[str, Tensor]] = WeakKeyDictionary()


@dataclass(frozen=True, kw_only=True)
class StartRule(EventTerm):
    """A rule for starts: joints uniform in their ranges, the rest in the default pose.

    Attributes:
        own_ranges: limited joints take their own range, hinges without limits all angles (dm_control's
            `randomize_limited_and_rotational_joints`).
        ranges: (low, high) of joints, rad or m, by regular expressions; they win over `own_ranges`.
        root: the orientation of a free root: as in the "default" pose, "uniform" over all, or "positive": a normalized
            quaternion of four numbers from [0, 1), as dm_control draws it for its humanoid.
    """

    own_ranges: bool = False
    ranges: Mapping[str, Range] = field(default_factory=dict)
    root: Literal["default", "uniform", "positive"] = "default"

    def bounds(
        self, mj_model: mujoco.MjModel, default_L: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the lowest and the highest qpos, [nq] each, without the orientation of a free root."""
        # Equal bounds leave a number at the default pose.
        low_L = default_L.copy()
        high_L = default_L.copy()
        # Including free joints, whose names no pattern should match.
        names = [mj_model.joint(joint).name for joint in range(mj_model.njnt)]
        if self.own_ranges:
            for joint, address in enumerate(mj_model.jnt_qposadr):
                if mj_model.jnt_limited[joint]:
                    low_L[address], high_L[address] = mj_model.jnt_range[joint]
                # A hinge without limits takes all angles; slides without limits stay.
                elif mj_model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE:
                    low_L[address] = -np.pi
                    high_L[address] = np.pi
        # After the own ranges, which they replace.
        for pattern, (low, high) in self.ranges.items():
            for joint in match_names("joint", (pattern,), names):
                low_L[mj_model.jnt_qposadr[joint]] = low
                high_L[mj_model.jnt_qposadr[joint]] = high
        return low_L, high_L


@dataclass(frozen=True, kw_only=True)
class DrawStart(StartRule):
    """Put rows that reset into starts drawn by the rule; velocities are normal, `velocity_std` m/s or rad/s."""

    velocity_std: NonNegative = 0.0

    def __call__(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        low_L, high_L = self._device_bounds(view)
        qpos_EL = view.uniform(len(low_L), low_L, high_L)
        # Rounding may move a number away from equal bounds.
        qpos_EL = torch.where(low_L == high_L, low_L, qpos_EL)
        if self.root != "default":
            if self.root == "uniform":
                # A normal draw of four numbers is uniform in direction.
                quat_E4 = view.normal(4)
            else:
                quat_E4 = view.uniform(4)
            # The root is the first joint: 3 of position, then its quaternion.
            qpos_EL[:, 3:7] = quat_E4 / torch.linalg.vector_norm(quat_E4, dim=-1, keepdim=True)
        view.write_qpos(mask_E, qpos_EL)
        qvel_EL = torch.zeros_like(view.world.qvel_EL)
        if self.velocity_std:
            qvel_EL = view.normal(qvel_EL.shape[1]) * self.velocity_std
        view.write_qvel(mask_E, qvel_EL)

    def _device_bounds(self, view: EnvView) -> tuple[Float[Tensor, " L"], Float[Tensor, " L"]]:
        # By world: each has its own default pose and device.
        known = _BOUNDS.setdefault(view.world, {})
        key = repr(self)
        if key not in known:
            default_L = view.default_qpos_L.double().cpu().numpy()
            known[key] = array_constant(
                np.stack(self.bounds(view.world.mj_model, default_L)), view.device
            )
        low_L, high_L = known[key].unbind(0)
        return low_L, high_L


@dataclass(frozen=True, kw_only=True)
class StartFromBank(StartRule):
    """Put rows that reset into starts from a bank, drawn by the rule on the host when the env is made.

    So it may do steps that no CUDA graph can: draw again until nothing touches, and let the model settle.

    Attributes:
        without_contacts: starts in which anything touches are drawn again.
        settle_steps: physics steps without controls, whose end is the start.
        size: starts in the bank.
        bank_seed: of the bank; the env's own seed decides the choices from it.
    """

    without_contacts: bool = False
    settle_steps: WholeNumber = 0
    size: Annotated[int, Within(low=4096)] = 4096
    bank_seed: Seed = 0

    def __call__(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        def drawn() -> np.ndarray:
            return self.draw(view.world.mj_model, view.default_qpos_L.double().cpu().numpy())

        bank_NL = bank_of(view, repr(self), drawn)
        # A random row of the bank for each env.
        start_EL = bank_NL[view.integers(1, 0, self.size - 1)[:, 0]]
        nq = view.world.qpos_EL.shape[1]
        view.write_qpos(mask_E, start_EL[:, :nq])
        view.write_qvel(mask_E, start_EL[:, nq:])

    def draw(self, mj_model: mujoco.MjModel, default_L: np.ndarray) -> np.ndarray:
        """Return the bank, qpos and qvel of each start, [N, nq + nv]; a ValueError if starts touch again and again."""
        random = np.random.default_rng(self.bank_seed)
        data = mujoco.MjData(mj_model)
        low_L, high_L = self.bounds(mj_model, default_L)
        bank_NL = np.zeros((self.size, mj_model.nq + mj_model.nv))
        # Rows of the bank are filled in place.
        for row_L in bank_NL:
            for _ in range(MOST_DRAWS):
                mujoco.mj_resetData(mj_model, data)
                data.qpos = random.uniform(low_L, high_L)
                if self.root != "default":
                    if self.root == "uniform":
                        quat = random.normal(size=4)
                    else:
                        quat = random.random(4)
                    data.qpos[3:7] = quat / np.linalg.norm(quat)
                if not self.without_contacts:
                    break
                # Contacts need positions only.
                mujoco.mj_fwdPosition(mj_model, data)
                if data.ncon == 0:
                    break
            else:
                raise ValueError(
                    f"without_contacts=True: no start without contacts in {MOST_DRAWS} draws"
                )
            # Velocities stay 0.
            row_L[: mj_model.nq] = data.qpos
        if self.settle_steps:
            return _settled(mj_model, bank_NL, steps=self.settle_steps)
        return bank_NL


def _settled(mj_model: mujoco.MjModel, bank_NL: np.ndarray, *, steps: int) -> np.ndarray:
    """Return where states, [N, nq + nv], are so many physics steps later, on all cores."""
    datas = [mujoco.MjData(mj_model) for _ in range(os.cpu_count() or 1)]
    # MuJoCo's state of this kind is time, then qpos and qvel, in models without activations and plug-ins.
    kind = mujoco.mjtState.mjSTATE_FULLPHYSICS
    assert mujoco.mj_stateSize(mj_model, kind) == 1 + mj_model.nq + mj_model.nv
    parts = []
    # In parts, since all steps of a part are kept until it ends.
    for part_NL in np.array_split(bank_NL, max(1, len(bank_NL) // ROWS_AT_ONCE)):
        start_NL = np.concatenate((np.zeros((len(part_NL), 1)), part_NL), axis=1)
        states_NTL, _ = rollout.rollout(mj_model, datas, start_NL, nstep=steps)
        # The last step, without its time.
        parts.append(states_NTL[:, -1, 1:])
    return np.concatenate(parts)
