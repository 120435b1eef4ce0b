"""Models for the constraint solver, states in which they touch, and how the costs of two solvers compare there."""

from dataclasses import dataclass

import mujoco
import mujoco_warp as mjw
import numpy as np
import torch
import warp as wp

from ksim_rl.physics import SimCfg, World, poses
from ksim_rl.physics.newton import solver as newton
from tests.physics.solver_problem import problems

_TIES = {
    "joint": '<joint joint1="b0_0" joint2="b0_1" polycoef="0.1 0.5 0 0 0"/>',
    "connect": '<connect body1="b0_0" body2="b0_1" anchor="0.05 0 0"/>',
    "weld": '<weld body1="b0" body2="b1"/>',
}


@dataclass(frozen=True)
class Synthetic:
    """Balls on a plane, each with a chain of links; `ratio` is the mass of a ball to the mass of a link."""

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
        tendon = (
            f"<tendon>{tendon}<joint joint='b0_1' coef='-1'/></fixed></tendon>"
            if self.tendon
            else ""
        )
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
    Synthetic(
        condim=4, cone="elliptic", tendon=True, tie="joint", frictionloss=0.05, impratio=100.0
    ),
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
    for row, qpos in enumerate(poses.random_qpos(mj_model, num_envs, rng)):
        mj_data.qpos[:] = 0.7 * mj_model.qpos0 + 0.3 * qpos
        mujoco.mj_normalizeQuat(mj_model, mj_data.qpos)
        poses.put_in_ground(mj_model, mj_data, depth=0.005 * rng.random())
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


def check_cost(mj_model: mujoco.MjModel, num_envs: int, device: str = "cpu") -> None:
    """Solve from one state by both solvers: ours costs at most as much as MuJoCo Warp's, within the tolerance of both.

    Both stop where a step would lower the cost by less than the tolerance times the trace of M. A world that costs more
    fails unless that lies in directions which float32 does not see: then the rest is no more than the tolerance, and
    neither is what a step in float64 would save in the directions that it sees.
    """
    world = touching(mj_model, num_envs, device)
    assert world.has_one_kernel_solver and 0 < world.last_substep("nefc").max() <= world.njmax
    m, d = world.warp_model, world.warp_data_E
    todo, found = problems(world), []
    with wp.ScopedDevice(device):
        for solve in (lambda: mjw.solve(m, d), newton.solver(m, d)):
            d.qacc.zero_()
            d.efc.force.zero_()
            solve()
            qacc = d.qacc.numpy().astype(float)
            found.append(
                np.array([problem.cost(each) for problem, each in zip(todo, qacc, strict=True)])
            )
    theirs, ours = found
    # float32 has no solution for some worlds of the steepest ratios of masses in MuJoCo Warp's solver; ours has one.
    assert np.isfinite(ours).all(), f"worlds {np.flatnonzero(~np.isfinite(ours))}"
    excess = ours - np.where(np.isfinite(theirs), theirs, np.inf)
    diagonal = m.M_hinit_i.numpy() == m.M_colind.numpy()
    trace = d.M.numpy().reshape(num_envs, -1)[:, : diagonal.size][:, diagonal].sum(-1)
    slack = float(m.opt.tolerance.numpy()[0]) * trace + 1e-7 * np.abs(ours)
    for env in np.flatnonzero(excess > slack):
        seen, unseen = todo[env].savings(qacc[env])
        if unseen > 0.0:
            excess[env] = max(excess[env] - unseen, seen)
    worst = int(np.argmax(excess - slack))
    assert excess[worst] <= slack[worst], (
        f"world {worst}: {ours[worst]}, MuJoCo Warp {theirs[worst]}; {excess[worst]} count, {slack[worst]} may"
    )
