"""The motion that a viewer's robot follows, or that is played without a policy: its clips, and when in one it is."""

from dataclasses import dataclass

from ksim_rl.checks import check_in_range, near
from ksim_rl.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg
from ksim_rl.mdp.motion_tracking import ResetByChoice
from ksim_rl.scene.motions.motion import ReferenceMotion
from ksim_rl.scene.motions.motion_set import set_of
from ksim_rl.scene.state.motion_clock import motion_clip, motion_time
from ksim_rl.tracking.starts import StartInMotion
from ksim_rl.tracking.trials import followed_motion, starting_by_choice


@dataclass(frozen=True, kw_only=True)
class ShownMotion:
    """The motion in which episodes of an env begin by choice.

    Attributes:
        env: the env.
        start: its event that begins them there.
    """

    env: ManagerBasedRlEnv
    start: ResetByChoice

    @property
    def motion(self) -> ReferenceMotion:
        """The motion itself, with all its clips."""
        return self.env.view.motion(self.start.file)

    def clip(self, env_index: int) -> int:
        """Return the number of the clip that an env follows."""
        clip_E = motion_clip(self.env.view, self.start.file)
        return 0 if clip_E is None else int(clip_E[env_index])

    def time_s(self, env_index: int) -> float:
        """Return when in its clip an env is, s; at the end its last frame stays."""
        time_s = float(motion_time(self.env.view, self.start.file)[env_index])
        return min(time_s, float(self.motion.duration_C[self.clip(env_index)]))

    def choose(self, clip: int, time_s: float) -> None:
        """Let all envs begin there when they are reset next; a ValueError for a clip or a time that is none."""
        names = self.motion.names
        if not 0 <= clip < len(names):
            raise ValueError(f"clip {clip}: expected 0 to {len(names) - 1}")
        check_in_range("time_s", time_s, low=0.0)
        self.start.choose(self.env.view, clip, time_s)


def shown_motion(env: ManagerBasedRlEnv) -> ShownMotion | None:
    """Return the motion in which an env's episodes begin by choice; None if they begin otherwise."""
    for event in (env.cfg.events or {}).values():
        if isinstance(event, ResetByChoice):
            return ShownMotion(env=env, start=event)
    return None


def with_choice(cfg: ManagerBasedRlEnvCfg) -> ManagerBasedRlEnvCfg:
    """Return the config of a task that follows one motion with its clips to be chosen, and any other as it is."""
    events = (cfg.events or {}).values()
    files = {event.file for event in events if isinstance(event, StartInMotion)}
    is_chosen = any(isinstance(event, ResetByChoice) for event in events)
    # Of several motions at the same time no one can be chosen.
    if len(files) != 1 or is_chosen:
        return cfg
    return starting_by_choice(cfg)


def following(cfg: ManagerBasedRlEnvCfg, clip: str) -> ManagerBasedRlEnvCfg:
    """Return the config of a tracking task whose episodes begin with a clip; a ValueError if its motion has no such."""
    file = followed_motion(cfg)
    names = tuple(set_of(cfg.scene.motions, file).files())
    if clip not in names:
        raise ValueError(
            f"--motion {clip}: the task follows {file}, which has no clip of that name: {near(clip, names)}"
        )
    return starting_by_choice(cfg, clip=clip)


def place_of(cfg: ManagerBasedRlEnvCfg, name: str) -> tuple[str, str]:
    """Return the motion that a name means in a task, and which of its clips: a set's, a clip of one, or a file."""
    sets = cfg.scene.motions
    if name in sets:
        return name, ""
    for file, chosen in sets.items():
        if name in chosen.files():
            return file, name
    return name, ""
