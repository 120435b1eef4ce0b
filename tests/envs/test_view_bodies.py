"""Bodies, centres of mass, efforts and heights in the view, against MuJoCo's C engine at random states."""

import mujoco
import pytest
import torch

from ksim_rl.scene.state.quantity import indexed_quantity
from tests.envs.random_states import FIXED_BASE, E, close, engine, random_bench, scalar_joints
from tests.mdp.bench import FREE_BODY, Plateau


@pytest.fixture(scope="module", params=[FREE_BODY, FIXED_BASE], ids=["free", "fixed"])
def bench(request):
    return random_bench(request.param)


def test_orientations_as_quaternions_and_axes(bench):
    index = slice(1, bench.world.mj_model.nbody)
    quat = engine(bench, lambda m, d: d.xquat[1:])
    ours = bench.view.body_quat_w(index)
    close(ours * torch.sign((ours * quat).sum(-1, keepdim=True)), quat)
    # The axes are the columns of the rotation matrix.
    close(
        bench.view.body_axes_w(index), engine(bench, lambda m, d: d.xmat[1:].reshape(-1, 3, 3).swapaxes(1, 2))
    )


def test_centres_of_mass_of_subtrees(bench):
    def speeds(m, d):
        mujoco.mj_subtreeVel(m, d)
        return d.subtree_linvel[1:]

    index = slice(1, bench.world.mj_model.nbody)
    close(bench.view.subtree_com_pos_w(index), engine(bench, lambda m, d: d.subtree_com[1:]))
    close(bench.view.subtree_com_vel_w(index), engine(bench, speeds))
    bench.place(qvel=bench.world.qvel_EL.flip(0).clone())
    close(bench.view.subtree_com_vel_w(index), engine(bench, speeds))


def test_subtree_velocities_must_be_asked_for_during_construction():
    bench = random_bench(FIXED_BASE)
    assert not bench.world.has_subtree_velocities
    bench.view.freeze()
    with pytest.raises(RuntimeError, match="let a term of the config read them"):
        bench.view.subtree_com_vel_w(slice(1, 2))


def test_efforts_at_the_joints(bench):
    bench.world.ctrl_EL.uniform_(-1.0, 1.0)
    ctrl, rows = bench.world.ctrl_EL.double().numpy(), iter(range(E))

    def efforts(m, d):
        d.ctrl[:] = ctrl[next(rows)]
        mujoco.mj_forward(m, d)
        return d.qfrc_actuator[m.jnt_dofadr[scalar_joints(m)]]

    expected = engine(bench, efforts)
    bench.world.step(1)
    bench.refresh()
    close(bench.view.joint_effort_EL, expected)


def test_heights_of_sites_are_above_the_ground(bench):
    index = bench.view.sites(".*")
    close(bench.view.site_height(index), engine(bench, lambda m, d: d.site_xpos[:, 2]))
    flat, bench.view.terrain = bench.view.terrain, Plateau(E, bench.view.device)
    bench.refresh()
    close(bench.view.site_height(index), engine(bench, lambda m, d: d.site_xpos[:, 2] - 0.25))
    bench.view.terrain = flat
    bench.refresh()


class Counting:
    """Counts how often its quantity is computed."""

    def __init__(self):
        self.cache, self.computed = {}, 0

    @indexed_quantity
    def doubled(self, index):
        """Twice the numbers from 0 to 9."""
        self.computed += 1
        return 2 * torch.arange(10)[index]


def test_an_indexed_quantity_is_computed_once_per_index_and_state():
    owner, index = Counting(), torch.tensor([3, 1])
    assert owner.doubled(index).tolist() == [6, 2]
    assert owner.doubled(index) is owner.doubled(index)
    assert owner.doubled(slice(2, 4)).tolist() == [4, 6]
    assert owner.doubled(slice(2, 4)) is owner.doubled(slice(2, 4))
    assert owner.doubled(slice(2, 8, 3)).tolist() == [4, 10]
    assert owner.computed == 3
    owner.cache.clear()
    assert owner.doubled(index).tolist() == [6, 2] and owner.computed == 4
    assert owner.doubled.__doc__ == "Twice the numbers from 0 to 9."


def test_passing_index_tensors_are_never_mistaken_for_each_other():
    # Tensors that die give their ids to new ones.
    owner = Counting()
    assert [owner.doubled(torch.tensor([i])).item() for i in range(10)] == list(range(0, 20, 2))
