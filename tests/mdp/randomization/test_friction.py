"""Friction: what one pair of numbers means, and warnings of what no contact feels, beside contacts of the C engine."""

import warnings

import mujoco
import numpy as np
import pytest
import torch

from ksim_rl import mdp
from ksim_rl.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg, MjcfRobot, SceneCfg
from ksim_rl.physics import SimCfg

BOX = """
<mujoco><worldbody>
  <geom name="floor" type="plane" size="0 0 1" friction="1 0.02 0.001" condim="{ground_condim}"
    priority="{ground_priority}"/>
  <body pos="0 0 0.099"><freejoint/>
    <geom name="box" type="box" size="0.1 0.1 0.1" condim="{condim}" priority="{priority}"/></body>
</worldbody></mujoco>
"""
PLAIN = {"condim": 3, "priority": 0, "ground_condim": 3, "ground_priority": 0}
CASES = {
    "partly below": (
        {0: (0.3, 1.2)},
        {},
        "sliding friction of geoms box has no effect below 1, the friction of 'floor'",
    ),
    "all below": (
        {0: (0.3, 0.9)},
        {},
        "sliding friction of geoms box has no effect, the friction of 'floor'",
    ),
    "all above": ({0: (1.0, 1.5)}, {}, ""),
    "priority": ({0: (0.3, 1.2)}, {"priority": 1}, ""),
    "ground's priority": (
        {0: (1.3, 1.9)},
        {"ground_priority": 1},
        "has no effect on 'floor', whose priority is higher",
    ),
    "torsion in 3 dimensions": (
        {1: (0.1, 0.2)},
        {},
        "torsional friction of geoms box has no effect: their contacts",
    ),
    "torsion in 4 dimensions": ({1: (0.1, 0.2)}, {"condim": 4}, ""),
    "torsion of the ground": ({1: (0.1, 0.2)}, {"ground_condim": 4}, ""),
    "rolling in 4 dimensions": (
        {2: (0.1, 0.2)},
        {"priority": 1, "condim": 4, "ground_condim": 6},
        "less than 6",
    ),
}


def build(text: str, event) -> tuple[ManagerBasedRlEnv, list[str]]:
    scene = SceneCfg(robots={"r": MjcfRobot(source=text)}, num_envs=64)
    blank = {"observations": {}, "actions": {}, "rewards": {}, "terminations": {}}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        cfg = ManagerBasedRlEnvCfg(
            decimation=1, scene=scene, sim=SimCfg(engine="c"), events={"friction": event}, **blank
        )
        env = ManagerBasedRlEnv(cfg)
    return env, [str(warning.message) for warning in caught if "friction" in str(warning.message)]


def friction_of_contact(text: str, column: int, value: float) -> tuple[float, bool]:
    """Return a contact's friction in the C engine when the box has this number, and whether the contact feels it."""
    model = mujoco.MjModel.from_xml_string(text)
    model.geom("box").friction[column] = value
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    contact = data.contact[0]
    return float(contact.friction[(0, 2, 3)[column]]), contact.dim >= (3, 4, 6)[column]


@pytest.mark.parametrize("case", CASES)
def test_a_build_warns_of_what_no_contact_of_the_c_engine_feels(case):
    ranges, changes, expected = CASES[case]
    text = BOX.format(**{**PLAIN, **changes})
    _, said = build(text, mdp.RandomizeGeomFriction(geoms="box", ranges=ranges))
    if expected:
        (line,) = said
        assert line.startswith("events.friction: ") and expected in line
    else:
        assert said == []
    ((column, (low, high)),) = ranges.items()
    felt = [friction_of_contact(text, column, value) for value in (low, high)]
    follows = [
        is_felt and friction == pytest.approx(value)
        for (friction, is_felt), value in zip(felt, (low, high), strict=True)
    ]
    assert all(follows) == (not expected)


def test_one_pair_of_numbers_is_for_sliding():
    env, _ = build(BOX.format(**PLAIN), mdp.RandomizeGeomFriction(geoms="box", ranges=(0.3, 1.2)))
    env.seed(1)
    friction_E3 = env.view.field("geom_friction")[:, 1]
    assert friction_E3[:, 0].std() > 0.1
    torch.testing.assert_close(friction_E3[:, 1:], torch.tensor([0.005, 0.0001]).expand(64, 2))


@pytest.mark.parametrize(
    ("event", "count"),
    [
        (mdp.RandomizePairFriction(pairs="p", ranges=(0.1, 0.2)), 2),
        (mdp.RandomizeGeomColor(geoms="g", ranges=(0.1, 0.2)), 3),
        (mdp.RandomizeMaterialColor(materials="m", ranges=(0.1, 0.2)), 3),
        (mdp.RandomizeBodyCom(bodies="b", ranges=(0.1, 0.2)), 3),
    ],
)
def test_one_pair_of_numbers_is_for_columns_that_mean_the_same(event, count):
    assert list(event.ranges_by_column()) == list(range(count))


@pytest.mark.parametrize("column", range(5))
def test_a_build_warns_of_columns_of_pairs_that_no_contact_of_the_c_engine_feels(column):
    pair = (
        '<contact><pair name="p" geom1="box" geom2="floor" condim="{condim}"/></contact></mujoco>'
    )
    for condim in (3, 4, 6):
        text = BOX.format(**PLAIN).replace("</mujoco>", pair.format(condim=condim))
        _, said = build(text, mdp.RandomizePairFriction(pairs="p", ranges={column: (0.4, 0.5)}))
        model = mujoco.MjModel.from_xml_string(text)
        model.opt.gravity = (3.0, 2.0, -9.81)
        forces = []
        # What a contact does not feel changes no force.
        for friction in (0.01, 0.3):
            model.pair_friction[0] = 0.1
            model.pair_friction[0, column] = friction
            data = mujoco.MjData(model)
            data.qvel[:] = (0.3, 0.2, 0.0, 0.5, 0.4, 2.0)
            mujoco.mj_forward(model, data)
            forces.append(data.qfrc_constraint.copy())
        is_felt = not np.array_equal(*forces)
        assert bool(said) == (not is_felt), (condim, said)
