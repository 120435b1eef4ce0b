"""Lists which of TorchRL's transforms a config may name, and says of each other one why it may not.

The list is of TorchRL 0.14.1; a test compares it with `torchrl.envs.transforms.__all__`.
"""

from torchrl.envs.transforms import Transform

PACKAGE = "torchrl"

_DATA = """
    ActionDiscretizer ActionMask ActionScaling BinarizeReward CatFrames CatTensors ClipTransform
    DiscreteActionProjection DoubleToFloat ExpandAs FlattenAction FlattenObservation GrayScale InitTracker
    LineariseRewards ObservationNorm PermuteTransform RemoveEmptySpecs RenameTransform RewardClipping RewardScaling
    RewardSum SignTransform SqueezeTransform Stack StepCounter SuccessReward TargetReturn TimeMaxPool ToTensorImage
    TrajCounter UnsqueezeTransform
"""
DATA = tuple(_DATA.split())
"""Transforms of an env whose arguments are numbers, names, keys and lists of these."""

_NO_DATA = "and a config holds data only; write a transform of your own in a plug-in"
_DRAWS = (
    "its draws come from torch's global generator, so that a resumed run would not continue exactly"
)
_NAMELESS = "it takes its keys without names, which a config cannot give"
_BATCH = "it works on batches of samples or whole trajectories, not in an env"
_FUNCTION = f"it takes a function, {_NO_DATA}"

_BY_REASON = {
    _BATCH: (
        "ActionChunkTransform DecodeVideoTransform NextObservationDelta NextStateReconstructor "
        "PolicyAgeFilter RandomCropTensorDict Reward2GoTransform"
    ),
    "it takes a tokenizer, which is no data": "ActionTokenizerTransform Tokenizer",
    "it is no transform": (
        "AutoResetEnv CartesianSolver HumanoidMacroAction MacroAction MacroPrimitive RobotMacroAction "
        "RobotMacroActionMode RunningMeanStd SatelliteMacroAction TargetMacroAction TransformedEnv "
        "URScriptPrimitive"
    ),
    "the envs of this library reset the rows that are done themselves": "AutoResetTransform",
    _FUNCTION: "BatchSizeTransform ConditionalPolicySwitch ConditionalSkip Hash UnaryTransform",
    f"it takes a network, {_NO_DATA}": "BurnInTransform ModuleTransform RNDTransform",
    "`transforms` is a chain already: name its parts one by one": "Compose",
    "it takes torch dtypes, which are no data; `DoubleToFloat` needs none": "DTypeCastTransform",
    "a run has one device, which the setting `device` chooses": "DeviceCastTransform",
    "it is made for an env of another simulator": "EndOfLifeTransform VecGymEnvTransform",
    f"{_NAMELESS}; `ksim_rl.envs.transforms.ObservationGroups` drops keys": "ExcludeTransform",
    "it makes the host wait in each step; envs and updates check what is finite themselves": (
        "FiniteTensorDictCheck"
    ),
    "it steps the env itself, which a captured step cannot; `decimation` sets how long an action is held": (
        "FrameSkipTransform MultiAction NoopResetEnv"
    ),
    "it plans motions of TorchRL's own robot envs": (
        "MacroPrimitiveTransform SatelliteAttitudeTransform URScriptPrimitiveTransform"
    ),
    "it is made for the beliefs of TorchRL's own PILCO envs": "MeanActionSelector",
    f"{_BATCH}; objectives have `advantage` and `n_step`": "MultiStepTransform",
    "it is a base class that does nothing by itself": "ObservationTransform Transform",
    "observations are on the run's device already": "PinMemoryTransform",
    "it downloads a network": "R3MTransform VC1Transform VIPRewardTransform VIPTransform",
    _DRAWS: "RandomTruncationTransform",
    "it runs in another process": "RayTransform",
    "it needs torchvision, which is no part of this library": "Resize",
    "it needs torchvision, which is no part of this library; `ksim_rl.envs.transforms.RandomCrop` crops": (
        "CenterCrop Crop"
    ),
    _NAMELESS: "SelectTransform",
    "it takes specs; recurrent networks add the primers that they need": "TensorDictPrimer",
    f"{_FUNCTION}, or a termination term": "TerminateTransform",
    "it reads the host's clock, which a captured step cannot": "Timer",
    "it shares its statistics by a lock; use `ksim_rl.envs.transforms.ObservationNormalization`": "VecNorm VecNormV2",
    f"{_DRAWS}; exploration belongs to the policy (`std_type`)": "gSDENoise",
}
REFUSED = {name: reason for reason, names in _BY_REASON.items() for name in names.split()}
"""All others, each with the reason."""


def check(transform: type[Transform]) -> None:
    """Refuse transforms of TorchRL that are not in `DATA`, with the reason."""
    name = transform.__name__
    if transform.__module__.split(".")[0] == PACKAGE and name not in DATA:
        reason = REFUSED.get(name, "it is not in the list of those that are data")
        raise ValueError(f"TorchRL's {name} cannot be part of a config: {reason}")
