"""Records episodes of a policy in our own physics, so that another simulator can run the same ones."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp

from ksim_rl.envs import ManagerBasedRlEnv
from ksim_rl.export.picture_inputs import PictureInput
from ksim_rl.export.robot import activation_order
from ksim_rl.export.standalone.models import CHOICE, FIELDS
from ksim_rl.scene.sensors import ContactSensor

Arrays = dict[str, np.ndarray]


@dataclass(frozen=True, kw_only=True)
class Kept:
    """The content of a recording, in the order of the export.

    Attributes:
        groups: of observations, which the policy reads as vectors.
        pictures: that it reads.
        joints: by name.
        params: the numbers of motor models, by name.
        order: of actuators, as places in the env's own order.
    """

    groups: Sequence[NestedKey]
    pictures: Sequence[PictureInput]
    joints: Sequence[str]
    params: Sequence[str]
    order: Sequence[int]


class Recording:
    """Episodes of the envs `["E"]`, one in each, with deterministic actions.

    `arrays` replay them: `start/...` [E, ...], `command/...` [E, T + 1, K], which go on after an episode's end, and
    `pushes` [N, 2 + nv] (env, step, change of velocity); with `traces`, `trace/...` [E, steps, ...] too. `figures` hold
    return, length, falls, terms of reward, metrics, mean torques and shares of contact of each episode.
    """

    def __init__(
        self,
        env: EnvBase,
        ours: ManagerBasedRlEnv,
        actor: TensorDictModuleBase,
        kept: Kept,
        *,
        steps: int,
        seed: int,
        traces: int = 0,
    ) -> None:
        self._ours = ours
        self._pushes = []
        self._now = 0
        self._joints = list(kept.joints)
        every = list(ours.view.joints().names)
        self._columns = [every.index(name) for name in kept.joints]
        # From MuJoCo's order of joints to the export's.
        sensors = ours.cfg.scene.sensors.items()
        self._sensors = [name for name, sensor in sensors if isinstance(sensor, ContactSensor)]
        self._seen: dict[str, list[np.ndarray]] = {}
        self._sums: dict[str, Tensor] = {}
        self._running_E = torch.ones(ours.num_envs, dtype=torch.bool, device=ours.device)
        # False once an env's first episode has ended: later ones are not recorded.
        run_events = ours.event_manager.step
        # Pushes are events: the velocity before and after them is the only trace that they leave.
        ours.event_manager.step = lambda: self._watch(run_events)  # type: ignore[method-assign]
        try:
            env.set_seed(seed)
            # Seeded before the reset, which draws the starts.
            current = env.reset()
            self.arrays = self._start(kept.order, kept.params)
            # The command at the first frame; one more is kept after each step, T + 1 in all.
            self._keep("command", ours.command_manager.values)
            with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
                for self._now in range(steps):
                    # State and observation before the step, from which the replay starts this step by itself.
                    if traces:
                        self._keep("trace", {"obs": _vectors(current, kept.groups)})
                        self._keep("trace", _pictures(current, kept.pictures))
                        self._keep("trace", self._state(kept.order))
                    stepped = env.step(actor(current.copy()))
                    # Figures before the reset, which clears the sums of episodes.
                    self._add(stepped["next", "done"][:, 0])
                    if traces:
                        self._keep("trace", self._reached(stepped))
                    current = env.maybe_reset(step_mdp(stepped, keep_other=True))
                    self._keep("command", ours.command_manager.values)
                    # Only the traced envs have to be complete, where there are any.
                    if not self._running_E[: traces or None].any():
                        break
        finally:
            # Also after an error: the env goes on to live without us.
            ours.event_manager.step = run_events  # type: ignore[method-assign]
        # One array [E, T, ...] for each signal.
        self.arrays |= {name: np.stack(values, 1) for name, values in self._seen.items()}
        width = 2 + ours.world.qvel_EL.shape[1]
        self.arrays["pushes"] = np.array(self._pushes, np.float32).reshape(-1, width)
        # All envs ran, the first `traces` of them are kept.
        if traces:
            self.arrays = {
                name: value[value[:, 0] < traces] if name == "pushes" else value[:traces]
                for name, value in self.arrays.items()
            }

    @property
    def figures(self) -> list[dict[str, float]]:
        """The figures of each episode."""
        columns = [sum_E.tolist() for sum_E in self._sums.values()]
        episodes = []
        for row in zip(*columns, strict=True):
            episodes.append(dict(zip(self._sums, row, strict=True)))
        return episodes

    def _watch(self, run_events: Callable[[], None]) -> None:
        before_EL = self._ours.world.qvel_EL.clone()
        run_events()
        change_EL = (self._ours.world.qvel_EL - before_EL).cpu().numpy()
        # Exactly zero where nothing pushed: the event leaves other worlds untouched.
        for row in np.flatnonzero(np.abs(change_EL).max(-1) > 0):
            self._pushes.append(np.concatenate(([row, self._now], change_EL[row])))

    def _keep(self, kind: str, values: Mapping[str, Tensor]) -> None:
        for name, value in values.items():
            # Bytes of pictures stay bytes.
            if value.dtype != torch.uint8:
                value = value.float()
            # Copied, since the env writes the next step into the same memory.
            self._seen.setdefault(f"{kind}/{name}", []).append(value.detach().cpu().numpy().copy())

    def _state(self, order: Sequence[int]) -> dict[str, Tensor]:
        """Return the state that a step begins from, actuators in `order`."""
        world = self._ours.world
        found = {"qpos": world.qpos_EL, "qvel": world.qvel_EL}
        # Actuators with dynamics keep a state; the model of the export has them in another order.
        if world.mj_model.na:
            found["act"] = world.act_EL[:, activation_order(world.mj_model, order)]
        return found

    def _start(self, order: Sequence[int], params: Sequence[str]) -> Arrays:
        view = self._ours.view
        world = self._ours.world
        found = self._state(order) | {"ctrl": world.ctrl_EL[:, list(order)]}
        # Bodies that are moved by hand, such as targets.
        if world.mj_model.nmocap:
            found |= {name: world.view(name) for name in ("mocap_pos", "mocap_quat")}
        by_joint = {"encoder_bias": view.encoder_bias_EL, "default_pos": view.default_joint_pos_EL}
        # 1e30 for infinity, as in export.json: the runner refuses numbers that are not finite.
        by_joint |= {
            f"actuator/{name}": view.actuator_param(name).clamp(max=1e30) for name in params
        }
        found |= {name: value[:, self._columns] for name, value in by_joint.items()}
        for name, value in world.per_world_fields().items():
            if name not in (*FIELDS, CHOICE, "gravity"):
                continue  # that which only pictures show
            if name.startswith("actuator_"):
                # Fields of actuators follow the order that robot.xml gives them.
                value = value[:, list(order)]
            found["gravity" if name == "gravity" else f"model/{name}"] = value
        return {
            f"start/{name}": value.detach().cpu().numpy().copy() for name, value in found.items()
        }

    def _reached(self, stepped: Any) -> dict[str, Tensor]:
        view = self._ours.view
        targets = (view.joint_pos_target_EL, view.joint_vel_target_EL, view.joint_effort_target_EL)
        return {
            "action": stepped["action"],
            "done": stepped["next", "done"],
            # Position, velocity, effort, as in the runner's `KINDS`.
            "target": torch.cat([target[:, self._columns] for target in targets], -1),
            "effort": view.joints().effort_EL[:, self._columns],
            "next_qpos": self._ours.world.qpos_EL,
            "next_qvel": self._ours.world.qvel_EL,
            **{f"found_{name}": view.contact(name).found_EN for name in self._sensors},
        }

    def _add(self, done_E: Tensor) -> None:
        view = self._ours.view
        metrics = self._ours.metric_manager
        # Steps of the running episode so far; also the divisor of means below.
        step_E = view.episode_step_E.float()
        now = {f"reward/{name}": value_E for name, value_E in view.episode_rewards.items()}
        # The return of all terms, traced or not, as training reports it.
        now["return"] = sum(now.values(), torch.zeros_like(step_E))
        now |= {"length": step_E, "fell": view.terminated_E.float()}
        now |= dict(
            zip(
                (f"metric/{name}" for name in metrics.names),
                metrics.reduced_EM.unbind(-1),
                strict=True,
            )
        )
        effort_EL = view.joints(self._joints).effort_EL.abs()
        mean = dict(
            zip((f"torque/{name}" for name in self._joints), effort_EL.unbind(-1), strict=True)
        )
        for name in self._sensors:
            found = view.contact(name).found_EN.unbind(-1)
            mean |= {f"contact/{name}/{k}": found_E for k, found_E in enumerate(found)}
        # Running means over the steps of the episode, updated by each step's share.
        for name, value_E in mean.items():
            before_E = self._sums.get(name, torch.zeros_like(value_E))
            now[name] = before_E + (value_E - before_E) / step_E
        # An episode that has ended keeps its figures.
        for name, value_E in now.items():
            kept_E = self._sums.get(name, value_E)
            self._sums[name] = torch.where(self._running_E, value_E, kept_E).clone()
        self._running_E = self._running_E & ~done_E


def _vectors(current: TensorDictBase, groups: Sequence[NestedKey]) -> Tensor:
    """Return the numbers that a policy reads, concatenated [E, L]."""
    vectors = [current[group] for group in groups]
    if not vectors:
        return torch.zeros(*current.batch_size, 0)
    return torch.cat(vectors, -1)


def _pictures(current: TensorDictBase, pictures: Sequence[PictureInput]) -> dict[str, Tensor]:
    """Return the picture of the moment of each camera, and the one that the policy reads where it is another."""
    found = {}
    for picture in pictures:
        found[f"camera_{picture.group}"] = current["obs", picture.term]
        read = current[picture.group]
        if picture.is_late:
            found[picture.name] = read[:, -1] if picture.is_stacked else read
    return found
