"""Describes the pictures that a policy reads: the camera, and the processing of its pictures."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from tensordict.utils import NestedKey, unravel_key
from torchrl.envs.transforms import Transform

from ksim_rl.envs import ManagerBasedRlEnvCfg
from ksim_rl.export.exported_transforms import lag
from ksim_rl.export.refusal import NotDescribedError
from ksim_rl.export.standalone.description import LagSpec
from ksim_rl.export.standalone.files import Json
from ksim_rl.mdp import CameraImage
from ksim_rl.scene.sensors import CameraSensor
from ksim_rl.transforms import (
    ObservationDelay,
    ObservationHistory,
    ObservationHold,
    ObservationNoise,
    PictureEffects,
)
from ksim_rl.transforms.groups.group_cfg import ObservationGroupCfg, history_cfg


@dataclass(frozen=True, kw_only=True)
class PictureInput:
    """The pictures of one observation group, as a robot's camera would give them.

    Attributes:
        group, term: of the observation.
        camera: by its name in the model; `sensor` says how it draws.
        output: "rgb" or "depth".
        delay: the lag in env steps, as `lag` describes it.
        every, dropped: env steps from one picture to the next, and the share that is lost.
        length, stride: of the frames that the policy reads, stacked where `is_stacked`; the policy keeps them itself.
    """

    group: str
    term: str
    camera: str
    sensor: CameraSensor
    output: str
    delay: LagSpec | None = None
    every: int = 1
    dropped: float = 0.0
    length: int = 1
    stride: int = 1
    is_stacked: bool = False

    @property
    def name(self) -> str:
        """The input of `policy.onnx`."""
        return f"picture_{self.group}"

    @property
    def shape(self) -> tuple[int, ...]:
        """Of one picture: rows from the top, columns from the left, colors."""
        size = (self.sensor.height, self.sensor.width)
        if self.output == "rgb":
            return (*size, 3)
        return size

    @property
    def dtype(self) -> torch.dtype:
        """Of one picture: bytes of light, or distances in m."""
        if self.output == "rgb":
            return torch.uint8
        return torch.float32

    @property
    def is_late(self) -> bool:
        """Whether the policy reads other pictures than the moment's."""
        return self.delay is not None or self.every > 1 or self.dropped > 0.0

    def described(self) -> Json:
        """Return the entry of `export.json`."""
        sensor = self.sensor
        return {
            "input": self.name,
            "group": self.group,
            "camera": self.camera,
            "output": self.output,
            "shape": list(self.shape),
            "dtype": str(self.dtype).removeprefix("torch."),
            "max_depth": sensor.max_depth,
            "geom_groups": list(sensor.geom_groups),
            "textures": sensor.textures,
            "shadows": sensor.shadows,
            "every": self.every,
            "dropped": self.dropped,
            "delay": self.delay,
            "history_length": self.length,
            "history_stride": self.stride,
        }


@dataclass(frozen=True, kw_only=True)
class Sight:
    """The pictures that a policy reads, and the names of transforms that change them in training only."""

    pictures: Sequence[PictureInput]
    training_only: Sequence[str]


def describe_sight(cfg: ManagerBasedRlEnvCfg, groups: Sequence[NestedKey]) -> Sight:
    """Return the pictures among the observation groups of a policy.

    Raises NotDescribedError, naming the term or the transform, for one that an export cannot describe.
    """
    pictures = {}
    for group in groups:
        if not isinstance(group, str) or group not in cfg.observations:
            raise NotDescribedError(
                f"the policy reads {group!r}, which is none of task.observations: an export takes their groups alone"
            )
        if any(term.is_image for term in cfg.observations[group].terms.values()):
            pictures[group] = _of_group(cfg, group, cfg.observations[group])
    training_only = []
    for name, described in cfg.transforms.items():
        transform = described.build(name)
        written = {unravel_key(key) for key in transform.out_keys or ()}
        changed = [group for group in pictures if group in written]
        if not changed:
            continue
        if _is_of_training(transform, [pictures[group] for group in changed]):
            training_only.append(name)
            continue
        for group in changed:
            pictures[group] = _behind(pictures[group], transform, f"task.transforms.{name}")
    return Sight(pictures=list(pictures.values()), training_only=training_only)


def _of_group(cfg: ManagerBasedRlEnvCfg, group: str, given: ObservationGroupCfg) -> PictureInput:
    ((name, term),) = given.terms.items()
    where = f"task.observations.{group}.terms.{name}"
    image = term.term
    # Exact types: a subclass may compute something else.
    if type(image) is not CameraImage or image.output == "segmentation":
        raise NotDescribedError(
            f"{where}: {type(image).__name__} has no description: an export takes the rgb and the depth of CameraImage"
        )
    if term.noise is not None or term.clip is not None or term.scale not in (None, 1.0):
        raise NotDescribedError(
            f"{where}: an export takes pictures as they are: leave out noise, clip and scale"
        )
    sensor = cfg.scene.sensors[image.sensor]
    assert isinstance(sensor, CameraSensor)  # of a built env, whose terms were checked
    frames = history_cfg(term.history if term.history is not None else given.history)
    return PictureInput(
        group=group,
        term=name,
        camera=sensor.camera or image.sensor,
        sensor=sensor,
        output=image.output,
        delay=lag(term.delay) or lag(given.delay, shared=group),
        length=frames.length if frames else 1,
        stride=frames.stride if frames else 1,
        is_stacked=frames is not None,
    )


def _is_of_training(transform: Transform, pictures: Sequence[PictureInput]) -> bool:
    """Return whether a transform of pictures leaves them alone in evaluation."""
    if isinstance(transform, PictureEffects):
        for effect in transform.effects.values():
            for picture in pictures:
                shape = (1, *picture.shape, 1)[:4]
                # Crops are of the middle then, and no robot's camera would know.
                if tuple(effect.new_shape(shape)) != shape:
                    return False
        return True
    return isinstance(transform, ObservationNoise) or bool(
        getattr(transform, "acts_in_training_only", False)
    )


def _behind(picture: PictureInput, transform: Transform, where: str) -> PictureInput:
    """Return the description of a picture after a transform that also acts in evaluation."""
    kind = type(transform).__name__
    in_place = picture.group in {unravel_key(key) for key in transform.in_keys}
    # Frames that are stacked first would be late, or lost, as one.
    if in_place and not picture.is_stacked:
        # The last picture that has arrived is late, and not the other way round.
        if type(transform) is ObservationHold and picture.delay is None:
            return dataclasses.replace(picture, every=transform.every, dropped=transform.dropped)
        if type(transform) is ObservationDelay and picture.delay is None:
            return dataclasses.replace(picture, delay=lag(transform.delay))
        if type(transform) is ObservationHistory and not transform.flat:
            return dataclasses.replace(
                picture, length=transform.length, stride=transform.stride, is_stacked=True
            )
    raise NotDescribedError(
        f"{where}: {kind} makes pictures of the group {picture.group!r} that no robot's camera gives: an export takes "
        "PictureEffects without crops, then ObservationHold, ObservationDelay and ObservationHistory(flat=False), in "
        "this order and in place"
    )
