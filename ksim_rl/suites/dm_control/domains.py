"""The domains of the DeepMind Control Suite: their time steps, observations, starts and targets.

Tassa et al., "DeepMind Control Suite" (2018), and the package `dm_control`; changes by MuJoCo Playground stand in
`playground` of each domain, and in docs/suites.md.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from ksim_rl import mdp
from ksim_rl.envs.term import EventTerm, ObservationTerm
from ksim_rl.physics import SimCfg
from ksim_rl.scene.viewer_cfg import ViewerCfg
from ksim_rl.suites.dm_control.quantities import BodyAxes, GeneralizedVelocity, Offset, Readings
from ksim_rl.suites.dm_control.starts import DrawStart, StartFromBank


@dataclass(frozen=True, kw_only=True)
class Domain:
    """The parts that the tasks of one model share; `playground` has the fields that MuJoCo Playground has otherwise.

    Attributes:
        decimation: physics substeps per control step.
        sim: options that replace the model's own.
        observations: as dm_control names and orders them; `Target`s add theirs by task.
        events: how episodes start; None is the default pose.
    """

    decimation: int
    observations: Mapping[str, ObservationTerm]
    events: Mapping[str, EventTerm] | None
    viewer: ViewerCfg
    sim: SimCfg = field(default_factory=SimCfg)
    playground: Mapping[str, Any] = field(default_factory=dict)


def _iterations(most: int, of_line_search: int, **options: Any) -> SimCfg:
    # Playground limits the solver's and the line search's iterations.
    return SimCfg(iterations=most, ls_iterations=of_line_search, **options)


def _side_view(distance: float, height: float) -> ViewerCfg:
    return ViewerCfg(lookat=(0.0, 0.0, height), distance=distance, elevation=-10.0, azimuth=90.0)


def _beside(body: str, distance: float) -> ViewerCfg:
    return ViewerCfg(body=body, distance=distance, elevation=-15.0, azimuth=90.0)


_VELOCITY = GeneralizedVelocity()
# dm_control's `randomize_limited_and_rotational_joints`.
_OWN_RANGES = {"start": DrawStart(own_ranges=True)}
_FISH_JOINTS = (
    "tail1", "tail_twist", "tail2", "finright_roll", "finright_pitch", "finleft_roll", "finleft_pitch",
)  # fmt: skip
# All bodies but the world's.
_ALL_BODIES = "(?!world$).+"
_WALKER_POSE = BodyAxes(bodies=_ALL_BODIES, entries=("xx", "xz"))

DOMAINS: Mapping[str, Domain] = {
    "acrobot": Domain(
        decimation=1,
        observations={
            # By entry: both horizontals first, then both verticals, as dm_control has them.
            "orientations": BodyAxes(
                bodies=("upper_arm", "lower_arm"), entries=("xz", "zz"), by_entry=True
            ),
            "velocity": _VELOCITY,
        },
        events=_OWN_RANGES,
        viewer=_side_view(7.0, 2.0),
        # Playground's own options, for the same model.
        playground={"sim": _iterations(2, 4, integrator="euler")},
    ),
    "ball_in_cup": Domain(
        decimation=10,
        observations={"position": mdp.JointPos(), "velocity": _VELOCITY},
        events={
            "start": StartFromBank(
                ranges={"ball_x": (-0.2, 0.2), "ball_z": (0.2, 0.5)}, without_contacts=True
            )
        },
        viewer=_side_view(1.5, 0.5),
        playground={"sim": _iterations(1, 4), "events": None},
    ),
    "cartpole": Domain(
        decimation=1,
        observations={
            "position": mdp.JointPos(joints="slider"),
            "angle": BodyAxes(bodies="pole_1", entries=("zz", "xz")),
            "velocity": _VELOCITY,
        },
        events={
            "start": DrawStart(
                ranges={"slider": (-0.1, 0.1), "hinge_1": (-0.034, 0.034)}, velocity_std=0.01
            )
        },
        viewer=_side_view(5.0, 1.0),
        playground={"sim": _iterations(1, 4, integrator="euler")},
    ),
    "cheetah": Domain(
        decimation=1,
        observations={
            # The cheetah's place along x must not matter.
            "position": mdp.JointPos(joints="(?!rootx$).+"),
            "velocity": _VELOCITY,
        },
        # Of the joints without limits dm_control turns none here.
        events={
            "start": StartFromBank(own_ranges=True, ranges={"rooty": (0.0, 0.0)}, settle_steps=200)
        },
        viewer=_beside("torso", 4.0),
        playground={"sim": _iterations(4, 8)},
    ),
    "finger": Domain(
        decimation=2,
        observations={
            "position": mdp.JointPos(joints=("proximal", "distal")),
            "tip": Offset(ends=("site:tip",), start="body:spinner", axes="xz"),
            "velocity": Readings(
                sensors=("proximal_velocity", "distal_velocity", "hinge_velocity")
            ),
            # Touch forces span orders of magnitude.
            "touch": Readings(sensors=("touchtop", "touchbottom"), log=True),
        },
        events={"start": StartFromBank(own_ranges=True, without_contacts=True)},
        viewer=_side_view(1.8, 0.3),
        playground={
            "decimation": 4,
            "sim": _iterations(2, 8, timestep=0.005, integrator="implicitfast", cone="pyramidal"),
            "events": _OWN_RANGES,
        },
    ),
    "fish": Domain(
        decimation=10,
        observations={
            "joint_angles": mdp.JointPos(joints=_FISH_JOINTS),
            "upright": BodyAxes(bodies="torso", entries=("zz",)),
            "target": Offset(ends=("command:target",), start="geom:mouth", frame="geom:mouth"),
            "velocity": _VELOCITY,
        },
        events={
            "start": DrawStart(ranges=dict.fromkeys(_FISH_JOINTS, (-0.2, 0.2)), root="uniform")
        },
        viewer=_beside("torso", 1.2),
        playground={"decimation": 20, "sim": _iterations(2, 6, timestep=0.002)},
    ),
    "hopper": Domain(
        decimation=4,
        observations={
            # The hopper's place along x must not matter.
            "position": mdp.JointPos(joints="(?!rootx$).+"),
            "velocity": _VELOCITY,
            "touch": Readings(sensors=("touch_toe", "touch_heel"), log=True),
        },
        events=_OWN_RANGES,
        viewer=_beside("torso", 3.0),
        playground={"sim": _iterations(4, 10)},
    ),
    "humanoid": Domain(
        decimation=5,
        observations={
            "joint_angles": mdp.JointPos(),
            "head_height": Offset(ends=("body:head",), axes="z"),
            "extremities": Offset(
                ends=("body:left_hand", "body:left_foot", "body:right_hand", "body:right_foot"),
                start="body:torso",
                frame="body:torso",
            ),
            "torso_vertical": BodyAxes(bodies="torso", entries=("zx", "zy", "zz")),
            "com_velocity": Readings(sensors=("torso_subtreelinvel",)),
            "velocity": _VELOCITY,
        },
        # The humanoid's joints are drawn until it touches nothing.
        events={"start": StartFromBank(own_ranges=True, root="positive", without_contacts=True)},
        viewer=_beside("torso", 4.0),
        playground={"sim": _iterations(4, 8), "events": None},
    ),
    "pendulum": Domain(
        decimation=1,
        observations={
            "orientation": BodyAxes(bodies="pole", entries=("zz", "xz")),
            "velocity": _VELOCITY,
        },
        events=_OWN_RANGES,
        viewer=_side_view(2.5, 0.6),
        playground={
            "decimation": 2,
            "sim": _iterations(4, 8, timestep=0.01),
            "events": {"start": DrawStart(ranges={"hinge": (0.0, 3.141592653589793)})},
        },
    ),
    "point_mass": Domain(
        decimation=1,
        observations={"position": mdp.JointPos(), "velocity": _VELOCITY},
        events=_OWN_RANGES,
        viewer=ViewerCfg(lookat=(0.0, 0.0, 0.0), distance=1.0, elevation=-70.0, azimuth=90.0),
        playground={"sim": _iterations(1, 4)},
    ),
    "reacher": Domain(
        decimation=1,
        observations={
            "position": mdp.JointPos(),
            "to_target": Offset(ends=("command:target",), start="geom:finger", axes="xy"),
            "velocity": _VELOCITY,
        },
        events=_OWN_RANGES,
        viewer=ViewerCfg(lookat=(0.0, 0.0, 0.0), distance=1.0, elevation=-70.0, azimuth=90.0),
        playground={"decimation": 4, "sim": _iterations(1, 6, timestep=0.005)},
    ),
    "swimmer": Domain(
        # 15 substeps of 2 ms.
        decimation=15,
        observations={
            "joints": mdp.JointPos(joints="joint_.*"),
            # In the head's frame, as seen from the swimmer.
            "to_target": Offset(
                ends=("command:target",), start="geom:nose", frame="body:head", axes="xy"
            ),
            "body_velocities": Readings(
                sensors=(
                    "head_vel.xy",
                    "head_gyro.z",
                    *(name for i in range(5) for name in (f"velocimeter_{i}.xy", f"gyro_{i}.z")),
                )
            ),
        },
        events=_OWN_RANGES,
        viewer=_beside("head", 1.5),
        playground={"decimation": 10, "sim": _iterations(4, 8, timestep=0.003)},
    ),
    "walker": Domain(
        decimation=10,
        observations={
            "orientations": _WALKER_POSE,
            "height": Offset(ends=("body:torso",), axes="z"),
            "velocity": _VELOCITY,
        },
        events=_OWN_RANGES,
        viewer=_beside("torso", 4.0),
        playground={
            "sim": _iterations(2, 5),
            # Playground calls it height; it is how upright the torso is.
            "observations": {
                "orientations": _WALKER_POSE,
                "height": BodyAxes(bodies="torso", entries=("zz",)),
                "velocity": _VELOCITY,
            },
        },
    ),
}
"""The domains by the name of their MJCF file."""
