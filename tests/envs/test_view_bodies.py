"""Bodies, centres of mass, efforts and heights in the view, against MuJoCo's C engine at random states."""

import mujoco
import pytest
import torch

from tests.envs.random_states import FIXED_BASE, E, close, engine, random_bench, scalar_joints
from tests.mdp.bench import FREE_BODY, Plateau


@pytest.fixture(scope="module", params=[FREE_BODY, FIXED_BASE], ids=["free", "fixed"])
def bench(request):
    return random_bench(request.param)


def test_orientations_as_quaternions_and_axes(bench):
    bodies = bench.view.bodies(bench.view.resolver.names("body")[1:])
    quat = engine(bench, lambda m, d: d.xquat[1:])
    ours = bodies.quat_EN4
    close(ours * torch.sign((ours * quat).sum(-1, keepdim=True)), quat)
    # The axes are the columns of the rotation matrix.
    close(bodies.axes_EN33, engine(bench, lambda m, d: d.xmat[1:].reshape(-1, 3, 3).swapaxes(1, 2)))


def test_centres_of_mass_of_subtrees(bench):
    def speeds(m, d):
        mujoco.mj_subtreeVel(m, d)
        return d.subtree_linvel[1:]

    bodies = bench.view.bodies(bench.view.resolver.names("body")[1:])
    close(bodies.subtree_com_pos_EN3, engine(bench, lambda m, d: d.subtree_com[1:]))
    close(bodies.subtree_com_vel_EN3, engine(bench, speeds))
    bench.place(qvel=bench.world.qvel_EL.flip(0).clone())
    close(bodies.subtree_com_vel_EN3, engine(bench, speeds))


def test_subtree_velocities_must_be_asked_for_during_construction():
    bench = random_bench(FIXED_BASE)
    bench.driver.freeze()
    with pytest.raises(RuntimeError, match="subtree_linvel is not computed: let a term"):
        assert bench.view.bodies(".*").subtree_com_vel_EN3


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
    sites = bench.view.sites(".*")
    close(sites.height_EN, engine(bench, lambda m, d: d.site_xpos[:, 2]))
    flat, bench.driver.ground = bench.view.terrain, Plateau(E, bench.view.device)
    bench.refresh()
    close(sites.height_EN, engine(bench, lambda m, d: d.site_xpos[:, 2] - 0.25))
    bench.driver.ground = flat
    bench.refresh()


def test_named_elements_are_resolved_once_and_computed_once_per_state(bench):
    view = bench.view
    assert view.bodies(".*") is view.bodies((".*",)) and view.joints(".*") is not view.joints()
    bodies = view.bodies(".*")
    assert bodies.pos_EN3 is bodies.pos_EN3 and view.sites(".*").pos_EN3 is view.sites(".*").pos_EN3
    before = bodies.pos_EN3
    bench.refresh()
    assert bodies.pos_EN3 is not before


def test_one_body_and_one_site_by_name(bench):
    view = bench.view
    names = view.resolver.names("body")[1:]
    for number, name in enumerate(names):
        body, bodies = view.body(name), view.bodies(names)
        assert (body.name, body.id) == (name, number + 1)
        for one, all_of_them in (
            (body.pos_EL, bodies.pos_EN3),
            (body.quat_EL, bodies.quat_EN4),
            (body.axes_E33, bodies.axes_EN33),
            (body.lin_vel_EL, bodies.lin_vel_EN3),
            (body.ang_vel_EL, bodies.ang_vel_EN3),
        ):
            assert torch.equal(one, all_of_them[:, number])
    sites = view.sites(".*")
    site = view.site(sites.names[0])
    assert torch.equal(site.pos_EL, sites.pos_EN3[:, 0]) and torch.equal(
        site.height_E, sites.height_EN[:, 0]
    )
    assert torch.equal(site.lin_vel_EL, sites.lin_vel_EN3[:, 0])
    with pytest.raises(ValueError, match="name one of them"):
        view.body(".*")
    with pytest.raises(ValueError, match="no body matches"):
        view.body("tors")


def test_joints_by_name_are_columns_of_all_joints(bench):
    view = bench.view
    view.joints().default_pos_EL.add_(0.1)
    view.encoder_bias_EL.add_(torch.arange(2.0))
    chosen, columns = view.joints(view.joints().names[::-1]), [1, 0]
    assert len(chosen) == 2 and chosen.names == view.joints().names[::-1] and chosen.ids == (1, 0)
    for one, every in (
        (chosen.pos_EL, view.joint_pos_EL),
        (chosen.vel_EL, view.joint_vel_EL),
        (chosen.acc_EL, view.joint_acc_EL),
        (chosen.effort_EL, view.joint_effort_EL),
        (chosen.pos_rel_EL, view.joint_pos_rel_EL),
        (chosen.default_pos_EL, view.default_joint_pos_EL),
        (chosen.encoder_bias_EL, view.encoder_bias_EL),
    ):
        assert torch.equal(one, every[:, columns])
    assert torch.equal(chosen.soft_limits_L2, view.soft_joint_pos_limits_L2[columns])
