import dataclasses
import math

import mujoco
import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from ksim_rl import mdp
from ksim_rl.config.config_tree import from_tree, to_tree
from ksim_rl.device.quick_launch import QuickLaunch
from ksim_rl.envs.term import EventTerm
from tests.mdp.bench import BOXES, FREE_BODY
from tests.mdp.randomization.randomize_bench import Runners
from tests.mdp.randomization.test_randomize_physics import ALL, EVENTS

E = 1000


@pytest.fixture
def crowd(make_bench):
    return make_bench(BOXES, E)


def test_absolute_friction_is_shared_by_the_geoms_of_a_world(crowd):
    before = crowd.view.field("geom_friction").clone()
    crowd.fire(mdp.RandomizeGeomFriction(geoms=("a", "b"), ranges={0: (0.3, 1.5)}, shared=True))
    friction = crowd.view.field("geom_friction")
    slide = friction[:, 1:, 0]
    assert torch.equal(slide[:, 0], slide[:, 1])
    assert 0.3 <= slide.min() < 0.32 and 1.48 < slide.max() <= 1.5
    assert abs(slide[:, 0].mean() - 0.9) < 4.0 * 1.2 / math.sqrt(12 * E)
    assert torch.equal(friction[..., 1:], before[..., 1:])
    assert torch.equal(friction[:, 0], before[:, 0])


def test_unshared_draws_differ_between_elements(crowd):
    crowd.fire(mdp.RandomizeGeomFriction(geoms=("a", "b"), ranges={0: (0.3, 1.5)}))
    slide = crowd.view.field("geom_friction")[:, 1:, 0]
    assert (slide[:, 0] != slide[:, 1]).float().mean() > 0.99


def test_ranges_by_name_are_those_of_each_element(make_bench):
    bench = make_bench(FREE_BODY, E)
    event = mdp.RandomizeBodyCom(
        bodies=("left", "trunk", "right"), ranges={"trunk": (0.01, 0.02), "left|right": (0.1, 0.2)}
    )
    bench.fire(event)
    com = bench.view.field("body_ipos")
    model = bench.world.mj_model
    for name, low, high in (("trunk", 0.01, 0.02), ("left", 0.1, 0.2), ("right", 0.1, 0.2)):
        drawn = com[:, model.body(name).id]
        assert low <= drawn.min() < low + 0.02 * (high - low) and drawn.max() <= high
    left, right, trunk = (com[:, model.body(name).id, 0] for name in ("left", "right", "trunk"))
    assert (left != right).float().mean() > 0.99
    # Draws of two patterns have nothing to do with each other.
    assert abs(torch.corrcoef(torch.stack((left, trunk)))[0, 1]) < 5.0 / math.sqrt(E)
    untouched = model.body_ipos[0]
    assert (com[:, 0] == torch.tensor(untouched, dtype=torch.float32)).all()


@pytest.mark.parametrize(
    ("ranges", "message"),
    [
        ({"trunk": (0.0, 0.1)}, "ranges: 'left' matches no pattern"),
        ({"trunk|left": (0.0, 0.1), "lef.": (0.0, 0.1)}, "ranges: 'left' matches"),
        ({"trunk|left": (0.0, 0.1), "arm": (0.0, 0.1)}, "pattern 'arm' matches nothing"),
    ],
)
def test_a_range_by_name_is_for_one_element_each(make_bench, ranges, message):
    event = mdp.RandomizeBodyCom(bodies=("left", "trunk"), ranges=ranges)
    with pytest.raises(ValueError, match=message):
        make_bench(FREE_BODY, 2).fire(event)


def test_ranges_by_name_survive_a_config_and_are_checked():
    event = mdp.RandomizeBodyMass(bodies=".*", ranges={"left": (0.5, 1.0), "right": (1.0, 2.0)})
    assert from_tree(EventTerm, to_tree(event, EventTerm)) == event
    with pytest.raises(ValueError, match=r"ranges\[left\]"):
        mdp.RandomizeBodyMass(bodies=".*", ranges={"left": (1.0, 0.5)})
    with pytest.raises(ValueError, match="either columns or names"):
        mdp.RandomizeBodyCom(bodies=".*", ranges={"left": (0.0, 0.5), 0: (0.0, 0.5)})
    with pytest.raises(ValueError, match="no elements to name"):
        mdp.RandomizeGravity(ranges={"x": (0.0, 0.5)})


def test_log_uniform_spreads_evenly_over_decades(crowd):
    event = mdp.RandomizeGeomFriction(
        geoms="a", ranges={1: (1e-4, 1e-2)}, distribution="log_uniform"
    )
    crowd.fire(event)
    exponent = torch.log10(crowd.view.field("geom_friction")[:, 1, 1])
    assert exponent.min() >= -4.0 - 1e-5 and exponent.max() <= -2.0 + 1e-5
    assert abs(exponent.mean() + 3.0) < 4.0 * 2.0 / math.sqrt(12 * E)


def test_scale_and_add_start_from_the_model_each_time(crowd):
    scale = mdp.RandomizeGeomFriction(geoms="a", ranges={0: (0.5, 0.5)}, operation="scale")
    for _ in range(2):
        crowd.fire(scale)
    torch.testing.assert_close(crowd.view.field("geom_friction")[:, 1, 0], torch.full((E,), 0.5))


def test_com_offset_moves_the_centre_of_mass_of_rows_that_are_meant(make_bench):
    bench = make_bench(FREE_BODY, 3)
    event = mdp.RandomizeBodyCom(
        bodies=("trunk",), ranges={0: (0.02, 0.02), 2: (-0.03, -0.03)}, operation="add"
    )
    bench.fire(event, torch.tensor([True, False, True]))
    bench.world.set_const(event.per_world_fields)
    bench.place(qpos=(0, 0, 1, 1, 0, 0, 0, 0, 0))
    moved, nominal = [0.12, 0.2, -0.13], [0.1, 0.2, -0.1]
    offset = bench.world.xipos_EL[:, 1] - torch.tensor([0.0, 0.0, 1.0])
    torch.testing.assert_close(offset, torch.tensor([moved, nominal, moved]), atol=1e-6, rtol=0)


def test_friction_stops_a_sliding_box_after_its_braking_distance(make_bench):
    bench = make_bench(BOXES, 2)
    # Rubbing contacts take the larger friction of the pair, so the floor must be the smooth one.
    bench.view.field("geom_friction")[:, 0, 0] = 0.1
    for friction, row in ((0.4, 0), (0.8, 1)):
        mask = torch.arange(2) == row
        bench.fire(mdp.RandomizeGeomFriction(geoms="a", ranges={0: (friction, friction)}), mask)
    bench.place(qvel=(1.0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0))
    for _ in range(30):
        bench.step()
    # v^2 / (2 mu g) with v = 1 m/s and g = 10 m/s^2
    torch.testing.assert_close(
        bench.world.qpos_EL[:, 0], torch.tensor([0.125, 0.0625]), atol=0.01, rtol=0
    )


def test_encoder_bias_is_drawn_per_joint_and_world(make_bench):
    bench = make_bench(FREE_BODY, E)
    bench.fire(mdp.RandomizeEncoderBias(ranges=(-0.015, 0.015)))
    bias = bench.view.encoder_bias_EL
    assert -0.015 <= bias.min() < -0.0148 and 0.0148 < bias.max() <= 0.015
    assert (bias[:, 0] != bias[:, 1]).float().mean() > 0.99
    bench.fire(
        mdp.RandomizeEncoderBias(ranges=(1.0, 1.0), joints="right_hip"), torch.arange(E) < 10
    )
    assert (
        (bias[:10, 1] == 1.0).all()
        and bias[10:].abs().max() <= 0.015
        and bias[:, 0].abs().max() <= 0.015
    )


@pytest.fixture(scope="module")
def herd():
    """Many worlds with every field of their own; they are never stepped."""
    return Runners(E)


def moments(values: torch.Tensor) -> tuple[float, float]:
    return float(values.double().mean()), float(values.double().std())


def test_gaussian_draws_have_the_mean_and_the_deviation(herd):
    herd.restart()
    herd.fire(
        mdp.RandomizeJointDamping(joints=".*_hip", ranges=(1.0, 0.2), distribution="gaussian")
    )
    damping = herd.view.field("dof_damping")[:, 6:8]
    mean, deviation = moments(damping)
    assert abs(mean - 1.0) < 4.0 * 0.2 / math.sqrt(2 * E)
    # Cut at three deviations, a normal variable keeps 0.995 of its variance; its deviation is known to 1/sqrt(2 n).
    assert abs(deviation - 0.2 * math.sqrt(0.995)) < 4.0 * 0.2 / math.sqrt(4 * E)
    assert damping.min() >= 1.0 - 3 * 0.2 - 1e-6 and damping.max() <= 1.0 + 3 * 0.2 + 1e-6


def test_draws_of_elements_and_columns_are_independent(herd):
    herd.restart()
    herd.fire(mdp.RandomizeGeomPos(geoms=".*_foot", ranges=(-0.1, 0.1)))
    geoms = [herd.world.mj_model.geom(name).id for name in ("left_foot", "right_foot")]
    columns = herd.view.field("geom_pos")[:, geoms].reshape(E, 6).numpy()
    off_diagonal = np.corrcoef(columns.T) - np.eye(6)
    assert np.abs(off_diagonal).max() < 4.0 / math.sqrt(E)


def test_shared_draws_are_one_per_world_in_each_kind_of_term(herd):
    herd.restart()
    herd.fire(mdp.RandomizeBodyMass(bodies=".*_leg", ranges=(0.5, 2.0), shared=True))
    herd.fire(
        mdp.RandomizeActuatorGains(joints=("tail", "left_hip"), damping=(0.5, 2.0), shared=True)
    )
    model = herd.world.mj_model
    legs = [model.body("left_leg").id, model.body("right_leg").id]
    factor = herd.view.field("body_mass")[:, legs] / torch.tensor(model.body_mass[legs])
    torch.testing.assert_close(factor[:, 0], factor[:, 1])
    gains = herd.view.field("actuator_biasprm")[:, :, 2]
    torch.testing.assert_close(gains[:, 0] / -0.5, gains[:, 2] / -3.0)
    torch.testing.assert_close(herd.view.field("actuator_gainprm")[:, 2, 0], -gains[:, 2])
    assert factor.std() > 0.3 and gains.std() > 0.3


def test_masses_keep_the_shape_of_their_body(herd):
    herd.restart()
    herd.fire(mdp.RandomizeBodyMass(bodies="trunk", ranges=(1.0, 6.0), operation="abs"))
    mass, inertia = herd.view.field("body_mass")[:, 1], herd.view.field("body_inertia")[:, 1]
    assert mass.min() >= 1.0 and mass.max() <= 6.0
    torch.testing.assert_close(
        inertia / mass[:, None], torch.tensor([[0.02, 0.03, 0.04]]).expand(E, 3) / 3.0
    )


@pytest.mark.parametrize(
    "event",
    [
        mdp.RandomizeBodyInertia(bodies=".*", ranges=(0.05, 20.0), distribution="log_uniform"),
        mdp.RandomizePseudoInertia(
            bodies=".*",
            alpha=(-1.0, 1.0),
            stretch=(-1.0, 1.0),
            shear=(-1.0, 1.0),
            shift=(-0.2, 0.2),
        ),
    ],
    ids=("inertia", "pseudo_inertia"),
)
def test_random_inertias_are_those_of_real_bodies(herd, event):
    herd.restart()
    event = dataclasses.replace(event, bodies=("trunk", ".*_leg", "tail"))
    herd.fire(event)
    inertia = herd.view.field("body_inertia")[:, 1:].double()
    largest = inertia.max(-1).values
    assert inertia.min() > 0.0 and torch.isfinite(inertia).all()
    assert (2.0 * largest <= inertia.sum(-1) * (1.0 + 1e-5)).all()


def test_pseudo_inertia_is_the_deformed_one(herd):
    """U J0 U^T in 64 bits, from the drawn numbers, against what the four fields say."""
    herd.restart()
    event = mdp.RandomizePseudoInertia(
        bodies="trunk", alpha=(-0.5, 0.5), stretch=(-0.4, 0.4), shear=(-0.5, 0.5), shift=(-0.1, 0.1)
    )
    with herd.driver.scope("events/x", herd.view.reset_count_E):
        drawn = herd.view.uniform(10).double().numpy()
    herd.fire(event)
    low, high = np.repeat([[-0.5, -0.4, -0.5, -0.1], [0.5, 0.4, 0.5, 0.1]], [1, 3, 3, 3], axis=1)
    parameters = low + drawn * (high - low)
    own = pseudo_inertia(herd.world.mj_model, None)
    for row in range(0, E, 100):
        a, d1, d2, d3, s12, s23_13, s23, t1, t2, t3 = parameters[row]
        u = np.exp(a) * np.array(
            [
                [np.exp(d1), s12, s23_13, t1],
                [0, np.exp(d2), s23, t2],
                [0, 0, np.exp(d3), t3],
                [0, 0, 0, 1],
            ]
        )
        # The deformation acts in the principal frame, which here differs from the body's by a shift only.
        shift = np.eye(4)
        shift[:3, 3] = (0.02, 0, 0.01)
        expected = shift @ u @ np.linalg.inv(shift) @ own @ np.linalg.inv(shift).T @ u.T @ shift.T
        np.testing.assert_allclose(
            pseudo_inertia(herd.world.mj_model, herd, row), expected, rtol=1e-4, atol=1e-6
        )


def pseudo_inertia(model: mujoco.MjModel, herd: Runners | None, row: int = 0) -> np.ndarray:
    """The pseudo-inertia matrix [4, 4] of the trunk in its body frame: second moments, first moments, mass."""
    fields = ("body_mass", "body_ipos", "body_inertia", "body_iquat")
    if herd is None:
        mass, com, moments, quat = (np.array(getattr(model, field)[1]) for field in fields)
    else:
        mass, com, moments, quat = (
            herd.view.field(field)[row, 1].double().numpy() for field in fields
        )
    axes = np.zeros(9)
    mujoco.mju_quat2Mat(axes, quat)
    inertia = axes.reshape(3, 3) @ np.diag(moments) @ axes.reshape(3, 3).T
    matrix = np.empty((4, 4))
    matrix[:3, :3] = 0.5 * np.trace(inertia) * np.eye(3) - inertia + mass * np.outer(com, com)
    matrix[:3, 3] = matrix[3, :3] = mass * com
    matrix[3, 3] = mass
    return matrix


def test_default_joint_pos_moves_what_joint_positions_are_relative_to(herd):
    herd.restart()
    herd.fire(
        mdp.RandomizeDefaultJointPos(joints=".*_hip", ranges=(-0.1, 0.1)), torch.arange(E) >= 10
    )
    herd.world.qpos_EL[:, 7:] = torch.tensor((0.1, -0.1, 0.05))
    herd.driver.refreshed()
    offset = herd.view.joint_pos_rel_EL
    assert offset[:10].abs().max() < 1e-7 and offset[:, 2].abs().max() < 1e-7
    assert offset[10:, :2].abs().max() <= 0.1 + 1e-6 and offset[10:, :2].std() > 0.05


def test_seeds_reproduce_and_differ(herd):
    drawn = []
    for seed in (0, 1, 0):
        herd.restart()
        herd.view.seed.fill_(seed)
        herd.fire(EVENTS["pseudo_inertia"])
        drawn.append(herd.view.field("body_iquat").clone())
    assert torch.equal(drawn[0], drawn[2])
    assert not torch.equal(drawn[0], drawn[1])


@pytest.mark.parametrize("name", ALL)
def test_config_round_trip(name):
    event = ALL[name]
    assert from_tree(EventTerm, to_tree(event, EventTerm)) == event


def test_bad_figures_are_refused():
    friction = mdp.RandomizeGeomFriction
    with pytest.raises(ValueError, match="ranges"):
        friction(geoms="a", ranges={3: (0.1, 0.2)})
    with pytest.raises(ValueError, match="log_uniform"):
        friction(geoms="a", ranges={0: (0.0, 0.2)}, distribution="log_uniform")
    with pytest.raises(ValueError, match=r"operation.*scale"):
        friction(geoms="a", ranges={}, operation="scal")
    assert friction(geoms="a", ranges={}).per_world_fields == ("geom_friction",)
    assert mdp.RandomizeBodyCom(bodies="a", ranges={}).per_world_fields == ("body_ipos",)


@pytest.mark.parametrize(
    ("kind", "field", "others"),
    [
        (mdp.RandomizeEncoderBias, "ranges", {"joints": "a"}),
        (mdp.RandomizeEffortLimit, "ranges", {"joints": "a"}),
        (mdp.RandomizeActuatorGains, "stiffness", {"joints": "a"}),
        (mdp.RandomizeActuatorGains, "damping", {"joints": "a"}),
        *(
            (mdp.RandomizePseudoInertia, name, {"bodies": "a"})
            for name in ("alpha", "stretch", "shear", "shift")
        ),
    ],
)
def test_ranges_that_cannot_be_drawn_from_are_refused_by_name(kind, field, others):
    assert getattr(kind(**{field: (0.5, 2.0)}, **others), field) == (0.5, 2.0)
    with pytest.raises(ValueError, match=rf"{field} \(uniform\)=\(2.0, 0.5\): low exceeds high"):
        kind(**{field: (2.0, 0.5)}, **others)


@pytest.mark.parametrize(
    ("event", "message"),
    [
        (mdp.RandomizeBodyMass(bodies="trunkk", ranges=(0.5, 2.0)), "no body matches 'trunkk'.*'trunk'"),
        (mdp.RandomizeBodyMass(bodies="trunk", ranges=(-0.5, 2.0)), "body_mass of body 'trunk' would reach -1.5"),
        (
            mdp.RandomizeJointArmature(
                joints="left_hip", ranges=(0.0, 0.1), operation="add", distribution="gaussian"
            ),
            "dof_armature of joint 'left_hip' would reach -0.29",
        ),
        (mdp.RandomizeGeomSize(geoms="floor", ranges=(0.5, 2.0)), "geom 'floor', a plane, has 0 sizes"),
        (mdp.RandomizeGeomSize(geoms="left_foot", ranges={1: (0.5, 2.0)}), "'left_foot', a sphere, has 1 sizes"),
        (mdp.RandomizeJointRange(joints="tail", ranges=(0.0, 0.1)), "joint 'tail' has no limits"),
        (mdp.RandomizeJointRange(joints="left_hip", ranges={1: (-1.0, 0.0)}), "not below its upper limit -0.7"),
        (mdp.RandomizeActuatorGains(joints="right_hip", stiffness=(0.5, 2.0)), "'right_hip' has no servo with"),
        (mdp.RandomizeActuatorGains(joints="left_hip", stiffness=(-0.5, 2.0)), "'left_hip' would reach -10"),
        (mdp.RandomizeBodyPos(bodies="trunk", ranges=(0.0, 0.1)), "'trunk' moves freely, so that its pose is state"),
        (mdp.RandomizeGeomColor(geoms="left_foot", ranges=(0.5, 2.0)), "'left_foot' would reach 2; expected at most 1"),
        (mdp.RandomizeTendonDamping(tendons="strap", ranges=(0.5, 2.0)), "no tendon matches 'strap'"),
        (mdp.RandomizeEffortLimit(joints="tail", ranges=(0.5, 2.0)), "nothing limits the effort on joint 'tail'"),
    ],
)  # fmt: skip
def test_what_a_model_cannot_have_is_refused(herd, event, message):
    herd.restart()
    with pytest.raises(ValueError, match=message):
        herd.fire(event)


class Kernels(TorchDispatchMode):
    """Counts what torch computes, that is all operations but views and allocations."""

    def __init__(self) -> None:
        super().__init__()
        self.names: list[str] = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        result = func(*args, **(kwargs or {}))
        is_view = func._schema.name == "aten::empty" or func.is_view
        self.names += [] if is_view else [func._schema.name]
        return result


@pytest.mark.parametrize(
    "event",
    [
        mdp.RandomizeBodyMass(bodies=("trunk", ".*_leg", "tail"), ranges=(0.8, 1.2)),
        mdp.RandomizeBodyCom(
            bodies=("trunk", ".*_leg", "tail"), ranges=(-0.1, 0.1), operation="add"
        ),
    ],
)
def test_draws_of_all_bodies_take_one_kernel(herd, event, monkeypatch):
    """They run at every step, for the rows that reset, and each kernel costs about 2 us on a GPU."""
    herd.restart()
    herd.fire(event)
    launches, launch = [], QuickLaunch.__call__
    monkeypatch.setattr(QuickLaunch, "__call__", lambda *args: launches.append(launch(*args)))
    with herd.driver.scope("events/x", herd.view.reset_count_E), Kernels() as kernels:
        event(herd.view, herd.everybody_E)
    assert not kernels.names
    assert len(launches) == 1
