"""A session steps an env at the pace of the clock, under an agent, and takes requests from those who watch."""

import dataclasses
import queue
import time
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from ksim_rl import mdp
from ksim_rl.checks import check_in_range
from ksim_rl.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg
from ksim_rl.envs.contract import part
from ksim_rl.mdp.motion_tracking import with_motions_in_use
from ksim_rl.transforms import ActionDelay, ObservationDelay, ObservationNoise
from ksim_rl.viewer.driven_agent import DrivenAgent
from ksim_rl.viewer.shown_motion import ShownMotion, shown_motion

AGENTS = ("zero", "random")
Agent = Callable[[TensorDictBase], TensorDictBase]
SPEEDS = (0.125, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
# Requests that may wait: more than a user clicks between two steps. They are not taken while no page is open.
MOST_REQUESTS = 256
# Longer gaps in which nothing was stepped, such as a rebuilt env, are not made up for.
MOST_LAG_S = 0.1


@dataclass(frozen=True, kw_only=True)
class Conditions:
    """The disturbances of a policy: each can be switched off. Curricula are always off, as in evaluations.

    `randomization` are events that run at startup or write the model's fields, `pushes` those that run at intervals.
    """

    noise: bool = True
    delay: bool = True
    randomization: bool = True
    pushes: bool = True

    def apply(self, cfg: ManagerBasedRlEnvCfg) -> ManagerBasedRlEnvCfg:
        """Return the config of an env without the disturbances that are switched off."""
        replace = dataclasses.replace
        groups = {}
        # Noise and delay sit in the groups of observations, or in transforms of the env.
        for name, group in cfg.observations.items():
            noise = group.enable_noise and self.noise
            groups[name] = replace(group, enable_noise=noise)
            if not self.delay:
                terms = {key: replace(term, delay=None) for key, term in group.terms.items()}
                groups[name] = replace(groups[name], delay=None, terms=terms)
        # Transforms of the user's own stay, whatever they do.
        dropped = () if self.noise else (ObservationNoise,)
        dropped += () if self.delay else (ObservationDelay, ActionDelay)
        kept = [
            name for name, own in cfg.transforms.items() if not issubclass(own.transform, dropped)
        ]
        transforms = {name: cfg.transforms[name] for name in kept}
        # None stands for a task without events.
        events = cfg.events
        if events is not None:
            events = {
                name: event
                for name, event in events.items()
                if (self.pushes or event.mode != "interval")
                and (self.randomization or not (event.per_world_fields or event.mode == "startup"))
            }
        return replace(
            cfg, observations=groups, transforms=transforms, events=events, curriculum={}
        )


def showing_motion(cfg: ManagerBasedRlEnvCfg, file: str, *, clip: str = "") -> ManagerBasedRlEnvCfg:
    """Return the config of an env that plays a reference motion, whatever acts: each step is an episode of its own.

    Of several clips `clip` comes first, if it is given.
    Each root is the motion's exact state; physics runs in between, and its states are thrown away.
    """
    shown = dataclasses.replace(
        cfg,
        events={"motion": mdp.ShowMotion(file=file, clip=clip)},
        terminations={"next_frame": mdp.TimeOut()},
        # Shorter than any env step; an episode has at least one.
        episode_length_s=1e-6,
        rewards={},
        metrics={},
        curriculum={},
    )
    return with_motions_in_use(shown)


class UntrainedAgent(TensorDictModuleBase):
    """Writes "action" into the roots of an env: zeros, or draws of the action spec (normal where it has no bounds)."""

    def __init__(self, kind: str, env: EnvBase) -> None:
        super().__init__()
        # The specs of the env know the shape, the device and the bounds of actions.
        self._draw = {"zero": env.action_spec.zero, "random": env.action_spec.rand}[kind]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action."""
        return tensordict.set("action", self._draw())


class Session:
    """Steps an env under an agent; all that touches the env runs in the thread that calls `advance`.

    Other threads ask with `ask(function)`, which then runs between two steps. An error of the agent, the env or such a
    request pauses the session and stands in `error`, with its traceback in `trace`, until it plays again. The methods
    from `play` to `change` are such requests.

    Attributes:
        make_env: builds the env for given conditions; called again when these change.
        agent: writes "action" into a root of the env; it acts deterministically.
        env_index: the env that is shown, pushed and plotted.
        rewards: the weighted reward terms of that env in the last step.
        note: a remark beside the figures, such as how old the policy is.
        refused: how many requests found no room.
        listener: is called with each step `["E"]`, its "next" included, and whether all envs were reset before it.
    """

    def __init__(
        self,
        make_env: Callable[[Conditions], EnvBase],
        make_agent: Callable[[EnvBase], Agent],
        *,
        title: str = "",
        seed: int = 0,
    ) -> None:
        self.title = title
        self.seed = seed
        self.note = ""
        self._make_env = make_env
        self._make_agent = make_agent
        # Set from the viewer's thread through `ask`, and read between two steps.
        self.conditions = Conditions()
        self.playing = True
        self.speed = 1.0
        self.env_index = 0
        self.error = ""
        self.trace = ""
        self.steps = 0
        self.built = 0  # how many envs there have been
        self.rewards: dict[str, float] = {}
        self.episode_return = 0.0
        self.achieved_speed = 0.0
        self.listener: Callable[[TensorDictBase, bool], None] | None = None
        self._is_new = True  # no step since all envs were reset
        self._steered: dict[str, dict[str, float]] = {}
        self._driven: dict[int, float] = {}
        self._sought: tuple[int, float] | None = None
        self._requests: queue.Queue[Callable[[], None]] = queue.Queue(MOST_REQUESTS)
        self.refused = 0
        # Clock and pace: the time of the last `advance`, steps that are due, and points of (s, steps).
        self._last: float | None = None
        self._due = 0.0
        self._paces: list[tuple[float, int]] = []
        self._build()

    @property
    def ours(self) -> ManagerBasedRlEnv:
        """The env inside of all transforms."""
        found = part(self.env, ManagerBasedRlEnv)
        if found is None:
            raise ValueError(
                f"{type(self.env).__name__}: the viewer shows envs of this package only"
            )
        return found

    @property
    def root_E(self) -> TensorDictBase:
        """What the agent sees at the next step, `["E"]`."""
        return self._root_E

    @property
    def observations(self) -> Mapping[str, Float[Tensor, " ?L"]]:
        """The clean reading of each observation term that is a vector, of the shown env."""
        # The root of the next step: the policy's present input. Images are left out.
        terms = self._root_E.get("obs")
        vectors = {}
        for key, value in terms.items():
            if value.ndim == 2:
                vectors[key] = value[self.env_index]
        return vectors

    @property
    def commands(self) -> Mapping[str, Float[Tensor, " ?L"]]:
        """The present command vectors of the shown env."""
        return {
            name: value_EK[self.env_index]
            for name, value_EK in self.ours.command_manager.values.items()
        }

    def ask(self, request: Callable[[], None]) -> None:
        """Let `request` run between two steps, if fewer than `MOST_REQUESTS` wait; from any thread."""
        # Never wait: the thread of a browser's connection must go on.
        try:
            self._requests.put_nowait(request)
        except queue.Full:
            self.refused += 1

    def play(self, playing: bool = True) -> None:
        """Go on, or pause; an error is forgotten."""
        self.playing = playing
        self.error = ""
        self.trace = ""
        # The pause must not count as time that has to be made up for.
        self._last = None

    def toggle(self) -> None:
        """Pause an env that plays, and let one go on that is paused."""
        self.play(not self.playing)

    def step_once(self) -> None:
        """Pause, and do a single env step."""
        self.play(False)
        self._step()

    def reset(self) -> None:
        """Start new episodes in all envs."""
        with torch.no_grad():
            self._root_E = self.env.reset()
        self._is_new = True
        # Figures begin again with the episode.
        self.episode_return = 0.0
        self.rewards = {}

    def choose(self, env_index: int) -> None:
        """Show another env; a ValueError if there is none of this number."""
        if not 0 <= env_index < self.ours.num_envs:
            raise ValueError(f"env {env_index}: expected 0 to {self.ours.num_envs - 1}")
        self.env_index = env_index
        self.episode_return = 0.0
        self.rewards = {}

    @property
    def motion(self) -> ShownMotion | None:
        """The motion that robots follow, if its clips and times can be chosen."""
        return shown_motion(self.ours)

    def seek(self, clip: int, time_s: float) -> None:
        """Let all envs begin at a time, s, of a clip of the motion, now and with each later episode.

        A ValueError if there is no such clip or time, or no motion to choose in.
        """
        motion = self.motion
        if motion is None:
            raise ValueError("this env follows no motion: there is no clip to choose")
        motion.choose(clip, time_s)
        # Kept, so that a rebuilt env is at the same place.
        self._sought = (clip, time_s)
        self.reset()

    def push(self, speed: float, direction: float | None = None) -> None:
        """Add a horizontal velocity (m/s) in a direction (rad, world frame; None draws one) to the shown env's robot.

        A robot that stands on a fixed base gets its first joint pushed instead, in rad/s or m/s. Raises ValueError for
        a speed or direction that is not finite.
        """
        # Values come from a browser: NaN would spoil the state of the world, and stay in it.
        check_in_range("speed", speed)
        if direction is not None:
            check_in_range("direction", direction)
        ours = self.ours
        if direction is None:
            angle = torch.rand(()) * 2.0 * torch.pi
        else:
            angle = torch.tensor(direction)
        robot = ours.view.entity("")
        # A free root has velocities of the world first: x, y and z in m/s.
        if robot.free_root:
            first = robot.root_qvel.start
            kick = speed * torch.stack((torch.cos(angle), torch.sin(angle)))
            ours.world.qvel_EL[self.env_index, first : first + 2] += kick.to(ours.world.qvel_EL)
        else:
            # The direction chooses the sign only.
            ours.world.qvel_EL[self.env_index, 0] += speed * float(torch.sign(torch.cos(angle)))
        # The driver caches what depends on the state: it learns of the change before and after the
        # recomputation.
        ours.driver.changed()
        ours.world.refresh()
        ours.driver.refreshed()

    def steer(self, command: str, values: Mapping[str, float] | None) -> None:
        """Hold the fields of a drawn command at these values in all envs; None lets it be drawn again.

        Fields are the keys of the term's `ranges`, in its units: both ends of a range become the value. Draws that are
        the term's own, such as which envs stand still, then fall on the last choice, which is none.
        """
        ours = self.ours
        term = ours.cfg.commands[command]
        driver = ours.driver
        # [2, N]: the lower ends, then the upper ends, by field.
        own = torch.tensor(list(term.ranges.values()), dtype=torch.float32).T
        # In the term's own scope, where its draws and buffers are found.
        with driver.scope(f"commands/{command}", draws="step"):
            shared_2N = term.shared_ranges(ours.view)
            # Ranges as configured, then shares in [0, 1] of the term's own draws.
            shared_2N[:, : own.shape[1]] = own.to(shared_2N)
            shared_2N[:, own.shape[1] :] = torch.tensor([[0.0], [1.0]]).to(shared_2N)
            if values is not None:
                # Empty ranges: every draw gives the upper end, which for the term's own draws means no kind.
                shared_2N[0] = shared_2N[1]
                for column, field in enumerate(term.ranges):
                    shared_2N[:, column] = values[field]
            everybody_E = torch.ones(ours.num_envs, dtype=torch.bool, device=shared_2N.device)
            # Without waiting for the next time that the command is drawn.
            term.resample(ours.view, everybody_E)
        ours.command_manager.refresh(everybody_E)
        if values is None:
            self._steered.pop(command, None)
        else:
            # Kept, so that a rebuilt env is steered as this one is.
            self._steered[command] = dict(values)

    @property
    def driver(self) -> DrivenAgent | None:
        """The agent whose actions a person drives; None where others act."""
        if isinstance(self.agent, DrivenAgent):
            return self.agent
        return None

    def drive(self, values: Mapping[int, float]) -> None:
        """Hold columns of the action at values; an error where a policy acts."""
        if self.driver is None:
            raise ValueError('a policy acts: only the agent "hand" takes actions of a person')
        # Kept, so that a rebuilt env is driven as this one is.
        self._driven.update(values)
        self.driver.drive(values)

    def change(self, conditions: Conditions) -> None:
        """Build the env again under other conditions, and start new episodes in it."""
        self.conditions = conditions
        # Worlds are freed first: two envs at a time might not fit into the memory.
        self.env.close(raise_if_closed=False)
        self._build()

    def rest(self) -> None:
        """Let the time that passes until the next `advance` not count."""
        self._last = None

    def advance(self, after_step: Callable[[], None] = lambda: None) -> bool:
        """Run the waiting requests, then the steps that are due by now; return whether anything changed."""
        changed = False
        # Requests first, so that they act on the steps of this call.
        while not self._requests.empty():
            self._guarded(self._requests.get_nowait())
            changed = True
        now = time.monotonic()
        # After a pause time begins here.
        if self._last is None or not self.playing:
            self._last = now
            self._due = 0.0
            self._paces = [(now, self.steps)]
        # Steps that are due: real seconds times the speed, over the length of a step.
        self._due += min(now - self._last, MOST_LAG_S) * self.speed / self.ours.step_dt
        self._last = now
        # No display is kept waiting for long by steps that take longer than they last.
        while self.playing and self._due >= 1.0 and time.monotonic() - now < MOST_LAG_S:
            self._due -= 1.0
            changed = True
            self._guarded(self._step)
            after_step()
        # Steps that came too late are dropped, not made up for later.
        self._due = min(self._due, 1.0)
        # The pace over the last 61 calls is shown beside the speed that was asked for.
        self._paces = [*self._paces[-60:], (now, self.steps)]
        (start, first) = self._paces[0]
        (end, last) = self._paces[-1]
        if end > start:
            self.achieved_speed = (last - first) * self.ours.step_dt / (end - start)
        else:
            self.achieved_speed = 0.0
        return changed

    def close(self) -> None:
        """Free the env's worlds."""
        self.env.close(raise_if_closed=False)

    def _guarded(self, action: Callable[[], None]) -> None:
        try:
            action()
        except Exception as error:  # whatever a policy, a term or a config of the user's raises
            self.playing = False
            self.error = f"{type(error).__name__}: {error}"
            self.trace = "".join(traceback.format_exception(error))

    def _build(self) -> None:
        self.env = self._make_env(self.conditions)
        # The new env may have fewer rows.
        self.env_index = min(self.env_index, self.ours.num_envs - 1)
        self.agent = self._make_agent(self.env)
        if self.driver is not None:
            self.driver.drive(self._driven)
        self.built += 1
        # The same seed, so that two conditions are compared on the same starts.
        self.env.set_seed(self.seed)
        if self._sought is None:
            self.reset()
        else:
            self.seek(*self._sought)
        for command, values in self._steered.copy().items():
            self.steer(command, values)

    def _step(self) -> None:
        sums_ER = self.ours.reward_manager.episode_sums_ER
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            # Weighted terms are read as the growth of their sums, which all episodes keep anyway.
            before_R = sums_ER[self.env_index].clone()
            stepped_E = self.env.step(self.agent(self._root_E))
            # Sums of episodes that ended are cleared by the reset, so they are read before.
            rewards_R = (sums_ER[self.env_index] - before_R).tolist()
            next_E = stepped_E.get("next")
            # One transfer from the device per step of a viewer is no loss.
            reward, done = (float(next_E.get(key)[self.env_index]) for key in ("reward", "done"))
            if self.listener is not None:
                self.listener(stepped_E, self._is_new)
            self._is_new = False
            self._root_E = self.env.maybe_reset(self.env.step_mdp(stepped_E))
        self.rewards = dict(zip(self.ours.reward_manager.names, rewards_R, strict=True))
        if done:
            self.episode_return = 0.0
        else:
            self.episode_return = self.episode_return + reward
        self.steps += 1
