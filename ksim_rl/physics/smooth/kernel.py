"""This module makes the kernels of a substep before and after its constraints: smooth dynamics and integration.

MuJoCo Warp launches some 35 kernels for the first and some 10 for the second, each of which waits for its slowest
world; here some lanes of a warp own a world, with its bodies or its inertia matrix on the chip. They are written in
C++, as the solver's kernel is; the CPU compiles the same source, for one lane. Read their parts in the order in which
SMOOTH and INTEGRATION name them.

Source of the algorithms: https://mujoco.readthedocs.io/en/stable/computation/index.html
"""

# Kernels are Python only in their spelling: wp.tid() gives as many indices as it is asked for.
# pyright: reportAssignmentType=false, reportGeneralTypeIssues=false, reportInvalidTypeForm=false

import dataclasses
import functools
from importlib.resources import files

import mujoco
import mujoco_warp as mjw
import warp as wp

from ksim_rl.physics.structs import struct_with

CUDA_THREADS = 32
SMOOTH = ("world", "layout", "kinematics", "inertia", "velocities", "passive", "actuation")
INTEGRATION = ("world", "derivative", "factorization", "free_bodies", "advance")
_ENUMS = {
    "FREE": mujoco.mjtJoint.mjJNT_FREE,
    "BALL": mujoco.mjtJoint.mjJNT_BALL,
    "SLIDE": mujoco.mjtJoint.mjJNT_SLIDE,
    "HINGE": mujoco.mjtJoint.mjJNT_HINGE,
    "JOINT": mujoco.mjtTrn.mjTRN_JOINT,
    "JOINT_IN_PARENT": mujoco.mjtTrn.mjTRN_JOINTINPARENT,
    "INTEGRATOR": mujoco.mjtDyn.mjDYN_INTEGRATOR,
    "FILTER": mujoco.mjtDyn.mjDYN_FILTER,
    "FILTER_EXACT": mujoco.mjtDyn.mjDYN_FILTEREXACT,
    "AFFINE_GAIN": mujoco.mjtGain.mjGAIN_AFFINE,
    "AFFINE_BIAS": mujoco.mjtBias.mjBIAS_AFFINE,
    "OUT_OF_ROWS": mjw.OverflowType.NEFC,
    "OUT_OF_PAIRS": mjw.OverflowType.BROADPHASE,
    "OUT_OF_CONTACTS": mjw.OverflowType.NARROWPHASE,
}


@struct_with(
    (
        "",
        mjw.Model,
        "qpos0 qpos_spring M_hinit_i M_colind M_rownnz M_rowadr body_freeadr "
        "body_rootid body_mocapid body_jntnum body_jntadr body_dofadr body_subtreenum body_branches "
        "body_branch_start body_pos body_quat body_ipos body_iquat body_mass body_subtreemass body_inertia "
        "jnt_type jnt_qposadr jnt_dofadr jnt_bodyid jnt_pos jnt_axis jnt_actuatorid jnt_stiffness jnt_stiffnesspoly "
        "jnt_actfrclimited jnt_actfrcrange dof_bodyid dof_jntid dof_armature dof_damping dof_dampingpoly "
        "geom_bodyid geom_pos geom_quat site_bodyid site_pos site_quat "
        "actuator_trntype actuator_trnid actuator_gear actuator_armature actuator_damping actuator_dampingpoly "
        "actuator_dyntype actuator_gaintype actuator_biastype actuator_dynprm actuator_gainprm actuator_biasprm "
        "actuator_ctrladr actuator_ctrlnum actuator_ctrllimited actuator_ctrlrange actuator_actadr actuator_actnum "
        "actuator_actlimited actuator_actrange actuator_actearly actuator_forcelimited actuator_forcerange",
    ),
    ("", mjw.Option, "gravity timestep"),
    (
        "",
        mjw.Data,
        "qpos qvel act ctrl mocap_pos mocap_quat qfrc_applied xfrc_applied "
        "xpos xquat xmat xipos ximat xanchor xaxis geom_xpos geom_xmat site_xpos site_xmat subtree_com cdof cinert "
        "cvel cdof_dot cacc cfrc_int crb M qfrc_bias qfrc_spring qfrc_damper qfrc_passive "
        "actuator_length actuator_velocity moment_rownnz moment_rowadr moment_colind actuator_moment act_dot "
        "actuator_force qfrc_actuator qfrc_smooth "
        "qacc qacc_warmstart time overflow nefc ncollision nacon njmax naconmax",
    ),
    ("efc_", mjw.Constraint, "Ma"),
)
class Problem:
    """What the kernels read of a model and its worlds, and what they write.

    Besides, the geoms that move, by `first_driver` the actuators that drive each degree of freedom, and of the degrees
    of freedom those that are eliminated, in that order, and of these the leaves.
    """

    moving_geoms: wp.array[int]
    first_driver: wp.array[int]
    drivers: wp.array[int]
    eliminated: wp.array[int]
    leaves: wp.array[int]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Shape:
    """What of a model is compiled into its kernels: its sizes, and what it has of MuJoCo's features."""

    parents: tuple[int, ...]
    num_joints: int
    num_dofs: int
    num_chains: int
    num_moving_geoms: int
    num_sites: int
    num_actuators: int
    has_mocap: bool
    has_activation: bool
    gravity: bool
    springs: bool
    dampers: bool
    clamps_ctrl: bool
    actuators_act: bool
    num_entries: int
    num_free_bodies: int
    implicit_fast: bool
    solves: bool

    @property
    def num_bodies(self) -> int:
        """Bodies, with the world."""
        return len(self.parents)

    @property
    def poses(self) -> int:
        """Floats of the poses, then inertias, then sums of forces."""
        return max(10 * self.num_bodies, self.num_actuators + self.num_dofs)

    @property
    def joints(self) -> int:
        """Floats of the joints' frames, then of the bodies' velocities, then of momenta."""
        return 6 * max(self.num_bodies, self.num_joints, self.num_dofs)

    def floats(self, lanes: int, parts: tuple[str, ...] = SMOOTH) -> int:
        """Return how many floats the lanes of a world share."""
        needed = self.poses + self.joints + 9 * self.num_bodies + 6 * self.num_dofs
        if parts == INTEGRATION:
            needed = self.num_entries + 2 * self.num_dofs
        # Worlds of a warp begin in other banks: those of one lie side by side for its lanes.
        return needed + (lanes - needed) % 32


@functools.cache
def kernel_of(parts: tuple[str, ...], shape: Shape, lanes: int, threads: int) -> wp.Kernel:
    """Return the kernel of a `Problem` that has these parts; launch it over (worlds, lanes) in blocks of `threads`.

    The other argument of SMOOTH says whether it goes on after the velocities, to the inertia matrix and the forces.
    """
    constants = {field.name: getattr(shape, field.name) for field in dataclasses.fields(shape)[1:]}
    constants |= {"num_bodies": shape.num_bodies, "poses": shape.poses, "joints": shape.joints}
    constants |= {"floats": shape.floats(lanes, parts), "lanes": lanes, "threads": threads, **_ENUMS}
    parents = ", ".join(map(str, shape.parents))
    snippet = "".join(f"constexpr int {name.upper()} = {int(value)};\n" for name, value in constants.items())
    snippet += f"constexpr int PARENTS[] = {{{parents}}};\n"
    snippet += "".join(files("ksim_rl.physics.smooth").joinpath(f"{part}.cpp").read_text() for part in parts)

    @wp.func_native(snippet)
    def compute(world: int, lane: int, forces_too: bool, problem: Problem) -> None: ...

    @wp.kernel(
        module="unique", enable_backward=False, grid_stride=False, module_options={"block_dim": threads}
    )
    def kernel(problem: Problem, forces_too: bool):
        world, lane = wp.tid()
        compute(world, lane, forces_too, problem)

    return kernel
