"""Says which kernels compute each stage of a substep, ours or MuJoCo Warp's, and why."""

import dataclasses
from collections.abc import Sequence

import mujoco_warp as mjw

from ksim_rl.physics.collision.collisions import broad_phase_unavailable, pairs_left
from ksim_rl.physics.rows.constraint_rows import one_kernel_rows_unavailable
from ksim_rl.physics.sim_cfg import SimCfg
from ksim_rl.physics.smooth import stages


@dataclasses.dataclass(frozen=True, kw_only=True)
class SubstepPlan:
    """Why MuJoCo Warp's own kernels compute a stage of a substep, or None where one kernel of ours does.

    Attributes:
        dynamics: all before the constraints: kinematics, inertias, smooth forces.
        broad_phase: which pairs of geoms may touch.
        collisions: the same and the contacts of those pairs; MuJoCo Warp may find some of them.
        rows: the constraint rows.
        solver: the accelerations that the constraints leave.
        integration: the state at the end of the substep.
        callbacks: the names of MuJoCo Warp's callbacks that a program has set.
    """

    dynamics: str | None
    broad_phase: str | None
    collisions: str | None
    rows: str | None
    solver: str | None
    integration: str | None
    callbacks: tuple[str, ...] = ()

    def lines(self) -> tuple[str, ...]:
        """Return a line for each stage, in the order in which a substep runs them, and one for callbacks."""
        found = (
            f"what precedes constraints is computed by {_whose(self.dynamics)}",
            f"contacts are found by {_whose(self.collisions)}",
            f"constraint rows are made by {_whose(self.rows)}",
            f"constraints are solved by {_whose(self.solver, 'solver')}",
            f"the state is advanced by {_whose(self.integration)}",
        )
        if not self.callbacks:
            return found
        return (
            *found,
            f"callbacks of the program run in each substep: {', '.join(self.callbacks)}",
        )


def _whose(unavailable: str | None, theirs: str = "kernels") -> str:
    if unavailable is None:
        return "one kernel"
    return f"MuJoCo Warp's own {theirs}, because {unavailable}"


def substep_plan(
    warp_model: mjw.Model, warp_data_E: mjw.Data, sim: SimCfg, *, solver_unavailable: str | None
) -> SubstepPlan:
    """Return the plan of a world whose model and data are in their final place, without callbacks of a program."""
    # Each stage needs the one before: the reasons follow from each other.
    dynamics = stages.one_kernel_dynamics_unavailable(
        warp_model, sim, solver_unavailable=solver_unavailable
    )
    rows = one_kernel_rows_unavailable(warp_model, dynamics_unavailable=dynamics)
    broad_phase = broad_phase_unavailable(warp_model, warp_data_E, rows_unavailable=rows)
    return SubstepPlan(
        dynamics=dynamics,
        broad_phase=broad_phase,
        # Contacts may be found by both: our broad phase, and MuJoCo Warp's narrow phase for some types.
        collisions=broad_phase or pairs_left(warp_model),
        rows=rows,
        solver=solver_unavailable,
        integration=stages.one_kernel_integration_unavailable(
            warp_model, dynamics_unavailable=dynamics
        ),
    )


def with_callbacks(plan: SubstepPlan, names: Sequence[str]) -> SubstepPlan:
    """Return the plan of a substep in which callbacks of these names run, which a program has set.

    One that has a part in the forces stands between the stages of our kernel of the dynamics. Then MuJoCo Warp computes
    these, and the contacts and rows that follow from them.
    """
    # Other callbacks, such as of sensors, run between the same launches.
    forces = [name for name in names if name in stages.FORCE_CALLBACKS]
    if not forces:
        return dataclasses.replace(plan, callbacks=tuple(names))
    reason = f"a program has set callbacks ({', '.join(forces)})"
    return dataclasses.replace(
        plan,
        dynamics=plan.dynamics or reason,
        broad_phase=plan.broad_phase or reason,
        collisions=plan.broad_phase or reason,
        rows=plan.rows or reason,
        callbacks=tuple(names),
    )
