"""The debug build of the one-kernel solver: it finds no broken invariant, and names one that is broken."""

import numpy as np
import pytest
import warp as wp

from benchmarks.judge.faults import Rewrite
from ksim_rl.device import headers
from ksim_rl.physics import World, substep
from ksim_rl.physics.integration.integrators import integrator
from ksim_rl.physics.newton import solver as newton
from ksim_rl.physics.newton.kernel import Invariant
from tests.docs.guide import REPOSITORY
from tests.physics.rows_of_all_kinds import NUM_ENVS, ONE_OF_CONES, worlds

NEWTON = REPOSITORY / "ksim_rl" / "physics" / "newton"


def broken_invariants(world: World, substeps: int) -> Invariant:
    with wp.ScopedDevice("cpu"):
        model, data = world.warp_model, world.warp_data_E
        broken = wp.zeros(NUM_ENVS, dtype=int)
        solve = newton.solver(model, data, broken=broken)
        integrate = integrator(world.mj_model, model, data)
        stages = substep.Stages(solve=solve, integrate=integrate)
        for _ in range(substeps):
            substep.run(stages, model, data, sensors=False)
    return Invariant(int(np.bitwise_or.reduce(broken.numpy())))


@pytest.mark.parametrize("cone", ONE_OF_CONES)
def test_a_debug_build_finds_no_broken_invariant(cone):
    assert not broken_invariants(worlds(cone), 20)


WRONG_LINES = {
    "ROWS_ARE_WHOLE": (
        "s.efc_D[row] = s.row_of(s.a.efc_D)",
        "s.efc_D[row] = -s.row_of(s.a.efc_D)",
    ),
    "CONES_ARE_WHOLE": ("friction[0] * s.impratio", "-friction[0] * s.impratio"),
    "FORCES_ARE_ADMISSIBLE": (
        "push = -s.efc_D[row] * s.residual[row]",
        "push = s.efc_D[row] * s.residual[row]",
    ),
    "HESSIAN_IS_POSITIVE": ("s.hessian[block][dof] = s.mass[", "s.hessian[block][dof] = -s.mass["),
    "SEARCH_DESCENDS": (
        "s.search[block] *= -s.inverse_pivot",
        "s.search[block] *= s.inverse_pivot",
    ),
    "COST_FALLS": ("step = Step {alpha, -point", "step = Step {alpha, point"),
}


@pytest.mark.parametrize(
    "invariant",
    [
        name
        if name in ("ROWS_ARE_WHOLE", "COST_FALLS")
        else pytest.param(name, marks=pytest.mark.full)
        for name in WRONG_LINES
    ],
)
def test_a_debug_build_names_the_invariant_that_is_broken(monkeypatch, invariant):
    right, wrong = WRONG_LINES[invariant]
    text = "".join(path.read_text() for path in NEWTON.glob("*.cuh"))
    assert text.count(right) == 1
    rewritten = Rewrite(lines={right: wrong})(headers.text_of)
    monkeypatch.setattr(headers, "text_of", rewritten)
    assert Invariant[invariant] in broken_invariants(worlds("elliptic"), 1)
