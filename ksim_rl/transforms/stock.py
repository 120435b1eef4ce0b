"""This module lists which of TorchRL's transforms a config may name, and says of each other one why it may not.

The list is that of TorchRL 0.14.1; a test compares it with `torchrl.envs.transforms.__all__`.
"""

from torchrl.envs.transforms import Transform

PACKAGE = "torchrl"

DATA = (
    "ActionDiscretizer",
    "ActionMask",
    "ActionScaling",
    "BinarizeReward",
    "CatFrames",
    "CatTensors",
    "CenterCrop",
    "ClipTransform",
    "Crop",
    "DiscreteActionProjection",
    "DoubleToFloat",
    "ExpandAs",
    "FlattenAction",
    "FlattenObservation",
    "GrayScale",
    "InitTracker",
    "LineariseRewards",
    "ObservationNorm",
    "PermuteTransform",
    "RemoveEmptySpecs",
    "RenameTransform",
    "RewardClipping",
    "RewardScaling",
    "RewardSum",
    "SignTransform",
    "SqueezeTransform",
    "Stack",
    "StepCounter",
    "SuccessReward",
    "TargetReturn",
    "TimeMaxPool",
    "ToTensorImage",
    "TrajCounter",
    "UnsqueezeTransform",
)
"""Transforms of an env whose arguments are numbers, names, keys and lists of these."""

_FUNCTION = "it takes a function, and a config holds data only; write a transform of your own in a plug-in"
_NETWORK = "it takes a network, and a config holds data only; write a transform of your own in a plug-in"
_DOWNLOAD = "it downloads a network"
_TOKENS = "it takes a tokenizer, which is no data"
_BATCH = "it works on batches of samples or whole trajectories, not in an env"
_BASE = "it is a base class that does nothing by itself"
_NO_TRANSFORM = "it is no transform"
_STEPS = "it steps the env itself, which a captured step cannot; `decimation` sets how long an action is held"
_SIMULATOR = "it is made for an env of another simulator"
_MACRO = "it plans motions of TorchRL's own robot envs"
_DRAWS = "its draws come from torch's global generator, so that a resumed run would not continue exactly"
_NAMELESS = "it takes its keys without names, which a config cannot give"

REFUSED = {
    "ActionChunkTransform": _BATCH,
    "ActionTokenizerTransform": _TOKENS,
    "AutoResetEnv": _NO_TRANSFORM,
    "AutoResetTransform": "the envs of this library reset the rows that are done themselves",
    "BatchSizeTransform": _FUNCTION,
    "BurnInTransform": _NETWORK,
    "CartesianSolver": _NO_TRANSFORM,
    "Compose": "`transforms` is a chain already: name its parts one by one",
    "ConditionalPolicySwitch": _FUNCTION,
    "ConditionalSkip": _FUNCTION,
    "DTypeCastTransform": "it takes torch dtypes, which are no data; `DoubleToFloat` needs none",
    "DecodeVideoTransform": _BATCH,
    "DeviceCastTransform": "a run has one device, which the setting `device` chooses",
    "EndOfLifeTransform": _SIMULATOR,
    "ExcludeTransform": f"{_NAMELESS}; `ksim_rl.envs.transforms.ObservationGroups` drops keys",
    "FiniteTensorDictCheck": "it makes the host wait in each step; envs and updates check what is finite themselves",
    "FrameSkipTransform": _STEPS,
    "Hash": _FUNCTION,
    "HumanoidMacroAction": _NO_TRANSFORM,
    "MacroAction": _NO_TRANSFORM,
    "MacroPrimitive": _NO_TRANSFORM,
    "MacroPrimitiveTransform": _MACRO,
    "MeanActionSelector": "it is made for the beliefs of TorchRL's own PILCO envs",
    "ModuleTransform": _NETWORK,
    "MultiAction": _STEPS,
    "MultiStepTransform": f"{_BATCH}; objectives have `advantage` and `n_step`",
    "NextObservationDelta": _BATCH,
    "NextStateReconstructor": _BATCH,
    "NoopResetEnv": _STEPS,
    "ObservationTransform": _BASE,
    "PinMemoryTransform": "observations are on the run's device already",
    "PolicyAgeFilter": _BATCH,
    "R3MTransform": _DOWNLOAD,
    "RNDTransform": _NETWORK,
    "RandomCropTensorDict": _BATCH,
    "RandomTruncationTransform": _DRAWS,
    "RayTransform": "it runs in another process",
    "Resize": "it needs torchvision, which is no part of this library",
    "Reward2GoTransform": _BATCH,
    "RobotMacroAction": _NO_TRANSFORM,
    "RobotMacroActionMode": _NO_TRANSFORM,
    "RunningMeanStd": _NO_TRANSFORM,
    "SatelliteAttitudeTransform": _MACRO,
    "SatelliteMacroAction": _NO_TRANSFORM,
    "SelectTransform": _NAMELESS,
    "TargetMacroAction": _NO_TRANSFORM,
    "TensorDictPrimer": "it takes specs; networks with a memory add the primers that they need",
    "TerminateTransform": f"{_FUNCTION}, or a termination term",
    "Timer": "it reads the host's clock, which a captured step cannot",
    "Tokenizer": _TOKENS,
    "Transform": _BASE,
    "TransformedEnv": _NO_TRANSFORM,
    "URScriptPrimitive": _NO_TRANSFORM,
    "URScriptPrimitiveTransform": _MACRO,
    "UnaryTransform": _FUNCTION,
    "VC1Transform": _DOWNLOAD,
    "VIPRewardTransform": _DOWNLOAD,
    "VIPTransform": _DOWNLOAD,
    "VecGymEnvTransform": _SIMULATOR,
    "VecNorm": "it shares its statistics by a lock; use `ksim_rl.envs.transforms.ObservationNormalization`",
    "VecNormV2": "it shares its statistics by a lock; use `ksim_rl.envs.transforms.ObservationNormalization`",
    "gSDENoise": f"{_DRAWS}; exploration belongs to the policy (`std_type`)",
}
"""All others, each with the reason."""


def check(transform: type[Transform]) -> None:
    """Refuse what is TorchRL's and not in `DATA`.

    Raises:
        ValueError: with the reason.
    """
    name = transform.__name__
    if transform.__module__.split(".")[0] == PACKAGE and name not in DATA:
        reason = REFUSED.get(name, "it is not in the list of those that are data")
        raise ValueError(f"TorchRL's {name} cannot be part of a config: {reason}")
