"""Reference motions are turned here into the observations of an env in which it is played."""

import dataclasses
from collections.abc import Mapping

import torch
from jaxtyping import Float
from torch import Tensor
from torchrl.envs import EnvBase

from ksim_rl.envs.contract import part
from ksim_rl.envs.manager_based_rl_env import ManagerBasedRlEnv
from ksim_rl.envs.registry import build
from ksim_rl.mdp.motion_tracking import ResetByChoice, with_motions_in_use
from ksim_rl.scene.motions.motion_set import MotionSet, load_set, set_of
from ksim_rl.scene.terrains import PlaneTerrain

MOST_ENVS = 2048
"""That the frames of motions are observed in at a time."""


def observe_motion(
    env: EnvBase, *, group: str, file: str, motions: Mapping[str, MotionSet] | None = None
) -> list[Float[Tensor, "?F L"]]:
    """Return an observation group along each clip of a motion that is not held out, one row per env step.

    Envs of their own, on a plane, are put into the motion's states, and the group's terms and transforms compute as
    they always do; noise is off. Terms that read more than positions and velocities (commands, actions, contacts,
    forces) read their values after a reset. The given env, around a `ManagerBasedRlEnv`, stays as it is, and its device
    has the rows; `file` is a motion as `view.motion` reads it, of the sets of the env or of `motions`, each clip
    at least as long as an env step.
    """
    # Transforms around the env are not the env itself, whose config is needed.
    base = part(env, ManagerBasedRlEnv)
    if base is None:
        raise ValueError(
            f"observe_motion of a {type(env).__name__}: needs a ManagerBasedRlEnv, whose terms it runs"
        )
    cfg = base.cfg
    device = base.device
    assert device is not None
    sets = {**cfg.scene.motions, **(motions or {})}
    # On the CPU: only the lengths of its clips are needed here.
    motion = load_set(set_of(sets, file), base.world.mj_model, torch.device("cpu"))
    clips: list[int] = []
    counts: list[int] = []
    for clip, last in enumerate(motion.last_C.tolist()):
        # As the float32 of `duration_C` it would cost half of all clips their last frame.
        duration_s = last / motion.fps
        # The least bit more, so that rounding does not cost it either.
        frames = 1 + int(duration_s / base.step_dt + 1e-6)
        if frames < 2:
            raise ValueError(
                f"motion {file}: {motion.names[clip]} lasts {duration_s:g} s, less than an env step of "
                f"{base.step_dt:g} s"
            )
        if not motion.held_out[clip]:
            clips.append(clip)
            counts.append(frames)
    # Each frame's clip, and when it is in that.
    count_C = torch.tensor(counts, device=device)
    clip_F = torch.tensor(clips, device=device).repeat_interleave(count_C)
    step_F = torch.cat([torch.arange(count, device=device) for count in counts])
    num_envs = min(len(clip_F), MOST_ENVS)
    # A terrain would move the motion's states to its origins; a plane keeps them.
    if cfg.scene.terrain is not None:
        ground = PlaneTerrain()
    else:
        ground = None
    start = ResetByChoice(file=file)
    # The same terms, an env for each frame, without anything that acts, ends or rewards.
    played = dataclasses.replace(
        cfg,
        scene=dataclasses.replace(cfg.scene, num_envs=num_envs, terrain=ground, motions=sets),
        observations={group: cfg.observations[group]},
        events={"play": start},
        rewards={},
        terminations={},
        curriculum={},
        metrics={},
        # No time-out: resets are all that happens.
        episode_length_s=0.0,
        viewer=dataclasses.replace(cfg.viewer, env_index=0),
        # A fixed seed; noise is off in evaluation mode.
        seed=0,
    )
    player = build(with_motions_in_use(played), device=device)
    # Noise of observations is for training only.
    player.eval()
    playing = part(player, ManagerBasedRlEnv)
    assert playing is not None
    view = playing.view
    seen = []
    for first in range(0, len(clip_F), num_envs):
        # The last round has fewer frames: its other envs show the last one of them.
        place_E = (first + torch.arange(num_envs, device=device)).clamp(max=len(clip_F) - 1)
        start.chosen_clip(view).copy_(clip_F[place_E])
        start.chosen_time(view).copy_(step_F[place_E] * base.step_dt)
        # A clone outlives the next reset, and the env.
        seen.append(player.reset().get(group).clone())
    player.close(raise_if_closed=False)
    return list(torch.cat(seen)[: len(clip_F)].split(counts))
