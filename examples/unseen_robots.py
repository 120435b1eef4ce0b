"""A1 and OP3 follow a velocity command: for an unprepared robot of the menagerie, a task is one line."""

from ksim_rl.envs.tasks import velocity

A1 = velocity.VelocityTask.for_robot("unitree_a1/a1", name="a1_velocity_flat")
OP3 = velocity.VelocityTask.for_robot("robotis_op3/op3", name="op3_velocity_flat")
