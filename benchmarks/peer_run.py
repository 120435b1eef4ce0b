"""Records a run of mjlab's velocity task; it runs in mjlab's own environment, and uses nothing of ours.

    PEER/bin/python -c "$(cat benchmarks/peer_run.py)" TASK NUM_ENVS STEPS OUTPUT.npz

Kept are the states before each physics step, and what rewards, terminations and observations made of them. Contacts and
foot heights are read at the moment that they are of: mjlab itself casts the heights one env step earlier, and reads
contacts for observations after its next forward pass in the steps in which any env resets.
"""

# pyright: basic, reportMissingImports=false

import sys
from typing import Any

import mjlab.tasks  # noqa: F401 (registers them)
import mujoco
import numpy as np
import torch
import warp as wp
from mjlab.envs import ManagerBasedRlEnv
from mjlab.tasks.registry import load_env_cfg
from mjlab.tasks.velocity import mdp

FIELDS = ("geom_friction", "body_ipos")
CONTACTS = {"foot_contact": mdp.foot_contact, "foot_contact_forces": mdp.foot_contact_forces}
FEET = "feet_ground_contact"


def main() -> None:
    """Run random actions, and write what they led to."""
    task, num_envs, steps, output = sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), sys.argv[4]
    cfg = load_env_cfg(task)
    cfg.scene.num_envs = num_envs
    cfg.seed = 1
    # Both solve to the end, so that what differs is a term and not a solver's last digits.
    cfg.sim.mujoco.iterations, cfg.sim.mujoco.ls_iterations = 100, 50
    # Terms that are switched off in training are compared as well.
    for term in cfg.rewards.values():
        term.weight = term.weight or 1.0
    env = ManagerBasedRlEnv(cfg, device="cpu")
    kept: dict[str, list[np.ndarray]] = {}

    def keep(name: str, value: Any) -> None:
        # A copy: mjlab writes the next step into the same memory.
        kept.setdefault(name, []).append(torch.as_tensor(value).cpu().numpy().copy())

    data, advance, rate = env.sim.wp_data, env.sim.step, env.reward_manager.compute

    def step() -> None:
        for name in ("qpos", "qvel", "ctrl", "qacc_warmstart"):
            keep(f"substep/{name}", wp.to_torch(getattr(data, name)).clone())
        advance()

    def compute(dt: float) -> torch.Tensor:
        keep("command", env.command_manager.get_command("twist"))
        for name in ("qpos", "qvel"):
            keep(f"rated/{name}", wp.to_torch(getattr(data, name)).clone())
        env.sim.sense()
        for sensor in env.scene.sensors.values():
            sensor._invalidate_cache()
        for name, contact in CONTACTS.items():
            keep(f"obs/{name}", contact(env, FEET))
        total = rate(dt)
        for name, term, value in zip(
            env.reward_manager.active_terms,
            env.reward_manager._term_cfgs,
            env.reward_manager._step_reward.T,
            strict=True,
        ):
            keep(f"reward/{name}", value / term.weight)
        for name, flags in env.termination_manager._term_dones.items():
            keep(f"end/{name}", flags)
        # Before a reset clears them.
        clocks = env.scene[FEET]._air_time_state
        for name in (
            "current_air_time",
            "last_air_time",
            "current_contact_time",
            "last_contact_time",
        ):
            keep(f"clock/{name}", getattr(clocks, name))
        return total

    env.sim.step, env.reward_manager.compute = step, compute
    env.reset()
    torch.manual_seed(2)
    action = torch.zeros(num_envs, env.action_manager.total_action_dim)
    terms = {f"critic/{name}": term for name, term in _terms(env, "critic")}
    terms |= {f"actor/{name}": term for name, term in _terms(env, "actor")}
    for _ in range(steps):
        # A slow random walk: robots step, stumble and fall.
        action = 0.9 * action + 0.6 * torch.randn_like(action)
        keep("action", action)
        _, _, terminated, truncated, _ = env.step(action)
        keep("reset", terminated | truncated)
        for name in ("qpos", "qvel"):
            keep(f"reached/{name}", wp.to_torch(getattr(data, name)).clone())
        for sensor in env.scene.sensors.values():
            sensor._invalidate_cache()
        for name, term in terms.items():
            if name.rpartition("/")[2] not in CONTACTS:
                keep(f"obs/{name}", term.func(env, **term.params))
        twist = env.command_manager.get_term("twist")
        keep("drawn/velocity", twist.vel_command_b)
        keep("drawn/heading", twist.heading_target)
        keep("drawn/standing", twist.is_standing_env)
        keep("drawn/heads", twist.is_heading_env)
    found = {name: np.stack(values) for name, values in kept.items()}
    found["encoder_bias"] = env.scene["robot"].data.encoder_bias.numpy()
    for name in FIELDS:
        found[f"field/{name}"] = getattr(env.sim.model, name)[:].cpu().numpy()
    found |= _names(env.sim.mj_model)
    np.savez_compressed(output, **found)  # pyright: ignore[reportArgumentType]


def _terms(env: ManagerBasedRlEnv, group: str) -> Any:
    manager = env.observation_manager
    return zip(
        manager._group_obs_term_names[group], manager._group_obs_term_cfgs[group], strict=True
    )


def _names(model: mujoco.MjModel) -> dict[str, np.ndarray]:
    """Return the names of joints, actuated joints, geoms and bodies in the model's order, without a prefix."""

    def plain(names: list[str]) -> np.ndarray:
        return np.array([name.removeprefix("robot/") for name in names])

    return {
        "names/joint": plain([model.joint(i).name for i in range(model.njnt)]),
        "names/actuator": plain(
            [model.joint(int(model.actuator_trnid[i, 0])).name for i in range(model.nu)]
        ),
        "names/geom": plain([model.geom(i).name for i in range(model.ngeom)]),
        "names/body": plain([model.body(i).name for i in range(model.nbody)]),
    }


if __name__ == "__main__":
    main()
