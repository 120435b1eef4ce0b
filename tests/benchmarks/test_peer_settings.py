"""The variants differ from our settings in what they say, begin with torch's weights, and are written and drawn."""

import copy
import functools
import json
import math
import sys
from types import SimpleNamespace

import pytest
import torch
from matplotlib.image import imread
from torch import nn

from benchmarks import peer_settings, report
from benchmarks.peer_settings import (
    LEVELS,
    VARIANTS,
    FirstPolicy,
    Run,
    initialize_as_torch,
    run_cfg,
)
from ksim_rl.objectives import PPOCfg
from ksim_rl.trainers import Trainer
from tests.algorithms.fused_problem import (
    column,
    finite,
    needs_interpreter,
    networks,
    rollout,
    update,
)
from tests.trainers.target_env import make_trainer

WORDS = ("device=cpu", "num_envs=16", "collector.rollout_length=24")
LINEAR, ANGULAR = LEVELS


def flat(tree, path=""):
    if isinstance(tree, dict):
        return {
            key: v
            for name, entry in tree.items()
            for key, v in flat(entry, f"{path}.{name}").items()
        }
    return {path.removeprefix("."): tree}


CHANGES = {
    "ours": {},
    "discount": {"objective.gamma": 0.99},
    "initialization": {},
    "float32": {"objective.precision": "float32", "trainer.matmul_precision": "highest"},
    "all": {
        "objective.gamma": 0.99,
        "objective.precision": "float32",
        "trainer.matmul_precision": "highest",
    },
    "all_tf32": {"objective.gamma": 0.99, "objective.precision": "float32"},
}


@functools.cache
def fields(variant):
    """The fields of a variant's config."""
    return flat(run_cfg(variant, 2, WORDS, "40e6").to_tree())


@pytest.mark.parametrize("name", VARIANTS)
def test_a_variant_differs_from_ours_in_the_fields_that_it_says(name):
    ours, own = fields("ours"), fields(name)
    assert {key: value for key, value in own.items() if ours[key] != value} == CHANGES[name]
    assert VARIANTS[name].torch_initialization == (name in ("initialization", "all", "all_tf32"))
    # What is ours, so that the three stay those in which we differ.
    assert (ours["objective.gamma"], ours["objective.precision"]) == (0.98, "auto")
    assert ours["trainer.matmul_precision"] == "high" and ours["seed"] == 2
    assert ours["trainer.num_iterations"] == math.ceil(40e6 / (16 * 24))


def test_a_variant_that_there_is_not_is_named():
    with pytest.raises(ValueError, match="unknown variant 'discont'.*discount"):
        run_cfg("discont", 1, WORDS, "1e6")


def layers(made):
    parts = [*made.actor.modules(), *made.critic.modules()]
    return [part for part in parts if isinstance(part, nn.Linear)]


def test_the_weights_are_those_that_torch_gives_a_new_layer():
    """All are uniform within 1 / sqrt(fan_in), the output layers' too."""
    made = update(PPOCfg(), *networks(hidden=(256, 256, 128)))
    before, drawn = {id(layer.weight) for layer in layers(made)}, torch.get_rng_state()
    std = made.actor[0].module.head.std.clone()
    initialize_as_torch(made, seed=1)
    assert {id(layer.weight) for layer in layers(made)} == before  # in place, where kernels look
    assert torch.equal(torch.get_rng_state(), drawn) and torch.equal(
        made.actor[0].module.head.std, std
    )
    assert [layer.out_features for layer in layers(made)] == [256, 256, 128, 3, 256, 256, 128, 1]
    for layer in layers(made):
        bound = 1.0 / math.sqrt(layer.in_features)
        assert 0.9 * bound < layer.weight.abs().max() <= bound
        assert layer.bias.abs().max() <= bound and layer.bias.abs().min() > 0.0
        assert layer.weight.std().item() == pytest.approx(bound / math.sqrt(3.0), rel=0.1)


def test_they_differ_between_seeds_and_are_those_of_the_seed():
    made = update(PPOCfg(), *networks())

    def weights(seed):
        initialize_as_torch(made, seed=seed)
        return [layer.weight.clone() for layer in layers(made)]

    first, second, again = weights(1), weights(2), weights(1)
    assert all(torch.equal(one, other) for one, other in zip(first, again, strict=True))
    assert not any(torch.equal(one, other) for one, other in zip(first, second, strict=True))
    torch.manual_seed(1)
    assert torch.equal(nn.Linear(first[0].shape[1], first[0].shape[0]).weight, first[0])


@needs_interpreter
def test_fused_kernels_collect_and_begin_to_learn_with_these_weights():
    pytest.importorskip("triton")
    from ksim_rl.objectives.fused_ppo.fused_ppo import FusedPPO

    torch.set_float32_matmul_precision("highest")
    cfg = PPOCfg(num_epochs=1, schedule="fixed", learning_rate=1e-2, clip_epsilon=1e-5)
    made = update(cfg, *networks(), FusedPPO)
    behavior, old = made.behavior, copy.deepcopy(made.actor)
    data = rollout(made.actor).apply(finite)
    with torch.no_grad(), behavior.steady():  # which took over the first weights
        behavior(data.select("actor"))
    initialize_as_torch(made, seed=1)
    with torch.no_grad(), behavior.steady():
        acted = behavior(data.select("actor"))
    observed = data.select("actor")
    with torch.no_grad():
        torch.testing.assert_close(
            acted["loc"], made.actor.get_dist(observed).mean, atol=1e-4, rtol=1e-4
        )
        assert (acted["loc"] - old.get_dist(observed).mean).abs().mean() > 0.1
    made(data.update(acted))
    # Outside of the clip interval is a ratio that is not one to rounding.
    assert made.fused._summary[0, column("clip_fraction")].item() == 0.0


@pytest.fixture
def begun():
    """Return a trainer before its first iteration, and the hook that knows its weights."""
    trainer = make_trainer()
    initialize_as_torch(trainer.update, seed=1)
    first = FirstPolicy()
    first.expects(trainer.update)
    return trainer, first


def after_one_iteration(trainer: Trainer, first: FirstPolicy) -> None:
    trainer.iterate()
    trainer.settle()
    first(trainer)


def test_a_run_that_begins_with_its_networks_passes(begun):
    trainer, first = begun
    after_one_iteration(trainer, first)
    assert first.interval == 0
    assert first.facts["first_log_ratio"] < 1e-4 and first.facts["first_cosine"] > 0.9


def test_a_rollout_of_another_policy_is_refused(begun):
    trainer, first = begun
    with torch.no_grad():
        for part in trainer.update.actor.modules():
            if isinstance(part, nn.Linear):
                part.bias += 2.0
    with pytest.raises(RuntimeError, match="policy that collected first"):
        after_one_iteration(trainer, first)


def test_an_update_that_began_with_other_weights_is_refused(begun):
    trainer, first = begun
    trainer.iterate()
    trainer.settle()
    initialize_as_torch(trainer.update, seed=2)
    with pytest.raises(RuntimeError, match="did not begin with the weights"):
        first(trainer)


def made_up(*, rises_by, seed=0):
    """Return a run whose rewards rise by so much with each million env states."""
    points = [
        {
            "env_states": 1e5 * i,
            "seconds": 0.05 * i,
            LINEAR: rises_by * 0.1 * i,
            ANGULAR: rises_by * 0.1 * i + 0.01 * seed,
        }
        for i in range(1, 401)
    ]
    del points[0][LINEAR], points[0][ANGULAR]  # no episode has ended
    facts = {"first_log_ratio": 0.001, "precision": "float32", "fused": False}
    return Run(points=points, facts=facts)


def test_a_run_is_judged_by_the_mean_of_a_million_env_states():
    """A mean over a window of a million that ends at s belongs to its middle, s - 0.5 million; see `reached`."""
    found = made_up(rises_by=0.1).found
    assert found["env_states_to_levels"] == pytest.approx(13.9e6 + 0.5e6, abs=1e5)
    assert found["seconds_to_levels"] == pytest.approx(
        0.05 * found["env_states_to_levels"] / 1e5, abs=0.01
    )
    assert found["means"][LINEAR] == pytest.approx(0.1 * 39.5, abs=0.01)
    assert made_up(rises_by=0.01).found["env_states_to_levels"] is None


def test_the_curve_that_is_drawn_is_the_mean_that_is_judged():
    run = made_up(rises_by=0.1)
    at = {point["env_states"]: point for point in peer_settings.held_means(run.points)}
    end = at[run.found["env_states_to_levels"]]
    assert end[LINEAR] >= LEVELS[LINEAR] > at[end["env_states"] - 1e5][LINEAR]
    assert peer_settings.median_curve(
        [[{"env_states": 1.0, "a": v}] for v in (3.0, 1.0, 2.0)], "a"
    ) == [(1.0, 2.0)]


class _Pool:
    """Trains nothing, in this process."""

    def __init__(self, *_, **__):
        pass

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def submit(self, work, name, cfg):
        assert work is peer_settings.train
        rises_by = 0.2 - 0.03 * list(VARIANTS).index(name)
        return SimpleNamespace(result=lambda: made_up(rises_by=rises_by, seed=cfg.seed))


@pytest.mark.full
def test_figures_seeds_curves_and_picture_are_written(monkeypatch, tmp_path):
    monkeypatch.setattr(peer_settings, "ProcessPoolExecutor", _Pool)
    monkeypatch.setattr(report, "write", functools.partial(report.write, folder=tmp_path))
    monkeypatch.setattr(sys, "argv", ["benchmark", *WORDS, "seeds=1,2,3", "at_once=5"])
    peer_settings.main()
    saved = json.loads((tmp_path / "peer_settings.json").read_text())
    prefix = "cpu/go1_velocity_flat/16"
    assert set(saved["seeds"]) == {f"{prefix}/{name}" for name in VARIANTS}
    ours = saved["seeds"][f"{prefix}/ours"]
    assert ours["at_once"] == 5 and set(ours["runs"]) == {"1", "2", "3"}
    # The linear reward is the last to come to its level; the seeds differ in the angular one.
    assert ours["runs"]["2"]["env_states_to_levels"] == pytest.approx(1.39e6 / 0.2 + 0.5e6, abs=1e5)
    assert saved["figures"][f"{prefix}/ours/seeds_at_levels"] == 3
    assert saved["figures"][f"{prefix}/all_tf32/track_angular_velocity"] == pytest.approx(
        0.05 * 39.5 + 0.02, abs=0.01
    )
    curve = saved["curves"][f"{prefix}/all/seed_3"]
    assert 40 <= len(curve) <= 42 and curve[-1]["env_states"] == 4e7
    picture = imread(tmp_path / "peer_settings.png")
    assert (
        picture.shape[0] > 400
        and len({tuple(pixel) for pixel in picture[::4, ::4].reshape(-1, 4)}) > 20
    )
