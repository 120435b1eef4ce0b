import math

import pytest
import torch

from ksim_rl.envs import mdp
from tests.envs.mdp.bench import BOXES, FREE_BODY

E = 1000


@pytest.fixture
def crowd(make_bench):
    return make_bench(BOXES, E)


def test_absolute_friction_is_shared_by_the_geoms_of_a_world(crowd):
    before = crowd.view.field("geom_friction").clone()
    crowd.fire(mdp.RandomizeGeomFriction(elements=("a", "b"), ranges={0: (0.3, 1.5)}, shared=True))
    friction = crowd.view.field("geom_friction")
    slide = friction[:, 1:, 0]
    assert torch.equal(slide[:, 0], slide[:, 1])
    assert 0.3 <= slide.min() < 0.32 and 1.48 < slide.max() <= 1.5
    assert abs(slide[:, 0].mean() - 0.9) < 4.0 * 1.2 / math.sqrt(12 * E)
    assert torch.equal(friction[..., 1:], before[..., 1:])
    assert torch.equal(friction[:, 0], before[:, 0])


def test_unshared_draws_differ_between_elements(crowd):
    crowd.fire(mdp.RandomizeGeomFriction(elements=("a", "b"), ranges={0: (0.3, 1.5)}))
    slide = crowd.view.field("geom_friction")[:, 1:, 0]
    assert (slide[:, 0] != slide[:, 1]).float().mean() > 0.99


def test_log_uniform_spreads_evenly_over_decades(crowd):
    event = mdp.RandomizeGeomFriction(elements="a", ranges={1: (1e-4, 1e-2)}, distribution="log_uniform")
    crowd.fire(event)
    exponent = torch.log10(crowd.view.field("geom_friction")[:, 1, 1])
    assert exponent.min() >= -4.0 - 1e-5 and exponent.max() <= -2.0 + 1e-5
    assert abs(exponent.mean() + 3.0) < 4.0 * 2.0 / math.sqrt(12 * E)


def test_scale_and_add_start_from_the_model_each_time(crowd):
    scale = mdp.RandomizeGeomFriction(elements="a", ranges={0: (0.5, 0.5)}, operation="scale")
    for _ in range(2):
        crowd.fire(scale)
    torch.testing.assert_close(crowd.view.field("geom_friction")[:, 1, 0], torch.full((E,), 0.5))


def test_com_offset_moves_the_centre_of_mass_of_rows_that_are_meant(make_bench):
    bench = make_bench(FREE_BODY, 3)
    event = mdp.RandomizeBodyCom(
        elements=("trunk",), ranges={0: (0.02, 0.02), 2: (-0.03, -0.03)}, operation="add"
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
        bench.fire(mdp.RandomizeGeomFriction(elements="a", ranges={0: (friction, friction)}), mask)
    bench.place(qvel=(1.0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0))
    for _ in range(30):
        bench.step()
    # v^2 / (2 mu g) with v = 1 m/s and g = 10 m/s^2
    torch.testing.assert_close(bench.world.qpos_EL[:, 0], torch.tensor([0.125, 0.0625]), atol=0.01, rtol=0)


def test_encoder_bias_is_drawn_per_joint_and_world(make_bench):
    bench = make_bench(FREE_BODY, E)
    bench.fire(mdp.RandomizeEncoderBias(bias_range=(-0.015, 0.015)))
    bias = bench.view.encoder_bias_EL
    assert -0.015 <= bias.min() < -0.0148 and 0.0148 < bias.max() <= 0.015
    assert (bias[:, 0] != bias[:, 1]).float().mean() > 0.99
    bench.fire(mdp.RandomizeEncoderBias(bias_range=(1.0, 1.0), joints="right_hip"), torch.arange(E) < 10)
    assert (bias[:10, 1] == 1.0).all() and bias[10:].abs().max() <= 0.015 and bias[:, 0].abs().max() <= 0.015


def test_bad_figures_are_refused():
    friction = mdp.RandomizeGeomFriction
    with pytest.raises(ValueError, match="ranges"):
        friction(elements="a", ranges={3: (0.1, 0.2)})
    with pytest.raises(ValueError, match="log_uniform"):
        friction(elements="a", ranges={0: (0.0, 0.2)}, distribution="log_uniform")
    with pytest.raises(ValueError, match=r"operation.*scale"):
        friction(elements="a", ranges={}, operation="scal")
    assert friction(elements="a", ranges={}).per_world_fields == ("geom_friction",)
    assert mdp.RandomizeBodyCom(elements="a", ranges={}).per_world_fields == ("body_ipos",)
