"""A reference motion is turned here into the observations of an env in which it is played."""

import dataclasses
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torchrl.envs import EnvBase

from ksim_rl.envs.contract import part
from ksim_rl.envs.manager_based_rl_env import ManagerBasedRlEnv
from ksim_rl.envs.registry import build
from ksim_rl.envs.term import EventTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.motion_tracking import OfMotion, one_motion, with_motions_in_use
from ksim_rl.scene.motions.motion import load_motion
from ksim_rl.scene.state.motion_clock import motion_start_time
from ksim_rl.scene.terrains import PlaneTerrain


@dataclass(frozen=True, kw_only=True)
class PlayMotion(OfMotion, EventTerm):
    """Put env e into the state that a motion has after e env steps."""

    def __call__(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        start_E = motion_start_time(view, self.file)
        # Env e starts at frame e: the envs together are the whole motion.
        frame_s_E = torch.arange(view.num_envs, device=view.device) * view.step_dt
        start_E.copy_(torch.where(mask_E, frame_s_E, start_E))
        qpos_EL, qvel_EL = one_motion(view, self.file).sample(start_E)
        view.write_qpos(mask_E, qpos_EL)
        view.write_qvel(mask_E, qvel_EL)


def observe_motion(env: EnvBase, *, group: str, file: str) -> Float[Tensor, "F L"]:
    """Return an observation group along a reference motion, one row per env step, on the env's device.

    Envs of their own, on a plane, are put into the motion's states, and the group's terms and transforms compute as
    they always do; noise is off. Terms that read more than positions and velocities (commands, actions, contacts,
    forces) read their values after a reset. The given env, around a `ManagerBasedRlEnv`, stays as it is; `file` is a
    motion as `view.motion` reads it, at least as long as an env step.
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
    # On the CPU: only its length is needed here.
    duration_s = load_motion(file, base.world.mj_model, torch.device("cpu")).duration_s
    # The least bit more, so that rounding does not cost the last frame.
    frames = 1 + int(duration_s / base.step_dt + 1e-6)
    if frames < 2:
        raise ValueError(
            f"motion {file}: lasts {duration_s:g} s, less than an env step of {base.step_dt:g} s"
        )
    # A terrain would move the motion's states to its origins; a plane keeps them.
    if cfg.scene.terrain is not None:
        ground = PlaneTerrain()
    else:
        ground = None
    # The same terms, in as many envs as there are frames, without anything that acts, ends or rewards.
    played = dataclasses.replace(
        cfg,
        scene=dataclasses.replace(cfg.scene, num_envs=frames, terrain=ground),
        observations={group: cfg.observations[group]},
        events={"play": PlayMotion(file=file)},
        rewards={},
        terminations={},
        curriculum={},
        metrics={},
        # No time-out: a single reset is all that happens.
        episode_length_s=0.0,
        viewer=dataclasses.replace(cfg.viewer, env_index=0),
        # A fixed seed; noise is off in evaluation mode.
        seed=0,
    )
    player = build(with_motions_in_use(played), device=device)
    # Noise of observations is for training only.
    player.eval()
    # A clone outlives the env that is closed next.
    seen_FL = player.reset().get(group).clone()
    player.close(raise_if_closed=False)
    return seen_FL
