"""The entries of export.json, as types: the description of a folder's policy and of the env that it was trained in."""

from collections.abc import Sequence
from typing import Any, Literal, TypeAlias, TypedDict


class LagSpec(TypedDict):
    """By how many steps a value comes late; values with one `shared` name draw the same lag."""

    min: int
    max: int
    resample_every: int  # 0 keeps an episode's lag
    hold_probability: float
    shared: str | None
    initial: float | list[float] | None  # before the first value; null is that value


class NoiseSpec(TypedDict):
    """A sensor's errors, with a number for each column; draws become offset + spread * draw."""

    draw: str
    offset: list[float]
    spread: list[float]
    operation: str
    bias: "NoiseSpec | None"
    walk_std: list[float]
    resolution: list[float]
    dropout: float
    lost: str


class TermSpec(TypedDict):
    """How the readings of an observation term are processed on their way to the policy."""

    name: str
    size: int  # of one frame
    noise: NoiseSpec | None
    clip: list[float | None]
    scale: list[float]
    delay: LagSpec | None
    history_length: int
    history_stride: int


class ObservationSpec(TermSpec):
    """A term with the inputs of obs.onnx that it reads."""

    reads: list[str]


class ShapeSpec(TypedDict):
    """How numbers of an action become targets: clip, tanh, scale, filter and offset, in this order."""

    clip: tuple[float, float] | None
    tanh: bool
    scale: float | list[float]
    offset: float | list[float]
    alpha: float | None


Edges: TypeAlias = tuple[float, float] | tuple[list[float], list[float]]
"""The lower and the upper limit, of all columns or of each."""


class ControlSpec(ShapeSpec):
    """Columns of an action that are controls of actuators, without a joint's target in between."""

    name: str
    columns: list[int]
    kind: Literal["ctrl"]
    names: list[str]
    limits: Edges


class _OfVelocity(TypedDict, total=False):
    velocity: ShapeSpec  # of the second half of the columns, where there is one


class JointActionSpec(ShapeSpec, _OfVelocity):
    """Columns of an action that are targets of joints."""

    name: str
    columns: list[int]
    kind: Literal["pos", "vel", "effort"]
    names: list[str]
    limits: Edges
    relative: bool  # to the encoders
    from_default: bool


ActionSpec: TypeAlias = ControlSpec | JointActionSpec


class DelayStage(LagSpec):
    """A delay of actions."""

    kind: Literal["delay"]


class LowPassStage(TypedDict):
    """A filter of actions."""

    kind: Literal["low_pass"]
    alpha: float
    initial: float | None


class ClipStage(TypedDict):
    """A clip of actions."""

    kind: Literal["clip"]
    low: float | None
    high: float | None


class ScaleStage(TypedDict):
    """Factors of actions, and offsets that are added to the product."""

    kind: Literal["scale"]
    scale: float | Sequence[float]
    offset: float | Sequence[float]


StageSpec: TypeAlias = DelayStage | LowPassStage | ClipStage | ScaleStage
"""What an action passes on its way to the action terms."""


class LawSpec(TypedDict):
    """The drives of some joints: a law that runs before each substep, or MuJoCo's servos ("builtin")."""

    kind: str
    joints: list[str]
    takes: list[str]  # kinds of targets
    numbers: dict[str, list[float]]
    actuators: list[str]
    # Of the lines that make controls of targets.
    scale: list[float]
    offset: list[float]
    delay: LagSpec | None


class _OfCommand(TypedDict, total=False):
    kind: str
    low: list[float] | None
    high: list[float] | None


class CommandSpec(_OfCommand):
    """How many numbers a command has, and the range that the policy has seen; older folders have no range."""

    size: int


class ContactSpec(TypedDict):
    """The sensors of the exported model that make up a contact sensor."""

    elements: list[str]
    strongest: bool
    every_substep: bool


class _OfState(TypedDict, total=False):
    starts_with: str
    of: str
    columns: list[int] | None


class StateSpec(_OfState):
    """An input that is fed by an output of the step before."""

    input: str
    output: str


class LimitsSpec(TypedDict):
    """Limits of each joint; null where there is none."""

    position: list[list[float | None]]
    effort: list[float | None]
    velocity: list[float | None]


class JointsSpec(TypedDict):
    """The hinges and slides of the robot, with a number for each."""

    names: list[str]
    default_pos: list[float]
    stiffness: list[float]
    damping: list[float]
    effort_scale: list[float]
    limits: LimitsSpec


class GraphSpec(TypedDict):
    """The inputs of an ONNX file of terms: measurements, each with its input's name, and states."""

    output: str
    # Each has the entries that its quantity has.
    measurements: list[dict[str, Any]]
    states: list[StateSpec]


class PolicySpec(TypedDict):
    """The inputs and outputs of policy.onnx."""

    inputs: list[str]
    outputs: list[str]
    states: list[StateSpec]
    num_actions: int
    obs_dim: int
    difference: float  # from the policy in torch


class RewardSpec(TypedDict):
    """A reward that scores.onnx computes."""

    weight: float


class EndingSpec(TypedDict):
    """A termination that scores.onnx computes."""

    time_out: bool


class _OfRun(TypedDict, total=False):
    task: str
    engine: str
    noisy: bool
    left_out: list[str]
    pictures: list[dict[str, Any]]
    ours: dict[str, list[float]] | None


class Export(_OfRun):
    """The content of export.json."""

    joint_names: list[str]
    joints: JointsSpec
    observations: list[ObservationSpec]
    obs: GraphSpec | None
    scores: GraphSpec | None
    policy: PolicySpec
    actions: list[ActionSpec]
    action_chain: list[StageSpec]
    actuators: list[LawSpec]
    commands: dict[str, CommandSpec]
    contacts: dict[str, ContactSpec]
    rewards: dict[str, RewardSpec]
    terminations: dict[str, EndingSpec]
    metrics: list[str]
    scale_rewards_by_dt: bool
    physics_dt: float
    decimation: int
    step_dt: float
    episode_steps: int  # 0 where episodes have no end
