"""The tables that say what an env is made of."""

import math

from ksim_rl import mdp
from ksim_rl.envs import ObservationGroupCfg, ObservationTermCfg
from ksim_rl.physics import SimCfg
from ksim_rl.transforms.noise.cfg import UniformNoise
from tests.envs.probe_env import DT, Kick, Launch, Position, Speed, Target, puck_env


def explained():
    terms = {
        "position": ObservationTermCfg(
            term=mdp.JointPos(), noise=UniformNoise(low=-0.1, high=0.1), history=3
        ),
        "target": ObservationTermCfg(term=mdp.Command(command="target")),
    }
    return puck_env(
        limit=0.25,
        episode_length_s=5 * DT,
        observations={"actor": ObservationGroupCfg(terms=terms)},
        commands={"target": Target(resampling_time_range_s=(1.0, 2.5))},
        rewards={"position": Position(weight=0.5), "idle": Position(weight=0.0)},
        events={
            "launch": Launch(speed=2.0),
            "kick": Kick(mode="interval", interval_range_s=(1.0, 1.0)),
        },
        curriculum={"level": mdp.LinearLevel(end_step=8, initial_level=0.25)},
        metrics={"speed": Speed(reduce="max")},
    ).explain()


def tables(text):
    """Return the tables by title, each a list of rows without its heads."""
    found: dict[str, list[str]] = {}
    title = ""
    for line in text.splitlines()[7:]:
        if line and not line.startswith(" "):
            title = line
            found[title] = []
        elif line.strip() and line.split()[0] != "index" and set(line.strip()) != {"─"}:
            found[title].append(" ".join(line.split()))
    return found


def test_each_manager_is_a_table_of_its_terms():
    assert tables(explained()) == {
        "observations/actor (4,)": [
            "0 position (3,) noise=UniformNoise(low=-0.1, high=0.1), history=3 JointPos()",
            "1 target (1,) Command(command=target)",
        ],
        "actions (1,)": ["0 push (1,) JointEffortAction()"],
        "commands": ["0 target (1,) 1 to 2.5 s Target()"],
        "rewards (times 0.02 s)": [
            "0 position 0.5 Position()",
            "1 idle 0: not computed Position()",
        ],
        "terminations": [
            "0 beyond terminated Beyond(limit=0.25)",
            "1 time_out truncated TimeOut()",
            "2 non_finite terminated always: the physics or the action is not finite",
        ],
        "events": ["0 launch reset Launch(speed=2)", "1 kick interval 1 s Kick()"],
        "curriculum": ["0 level 0.25 LinearLevel(initial_level=0.25, end_step=8)"],
        "metrics": ["0 speed max Speed()"],
        "transforms (actions pass them from last to first)": [
            "0 (groups) obs/position -> actor_terms/position ObservationNoise",
            "1 (groups) actor_terms/position ObservationHistory",
            "2 (groups) actor_terms/position, obs/target -> actor ObservationGroups",
        ],
    }


def test_the_first_line_says_how_many_and_how_long():
    line = explained().splitlines()[0]
    assert line == "3 envs on cpu, 0.02 s per step = 4 x 0.005 s, episodes of 0.1 s = 5 steps"
    assert puck_env(limit=None).explain().splitlines()[0].endswith("episodes of any length")


def test_the_next_lines_say_whose_each_stage_of_a_substep_is_and_why():
    assert explained().splitlines()[1:6] == [
        "what precedes constraints is computed by MuJoCo Warp's own kernels, "
        "because sim.one_kernel_dynamics is None, on the CPU",
        "contacts are found by MuJoCo Warp's own kernels, because the rows of contacts are not made by one kernel",
        "constraint rows are made by MuJoCo Warp's own kernels, because what precedes them is not one kernel",
        "constraints are solved by one kernel",
        "the state is advanced by MuJoCo Warp's own kernels, because sim.one_kernel_dynamics is None, on the CPU",
    ]
    chosen = explained().splitlines()[6]
    assert chosen.startswith("engine warp: on the CPU C is taken from ")
    assert chosen.endswith("and here are 1 in 3")
    env = puck_env(limit=None, sim=SimCfg(solver="cg", one_kernel_dynamics=True))
    dynamics, _, _, solver, integration = env.explain().splitlines()[1:6]
    assert (
        solver
        == "constraints are solved by MuJoCo Warp's own solver, because the solver is not Newton's"
    )
    for line in (dynamics, integration):
        assert line.endswith("own kernels, because the constraints are not solved by one kernel")
    env = puck_env(limit=None, sim=SimCfg(integrator="implicit", one_kernel_dynamics=True))
    dynamics, *_, integration = env.explain().splitlines()[1:6]
    assert dynamics == "what precedes constraints is computed by one kernel"
    assert integration == (
        "the state is advanced by MuJoCo Warp's own kernels, because the integrator is mjINT_IMPLICIT"
    )


def test_callbacks_and_hooks_show_from_when_they_are_set_until_they_are_taken_away():
    env = puck_env(limit=None, sim=SimCfg(one_kernel_dynamics=True))
    before = env.explain()
    assert "what precedes constraints is computed by one kernel" in before
    env.world.warp_model.callback.control = lambda m, d: None
    lines = env.explain().splitlines()[1:7]
    reason = "MuJoCo Warp's own kernels, because a program has set callbacks (control)"
    assert lines[0] == f"what precedes constraints is computed by {reason}"
    assert lines[1].startswith("contacts are found by MuJoCo Warp's own kernels")
    assert lines[2] == f"constraint rows are made by {reason}"
    assert lines[3:5] == [
        "constraints are solved by one kernel",
        "the state is advanced by one kernel",
    ]
    assert lines[5] == "callbacks of the program run in each substep: control"
    env.world.warp_model.callback.control = None
    env.world.warp_model.callback.sensor = lambda m, d, stage: None
    assert env.explain().splitlines()[1] == before.splitlines()[1], (
        "one of sensors has no part in the forces"
    )
    assert "callbacks of the program run in each substep: sensor" in env.explain()
    env.world.warp_model.callback.sensor = None
    assert env.explain() == before
    env.driver.after_substep.append(lambda: None)
    assert "substeps are launched one by one, for 0 hooks before and 1 after each" in env.explain()


def test_an_empty_manager_says_none_and_lines_stay_within_the_width():
    env = puck_env(limit=None, commands={"reach": reach()})
    text = env.explain(width=90)
    assert max(len(line) for line in text.splitlines()) <= 90
    assert tables(text)["metrics"] == ["- none"]
    env.view.reward_weights["position"].fill_(7.0)
    assert tables(env.explain())["rewards (times 0.02 s)"] == ["0 position 7 Position()"], (
        "the present weight"
    )


def reach():
    axes = dict.fromkeys(("x", "y", "z"), (-math.pi, math.pi))
    return mdp.CartesianCommand(resampling_time_range_s=None, position=axes, frame="world")
