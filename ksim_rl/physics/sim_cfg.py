"""Settings of solver and integrator that override a model's."""

import dataclasses
from typing import Literal

import mujoco

from ksim_rl.checked import Checked, Count, Positive
from ksim_rl.physics.nan_guard.guard import NanGuardCfg


@dataclasses.dataclass(frozen=True, kw_only=True)
class SimCfg(Checked):
    """Simulation settings. `None` keeps the model's own value.

    Args:
        timestep: of one physics step, in s.
        integrator: one of "euler", "rk4", "implicit", "implicitfast", "discrete".
        solver: "newton" or "cg".
        cone: friction cones, "pyramidal" or "elliptic".
        impratio: ratio of frictional to normal constraint impedance.
        tolerance: at which the constraint solver stops. MuJoCo Warp raises the model's own to 1e-6 at least, since its
            numbers are float32; a value given here is taken as it is.
        iterations: most iterations of the constraint solver.
        ls_iterations: most iterations of its line search.
        ccd_iterations: most iterations of convex collision detection.
        njmax: most constraint rows of one world; `None` probes the model, and a run raises it where its env needs more.
        nconmax: contacts (and candidate pairs) per world. They share one pool of `num_envs * nconmax`; `None` as above.
            Both are the room of MuJoCo Warp: the C engine takes as much memory as it needs.
        engine: "warp" simulates on MuJoCo Warp, with our kernels, on GPU or CPU. "c" simulates on MuJoCo's C engine, on
            all cores of the CPU, in float64: it judges the first, compiles nothing at the first start, and has no
            limits of contacts and rows. Cameras that see all worlds need "warp". "auto" chooses, and `World.explained`
            says why: "warp" on GPUs, and wherever something is asked for that it alone can do; on the CPU by the sizes
            of `engine_choice`, from which on "c" was measured to be faster. A run names the engine that was chosen.
        one_kernel_solver: solve the constraints of a substep in one kernel instead of some hundred. It is MuJoCo Warp's
            algorithm, so that results agree up to rounding (four substeps of 4096 worlds on an H200: Go1 2.4 ms instead
            of 8.2, G1 5.0 instead of 9.9). Models out of its range (solvers other than Newton, integrators "rk4" and
            "discrete", more than 64 degrees of freedom, more than 700 to 1700 constraint rows, flexes, sleeping,
            energies, noslip, no warm start, a dense Jacobian) take MuJoCo Warp's own; `World.one_kernel_unavailable`
            says why.
        one_kernel_dynamics: with the one-kernel solver, compute all that constraints have no part in (kinematics,
            inertias, bias, passive and actuator forces) in one kernel instead of some 35, make the constraint rows in
            another instead of ten, in the C engine's order, and integrate in a third instead of some 10 (but for
            integrator "implicit"). Results agree up to rounding. Models out of its range (tendons, fluids, gravity
            compensation, muscles, delayed actuators, transmissions other than to hinges and slides; for rows, bodies
            that are tied) take MuJoCo Warp's own; `World.one_kernel_dynamics_unavailable` and
            `one_kernel_rows_unavailable` say why. `None` does so on GPUs; on the CPU it gains a tenth of the physics,
            and compiles for 12 s. Either value asks for engine "warp".
        require_graphs: refuse to run where graphs are unavailable, instead of a warning and a slow run.
        nan_guard: where to save the substeps that led to a non-finite state; `None` keeps nothing and costs nothing.

    See https://mujoco.readthedocs.io/en/stable/XMLreference.html#option
    """

    timestep: Positive | None = None
    integrator: Literal["euler", "rk4", "implicit", "implicitfast", "discrete"] | None = None
    solver: Literal["cg", "newton"] | None = None
    cone: Literal["pyramidal", "elliptic"] | None = None
    impratio: Positive | None = None
    tolerance: Positive | None = None
    iterations: Count | None = None
    ls_iterations: Count | None = None
    ccd_iterations: Count | None = None
    njmax: Count | None = None
    nconmax: Count | None = None
    engine: Literal["auto", "warp", "c"] = "auto"
    one_kernel_solver: bool = True
    one_kernel_dynamics: bool | None = None
    require_graphs: bool = False
    nan_guard: NanGuardCfg | None = None

    def apply_to(self, target: mujoco.MjSpec | mujoco.MjModel) -> None:
        """Write the settings that are not `None` into the options of a spec or a model, in place."""
        if isinstance(target, mujoco.MjSpec):
            option = target.option
        else:
            option = target.opt
        for field in (
            "timestep",
            "impratio",
            "tolerance",
            "iterations",
            "ls_iterations",
            "ccd_iterations",
        ):
            value = getattr(self, field)
            if value is not None:
                setattr(option, field, value)
        for field, kind, prefix in (
            ("integrator", mujoco.mjtIntegrator, "mjINT"),
            ("solver", mujoco.mjtSolver, "mjSOL"),
            ("cone", mujoco.mjtCone, "mjCONE"),
        ):
            value = getattr(self, field)
            if value is not None:
                setattr(option, field, int(kind.__members__[f"{prefix}_{value.upper()}"]))
