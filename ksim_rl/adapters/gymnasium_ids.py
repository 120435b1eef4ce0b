"""Registers the tasks with Gymnasium, which calls this when it is imported: `gymnasium.make("ksim_rl/walker_walk-v0")`.

It imports nothing of the package, since that would make each import of Gymnasium slow; so the names stand here.
"""

import gymnasium

# Those of `envs.names()` without plug-ins, which `tests/adapters/test_gymnasium_ids.py` compares.
_TASKS = """
    arm_push arm_reach cartpole_balance cartpole_balance_pixels cartpole_swingup cheetah_run
    dm_control_acrobot_swingup dm_control_acrobot_swingup_sparse dm_control_ball_in_cup_catch
    dm_control_cartpole_balance
    dm_control_cartpole_balance_sparse dm_control_cartpole_swingup dm_control_cartpole_swingup_sparse
    dm_control_cheetah_run dm_control_finger_spin dm_control_finger_turn_easy
    dm_control_finger_turn_hard dm_control_fish_swim dm_control_hopper_hop dm_control_hopper_stand
    dm_control_humanoid_run dm_control_humanoid_stand dm_control_humanoid_walk
    dm_control_pendulum_swingup dm_control_point_mass_easy dm_control_reacher_easy
    dm_control_reacher_hard dm_control_swimmer_swimmer6 dm_control_walker_run dm_control_walker_stand
    dm_control_walker_walk g1_track_kick g1_track_squat g1_track_turn g1_track_walk g1_velocity_flat
    g1_velocity_rough go1_velocity_flat go1_velocity_rough go2_velocity_flat hopper_hop hopper_stand
    humanoid_get_up humanoid_velocity_flat leap_cube_reorient panda_pick_cube pendulum_swingup
    playground_acrobot_swingup playground_acrobot_swingup_sparse playground_ball_in_cup_catch
    playground_cartpole_balance playground_cartpole_balance_sparse playground_cartpole_swingup
    playground_cartpole_swingup_sparse playground_cheetah_run playground_finger_spin
    playground_finger_turn_easy playground_finger_turn_hard playground_fish_swim playground_hopper_hop
    playground_hopper_stand playground_humanoid_run playground_humanoid_stand playground_humanoid_walk
    playground_pendulum_swingup playground_point_mass_easy playground_reacher_easy
    playground_reacher_hard playground_swimmer_swimmer6 playground_walker_run playground_walker_stand
    playground_walker_walk quadruped_get_up quadruped_velocity_delayed quadruped_velocity_flat reacher
    t1_velocity_flat walker_amp walker_run walker_stand walker_track walker_walk
"""
TASKS = tuple(_TASKS.split())
MODULE = "ksim_rl.adapters.gymnasium"


def register() -> None:
    """Register "<task>-v0" for `gymnasium.make` and `make_vec`, in the namespace that Gymnasium has set: "ksim_rl"."""
    for task in TASKS:
        gymnasium.register(
            f"{task}-v0",
            entry_point=f"{MODULE}:make_task",
            vector_entry_point=f"{MODULE}:make_tasks",
            kwargs={"task": task},
        )
