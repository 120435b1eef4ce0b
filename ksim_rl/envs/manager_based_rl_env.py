"""The env: a TorchRL `EnvBase` over Warp-batched MuJoCo, made of terms."""

import dataclasses
import secrets
from collections.abc import Collection, Mapping
from contextlib import AbstractContextManager
from typing import Any, ClassVar

import mujoco
import mujoco_warp
import numpy as np
import torch
import warp
from jaxtyping import Bool, Float, Int64
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from ksim_rl import dims
from ksim_rl.device.state_tree import State, copy_into
from ksim_rl.device.streams import checked_device
from ksim_rl.envs.closed import Closed
from ksim_rl.envs.contract import (
    DifficultyLevels,
    EpisodeClock,
    EpisodeSums,
    Pictures,
    SimulatedWorld,
)
from ksim_rl.envs.drawing import Drawing, draw, drawings
from ksim_rl.envs.driver import EnvDriver
from ksim_rl.envs.explain import WIDTH, explain
from ksim_rl.envs.manager_based_rl_env_cfg import ManagerBasedRlEnvCfg
from ksim_rl.envs.managers import saved_state
from ksim_rl.envs.managers.action_manager import ActionManager
from ksim_rl.envs.managers.command_manager import CommandManager
from ksim_rl.envs.managers.event_manager import EventManager
from ksim_rl.envs.managers.observation_manager import ObservationManager
from ksim_rl.envs.managers.outcomes import (
    CurriculumManager,
    EpisodeLog,
    MetricManager,
    RewardManager,
    TerminationManager,
)
from ksim_rl.envs.managers.rehearsal import rehearse
from ksim_rl.envs.masked_reset import MaskedReset
from ksim_rl.envs.reset_to_default import ResetToDefault
from ksim_rl.envs.specs import make_specs
from ksim_rl.envs.step_counts import episode_steps
from ksim_rl.physics import World
from ksim_rl.scene.actuators import JointDrives
from ksim_rl.scene.rendering.rendering import OffscreenRenderer
from ksim_rl.scene.rendering.visualizer import DebugVisualizer
from ksim_rl.scene.scene import load_scene, warp_alone

RENDER_MODES = (None, "rgb_array")


class ManagerBasedRlEnv(
    MaskedReset, EpisodeClock, EpisodeSums, DifficultyLevels, SimulatedWorld, Pictures
):
    """E parallel worlds that emit EnvStates `["E"]`; a ValueError names the field of `cfg` that is wrong.

    Keys of a root: `("obs", term)` and `("command", name)`, float32 [E, L]; `"action"`, float32 [E, L]; and under
    `"next"` the same obs and command of the state reached, `"reward"` float32 and `"done"`, `"terminated"`,
    `"truncated"` bool, [E, 1] each. `next` holds the true observation of the state reached, also where the episode
    ended there. A world whose physics is not finite, or whose action is not, ends with `terminated` and reward 0; its
    `next` observation shows the model's default state, since the state reached does not exist.
    """

    is_vector_env = True
    metadata: ClassVar[dict[str, Any]] = {
        "mujoco_version": mujoco.__version__,
        "warp_version": warp.__version__,
        "mujoco_warp_version": mujoco_warp.__version__,
        "render_modes": list(RENDER_MODES),
    }

    def __init__(
        self,
        cfg: ManagerBasedRlEnvCfg,
        device: str | torch.device = "cpu",
        render_mode: str | None = None,
    ) -> None:
        if render_mode not in RENDER_MODES:
            raise ValueError(f"render_mode={render_mode!r}: expected one of {RENDER_MODES}")
        super().__init__(device=checked_device(device), batch_size=torch.Size([cfg.scene.num_envs]))
        self.cfg = cfg
        self.render_mode = render_mode
        events = {"reset": ResetToDefault()} if cfg.events is None else dict(cfg.events)
        fields = [field for term in events.values() for field in term.per_world_fields]
        if cfg.scene.terrain is not None:
            fields += cfg.scene.terrain.per_world_fields
        model = load_scene(cfg.scene, cfg.sim, per_world_fields=fields)
        self._renderer = (
            OffscreenRenderer(model, cfg.viewer, spacing=cfg.scene.spacing) if render_mode else None
        )
        self._is_closed = False
        self.world = World(
            model,
            num_envs=cfg.scene.num_envs,
            device=device,
            sim=cfg.sim,
            per_world_fields=tuple(dict.fromkeys(fields)),
            warp_alone=warp_alone(cfg.scene),
        )
        self.driver = EnvDriver(
            self.world,
            step_dt=self.step_dt,
            max_episode_length=self.max_episode_length,
            soft_joint_pos_limit_factor=cfg.scene.soft_joint_pos_limit_factor,
            entities=tuple(cfg.scene.entities),
            motions=cfg.scene.motions,
        )
        self.world.refresh()  # managers read derived quantities
        self._events_cfg: Mapping[str, Any] = events
        self.view = self.driver.view
        self.load_managers()
        self.view.check_motions()
        self.driver.freeze()  # no buffer may be made in a captured step
        observed = self.observation_manager.examples
        readings = {"obs": observed, "command": self.command_manager.values}
        actions = self.action_manager
        observation, action, reward, done = make_specs(
            readings,
            actions.size,
            actions.bounds_L2,
            batch_size=self.batch_size,
            device=self.device,
        )
        self.observation_spec = observation
        self.full_action_spec = action
        self.full_reward_spec = reward
        self.full_done_spec = done
        self.seed(-1 if cfg.seed is None else cfg.seed)
        rehearse(
            self.driver,
            laws=self.joint_drives,
            writing=(
                self.event_manager,
                self.curriculum_manager,
                self.command_manager,
                self.action_manager,
            ),
            reading=(
                self.observation_manager,
                self.reward_manager,
                self.termination_manager,
                self.metric_manager,
            ),
        )

    # -- parts ---------------------------------------------------------------------------------------------------

    def load_managers(self) -> None:
        """Build the managers: events and commands, then actions and observations, then the rest.

        Each term runs once here, so that names that match nothing are errors before the first step.
        """
        cfg = self.cfg
        driver = self.driver
        view = self.view
        if cfg.scene.terrain is not None:
            driver.ground = cfg.scene.terrain.ground(view)  # events and sensors read it
        driver.add_sensors(cfg.scene.sensors)
        actuators = {
            view.entity(name).prefix: getattr(robot, "actuators", ())
            for name, robot in cfg.scene.entities.items()
        }
        self.joint_drives = JointDrives(actuators, driver, view)
        self.event_manager = EventManager(self._events_cfg, driver)
        driver.refreshed()
        self.command_manager = CommandManager(cfg.commands, driver)
        self.event_manager.rehearse_starts()
        self.action_manager = ActionManager(cfg.actions, driver)
        self.observation_manager = ObservationManager(cfg.observations, driver)
        scale = self.step_dt if cfg.scale_rewards_by_dt else 1.0
        self.reward_manager = RewardManager(
            cfg.rewards, driver, scale=scale, curriculum=cfg.curriculum
        )
        self.termination_manager = TerminationManager(
            cfg.terminations,
            driver,
            is_finite_horizon=cfg.is_finite_horizon,
            curriculum=cfg.curriculum,
        )
        self.metric_manager = MetricManager(cfg.metrics, driver)
        self.curriculum_manager = CurriculumManager(cfg.curriculum, driver)
        self._log = EpisodeLog(
            driver, self.reward_manager, self.termination_manager, self.metric_manager
        )

    @property
    def unwrapped(self) -> "ManagerBasedRlEnv":
        """This env, without any wrapper."""
        return self

    @property
    def num_envs(self) -> int:
        """E."""
        return self.cfg.scene.num_envs

    @property
    def physics_dt(self) -> float:
        """Seconds of one physics substep."""
        return float(self.world.mj_model.opt.timestep)

    @property
    def step_dt(self) -> float:
        """Seconds of one env step."""
        return self.physics_dt * self.cfg.decimation

    @property
    def max_episode_length_s(self) -> float:
        """Seconds after which an episode is cut; 0 for never."""
        return self.cfg.episode_length_s

    @property
    def max_episode_length(self) -> int:
        """Env steps after which an episode is cut; 0 for never."""
        return episode_steps(self.cfg, self.step_dt)

    @property
    def episode_step_E(self) -> Int64[Tensor, " E"]:
        """Env steps since each episode's start, int64 [E]."""
        return self.view.episode_step_E

    def watching_terms(self) -> AbstractContextManager[None]:
        """Return a context in which a ValueError names each term that writes memory other than its own.

        While an env is built and while its step is compiled or captured, this is always so. It takes much time.
        """
        return self.driver.guard.watching()

    # -- step and reset ------------------------------------------------------------------------------------------

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        driver = self.driver
        world = self.world
        action_EL = self.action_manager.checked(tensordict.get("action"))
        # Else a graph would read quantities of the step before, which no replay computes again.
        driver.forget()
        driver.step_count.add_(1)
        self.event_manager.step()
        finite_E = self.action_manager.apply(action_EL)  # [E], False ends the row's episode

        world.step(
            self.cfg.decimation,
            before=driver.before_substep,
            after=driver.after_substep,
            sensors=driver.substep_sensors,
        )
        driver.keep_moment_of_contacts()
        # Also false for NaN. Beyond this bound MuJoCo's C engine, too, calls a state bad and resets it.
        size_E = (world.qpos_EL.sum(-1) + world.qvel_EL.sum(-1)).abs()
        finite_E = finite_E & (size_E < mujoco.mjMAXVAL)
        # Failed worlds are cleared before anything is computed from them, so that all of it is finite.
        world.reset(~finite_E)
        world.refresh()
        driver.refreshed()

        driver.episode_step_E.add_(1)
        driver.update_sensors()  # after resets of failed worlds, before terms read
        terminated_E, truncated_E = self.termination_manager.step(finite_E)
        done_E = terminated_E | truncated_E
        reward_E = self.reward_manager.step(finite_E)  # may read terminations
        self.metric_manager.step(finite_E)
        self._log.step(done_E)  # the sums of this step included
        # Last, so that rewards and terminations see the command that the policy saw.
        self.command_manager.step(~done_E)
        return self._env_state(
            reward=reward_E[:, None],
            done=done_E[:, None],
            terminated=terminated_E[:, None],
            truncated=truncated_E[:, None],
        )

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        driver = self.driver
        if tensordict is not None and "_reset" in tensordict.keys():
            mask_E = tensordict.get("_reset").view(self.num_envs)
        else:
            mask_E = torch.ones(self.num_envs, dtype=torch.bool, device=self.device)
        driver.forget()
        driver.reset_count_E.add_(mask_E)  # keys the draws of this reset, row by row
        # Curricula first: they judge the episode that ended, and what they change holds for the next one.
        self.curriculum_manager.reset(mask_E)
        self.world.reset(mask_E)
        self.view.restore_default(mask_E)
        driver.buffers.clear(mask_E)  # memory of terms, except buffers with `keep`
        self.view.targets.reset(mask_E)
        self.joint_drives.reset(mask_E)  # draws the lags of the new episode
        driver.episode_step_E.masked_fill_(mask_E, 0)
        driver.changed()
        # Events write the state; poses and sensors derived from it are refreshed once, after all of them.
        self.event_manager.reset(mask_E)
        self.view.default_state.follow_pose(mask_E)
        self.command_manager.resample(mask_E)  # clocks and targets of the new episode
        self.world.refresh(mask_E)
        driver.refreshed()
        self.command_manager.refresh(mask_E)  # vectors need refreshed poses
        self.event_manager.start(mask_E)  # may read commands, and refreshes what it writes
        no_E1 = torch.zeros(self.num_envs, 1, dtype=torch.bool, device=self.device)
        flags = {"done": no_E1, "terminated": no_E1.clone(), "truncated": no_E1.clone()}
        return self._env_state(reset_E=mask_E, **flags)

    def _env_state(self, *, reset_E: Tensor | None = None, **leaves: Tensor) -> TensorDict:
        data: dict[str, Any] = {"obs": self.observation_manager.read(reset_E)}
        commands = self.command_manager.values
        if commands:
            data["command"] = {name: value.clone() for name, value in commands.items()}
        return TensorDict(
            data | leaves, batch_size=self.batch_size, device=self.device, names=[dims.E]
        )

    # -- seeds ---------------------------------------------------------------------------------------------------

    def _set_seed(self, seed: int | None) -> None:
        """Seed all draws and redo the startup events. The levels of curricula stay."""
        if seed is None:
            seed = secrets.randbelow(2**31)
        self.cfg = dataclasses.replace(self.cfg, seed=seed)
        self.driver.seed_(seed)
        self.event_manager.startup()  # its draws depend on the seed

    def stagger_episodes_(self) -> None:
        """Let the running episodes time out at random steps; later episodes have their full length.

        Without it envs that start together also end together, and each rollout shows one phase of an episode only.
        """
        self.driver.stagger_episodes()

    # -- for trainers --------------------------------------------------------------------------------------------

    def episode_log(self) -> dict[str, Float[Tensor, ""]]:
        """Return sums over the episodes that ended since `episode_log_reset_`; see `EpisodeLog`."""
        return self._log.read()

    def episode_log_reset_(self) -> None:
        """Start the sums of `episode_log` again at 0."""
        self._log.clear()

    def values_by_term(self) -> dict[str, Float[Tensor, " E"] | Bool[Tensor, " E"]]:
        """Return reward sums, metrics and termination flags of the running episodes, [E] each, written in place."""
        return self._log.running()

    def non_finite_terms(self) -> list[str]:
        """Return a line for each term that gave a number that is not finite; reads the device."""
        return self.driver.non_finite.lines()

    def curriculum_levels(self) -> dict[str, Float[Tensor, ""]]:
        """Return the latest level of each curriculum."""
        return self.curriculum_manager.levels()

    def command_levels(self) -> dict[str, Float[Tensor, ""]]:
        """Return the ranges that commands are drawn from now; they change by curricula, and without any there are none.

        Keys: `<command>/<field>_low` and `<command>/<field>_high`.
        """
        if not self.cfg.curriculum:
            return {}
        return self.command_manager.levels()

    def state_dict(self, *args: Any, **kwargs: Any) -> State:
        """Return all that the env needs to continue bit-exactly: physics, clocks, commands, counters, buffers."""
        return saved_state.joined(self._buffers_to_save(), self.world.state_dict())

    def load_state_dict(self, state_dict: State, strict: bool = True, assign: bool = False) -> None:
        """Continue from a `state_dict`; a ValueError says how the state of another env differs.

        Without `strict`, entries that are missing stay as they are, and unknown ones are left out.
        """
        own = self._buffers_to_save()
        of_env, of_world = saved_state.parts(state_dict)
        if not strict:
            of_env = saved_state.completed(of_env, own)
            of_world = saved_state.completed(of_world, self.world.state_dict())
        copy_into(own, of_env, what="state of an env (of the same config and num_envs)")
        self.world.load_state_dict(of_world)
        self.driver.refreshed()  # cached quantities are of the old state
        self.cfg = dataclasses.replace(self.cfg, seed=int(self.view.seed))

    def _buffers_to_save(self) -> dict[str, Tensor]:
        return saved_state.buffers_to_save(
            self.driver, self.reward_manager, self.curriculum_manager, self._log
        )

    def explain(self, *, width: int = WIDTH) -> str:
        """Return the parts of the env as tables, one per manager, with index, name, shape, weight, mode, parameters."""
        spec = self.observation_spec
        return explain(
            self.cfg,
            self.driver,
            shapes={name: spec["obs", name].shape for name in self.observation_manager.terms},
            action_sizes=self.action_manager.sizes,
            events=self.event_manager.terms,
            levels={name: float(level) for name, level in self.curriculum_levels().items()},
            width=width,
        )

    # -- pictures and the end ------------------------------------------------------------------------------------

    def setup_manager_visualizers(self) -> dict[str, Drawing]:
        """Return the commands, rewards and sensors that draw themselves and that `viewer.draw` names, by name."""
        return drawings(self.cfg, self.view.sensors, self.reward_manager.names)

    def update_visualizers(
        self,
        visualizer: DebugVisualizer,
        env_index: int | None = None,
        *,
        drawn: Collection[str] | None = None,
    ) -> None:
        """Let each part of `setup_manager_visualizers`, or only the ones named in `drawn`, draw one env.

        It is the one that the viewer shows, unless `env_index` says otherwise.
        """
        shown = self.cfg.viewer.env_index if env_index is None else env_index
        parts = self.setup_manager_visualizers()
        draw(self.driver, parts, visualizer, env_index=shown, drawn=drawn)

    def render(self) -> np.ndarray | None:
        """Return a picture of the current state, None without a render mode; a RuntimeError tells how to get OpenGL."""
        if self._renderer is None:
            return None
        return self._renderer.render(self.world, draw=self.update_visualizers)

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Free the worlds' memory; a RuntimeError if the env is closed already and `raise_if_closed`."""
        if self._is_closed:
            if raise_if_closed:
                raise RuntimeError("the env is closed already")
            return
        self._is_closed = True
        self.is_closed = True
        if self._renderer is not None:
            self._renderer.close()
        self.world.close()
        managers = [name for name in vars(self) if name.endswith("_manager")]
        for name in ("world", "driver", "view", "_log", "_renderer", *managers):
            setattr(self, name, Closed())

    def __reduce_ex__(self, protocol: Any) -> Any:
        raise TypeError(
            "an env holds worlds on a device, and is neither copied nor pickled: make a second one with "
            "ksim_rl.envs.build(env.cfg, device=env.device), and load_state_dict(env.state_dict()) to go on there"
        )
