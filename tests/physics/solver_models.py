"""Models for the constraint solver, states in which they touch, and what accelerations cost there, in float64."""

from dataclasses import dataclass

import mujoco
import mujoco_warp as mjw
import numpy as np
import torch
import warp as wp

from ksim_rl.physics import SimCfg, World, capacity
from ksim_rl.physics.newton import solver as newton

_TIES = {
    "joint": '<joint joint1="b0_0" joint2="b0_1" polycoef="0.1 0.5 0 0 0"/>',
    "connect": '<connect body1="b0_0" body2="b0_1" anchor="0.05 0 0"/>',
    "weld": '<weld body1="b0" body2="b1"/>',
}


@dataclass(frozen=True)
class Synthetic:
    """Balls on a plane, each with a chain of links; `ratio` is the mass of a ball to that of a link."""

    condim: int = 3
    cone: str = "pyramidal"
    impratio: float = 1.0
    balls: int = 2
    links: int = 2
    ball_joints: bool = False
    tie: str = ""
    tendon: bool = False
    frictionloss: float = 0.0
    ratio: float = 2.0

    def xml(self) -> str:
        """Return the model; without balls, a block on a slide, the one degree of freedom."""
        bodies = '<body pos="0 0 0.1"><joint type="slide" axis="0 0 1"/><geom size="0.1"/></body>'
        if self.balls:
            bodies = "".join(self._ball(index) for index in range(self.balls))
        tendon = '<fixed name="rope" limited="true" range="-0.1 0.1" frictionloss="0.02"><joint joint="b0_0" coef="1"/>'
        tendon = f"<tendon>{tendon}<joint joint='b0_1' coef='-1'/></fixed></tendon>" if self.tendon else ""
        tie = f"<equality>{_TIES[self.tie]}</equality>" if self.tie else ""
        return f"""
        <mujoco>
          <option timestep="0.004" iterations="100" ls_iterations="50" cone="{self.cone}" impratio="{self.impratio}"/>
          <default><geom condim="{self.condim}" friction="0.8 0.02 0.01"/></default>
          <worldbody><geom type="plane" size="5 5 1" condim="1"/>{bodies}</worldbody>{tendon}{tie}
        </mujoco>"""

    def _ball(self, index: int) -> str:
        links = ""
        for link in reversed(range(self.links)):
            kind = (
                'type="ball"'
                if self.ball_joints
                else f'axis="{link % 2} {(link + 1) % 2} 0" range="-0.6 0.6"'
            )
            limited = "" if self.ball_joints else 'limited="true"'
            links = (
                f'<body name="b{index}_{link}" pos="0.12 0 0"><joint name="b{index}_{link}" {kind} {limited} '
                f'frictionloss="{self.frictionloss}" armature="0.001"/>'
                f'<geom type="capsule" size="0.03" fromto="0.02 0 0 0.1 0 0" mass="{1.0 / self.ratio}"/>{links}</body>'
            )
        place = f"{0.4 * index} 0 0.1"
        return f'<body name="b{index}" pos="{place}"><freejoint/><geom size="0.1" mass="1"/>{links}</body>'


SYNTHETIC = (
    Synthetic(condim=1, balls=0),
    Synthetic(condim=3, balls=0, cone="elliptic"),
    Synthetic(condim=1, links=0),
    Synthetic(condim=3, cone="elliptic", impratio=10.0),
    Synthetic(condim=4, cone="pyramidal", frictionloss=0.05),
    Synthetic(condim=6, cone="elliptic", impratio=100.0, frictionloss=0.05),
    Synthetic(condim=3, ratio=1000.0),
    Synthetic(condim=3, cone="elliptic", ratio=1000.0),
    Synthetic(condim=3, cone="elliptic", ratio=0.001, impratio=100.0),
    Synthetic(condim=4, cone="elliptic", ball_joints=True, frictionloss=0.02),
    Synthetic(condim=6, ball_joints=True, links=3),
    Synthetic(condim=3, tie="joint"),
    Synthetic(condim=4, cone="elliptic", tie="connect", impratio=10.0),
    Synthetic(condim=3, cone="elliptic", tie="weld"),
    Synthetic(condim=6, tie="weld", ratio=1000.0),
    Synthetic(condim=3, tendon=True),
    Synthetic(condim=4, cone="elliptic", tendon=True, tie="joint", frictionloss=0.05, impratio=100.0),
    Synthetic(condim=3, balls=4, links=10),
    Synthetic(condim=3, cone="elliptic", balls=4, links=10, impratio=10.0),
    Synthetic(condim=6, cone="elliptic", balls=5, links=5, frictionloss=0.01, impratio=100.0),
)


def touching(mj_model: mujoco.MjModel, num_envs: int, device: str = "cpu") -> World:
    """Return worlds in which things lie in the ground and move, with rows made, and warm starts of the step before."""
    # The probe of capacities throws things about more wildly than the states below.
    sim = SimCfg(njmax=640) if mj_model.nv > 50 else SimCfg()
    world = World(mj_model, num_envs=num_envs, device=device, sim=sim)
    rng, mj_data = np.random.default_rng(0), mujoco.MjData(mj_model)
    for row, qpos in enumerate(capacity.random_qpos(mj_model, num_envs, rng)):
        mj_data.qpos[:] = 0.7 * mj_model.qpos0 + 0.3 * qpos
        mujoco.mj_normalizeQuat(mj_model, mj_data.qpos)
        capacity.put_in_ground(mj_model, mj_data, depth=0.005 * rng.random())
        world.qpos_EL[row] = torch.from_numpy(mj_data.qpos)
    world.qvel_EL.copy_(torch.from_numpy(0.5 * rng.normal(size=(num_envs, mj_model.nv))))
    world.refresh()
    world.step(3)
    with wp.ScopedDevice(device):
        m, d = world.warp_model, world.warp_data_E
        mjw.fwd_position(m, d, factorize=False)
        mjw.fwd_velocity(m, d)
        mjw.fwd_actuation(m, d)
        mjw.fwd_acceleration(m, d, factorize=True)
    return world


def costs(world: World) -> np.ndarray:
    """Return what each world's `qacc` costs, [E]: 1/2 q' M q - q' qfrc_smooth + s(J q - aref)."""
    m, efc, contact = world.warp_model, world.warp_data_E.efc, world.warp_data_E.contact
    kinds = mujoco.mjtConstraint
    names = "type id D aref frictionloss J_rownnz J_rowadr"
    read = {name: getattr(efc, name).numpy() for name in names.split()}
    columns, values = (array.numpy().reshape(world.num_envs, -1) for array in (efc.J_colind, efc.J))
    friction = contact.friction.numpy().astype(float)
    to_root = float(m.opt.impratio_invsqrt.numpy()[0])
    qacc, smooth = (
        array.numpy().astype(float) for array in (world.warp_data_E.qacc, world.warp_data_E.qfrc_smooth)
    )
    entries, rows, dofs = world.warp_data_E.M.numpy(), m.M_hinit_i.numpy(), m.M_colind.numpy()
    found = np.zeros(world.num_envs)
    for env, count in enumerate(world.warp_data_E.nefc.numpy()):
        mass = np.zeros((m.nv, m.nv))
        mass[rows, dofs] = mass[dofs, rows] = entries[env].ravel()[: len(rows)]
        jacobian = np.zeros((count, m.nv))
        for row in range(count):
            here = slice(read["J_rowadr"][env, row], read["J_rowadr"][env, row] + read["J_rownnz"][env, row])
            jacobian[row, columns[env, here]] = values[env, here]
        kind, number, D, bound = (read[name][env, :count] for name in ("type", "id", "D", "frictionloss"))
        residual = jacobian @ qacc[env] - read["aref"][env, :count]
        quadratic = 0.5 * D * residual**2
        size = np.abs(residual)
        rubs = np.isin(kind, (kinds.mjCNSTR_FRICTION_DOF, kinds.mjCNSTR_FRICTION_TENDON))
        cost = np.where(residual < 0.0, quadratic, 0.0)
        cost = np.where(kind == kinds.mjCNSTR_EQUALITY, quadratic, cost)
        cost = np.where(rubs, np.where(size * D < bound, quadratic, bound * (size - 0.5 * bound / D)), cost)
        cones = kind == kinds.mjCNSTR_CONTACT_ELLIPTIC
        for each in np.unique(number[cones]):
            first, *mates = np.flatnonzero(cones & (number == each))
            mu = friction[each, 0] * to_root
            normal, tangent = (
                mu * residual[first],
                np.linalg.norm(friction[each, : len(mates)] * residual[mates]),
            )
            cost[[first, *mates]] = 0.0
            if mu * normal + tangent <= 0.0:
                cost[[first, *mates]] = quadratic[[first, *mates]]
            elif normal < mu * tangent:
                cost[first] = 0.5 * D[first] / (mu**2 * (1.0 + mu**2)) * (normal - mu * tangent) ** 2
        found[env] = 0.5 * qacc[env] @ mass @ qacc[env] - qacc[env] @ smooth[env] + cost.sum()
    return found


def check_cost(mj_model: mujoco.MjModel, num_envs: int, device: str = "cpu") -> None:
    """Solve from one state by both solvers: ours costs at most as much as MuJoCo Warp's, within the tolerance of both.

    Both stop where a step would lower the cost by less than the tolerance times the trace of M.
    """
    world = touching(mj_model, num_envs, device)
    assert world.has_one_kernel_solver and 0 < world.last_substep("nefc").max() <= world.njmax
    m, d = world.warp_model, world.warp_data_E
    found = []
    with wp.ScopedDevice(device):
        for solve in (lambda: mjw.solve(m, d), newton.solver(m, d)):
            d.qacc.zero_()
            d.efc.force.zero_()
            solve()
            found.append(costs(world))
    theirs, ours = found
    # float32 has no solution for some worlds of the steepest ratios of masses in MuJoCo Warp's solver; ours has one.
    assert np.isfinite(ours).all(), f"worlds {np.flatnonzero(~np.isfinite(ours))}"
    theirs = np.where(np.isfinite(theirs), theirs, np.inf)
    diagonal = m.M_hinit_i.numpy() == m.M_colind.numpy()
    trace = d.M.numpy().reshape(num_envs, -1)[:, : diagonal.size][:, diagonal].sum(-1)
    slack = float(m.opt.tolerance.numpy()[0]) * trace + 1e-7 * np.abs(theirs)
    worst = int(np.argmax(ours - theirs - slack))
    assert ours[worst] <= theirs[worst] + slack[worst], (
        f"world {worst}: {ours[worst]}, MuJoCo Warp {theirs[worst]}"
    )
