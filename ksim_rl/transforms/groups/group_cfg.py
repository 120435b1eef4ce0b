"""Observation groups are described by the configs of this module, and compiled into the transforms of this room."""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Protocol

from jaxtyping import Float32, Num
from tensordict import NestedKey
from torch import Tensor
from torchrl.envs.transforms import RenameTransform, Transform

from ksim_rl.checked import Checked, Filled
from ksim_rl.transforms.delay import DelayCfg, ObservationDelay
from ksim_rl.transforms.elementwise import (
    ObservationClip,
    ObservationScale,
    check_clip,
    check_scale,
)
from ksim_rl.transforms.groups.groups import ObservationGroups
from ksim_rl.transforms.history import HistoryCfg, ObservationHistory
from ksim_rl.transforms.noise.cfg import NoiseCfg, PerDim
from ksim_rl.transforms.noise.observation_noise import ObservationNoise
from ksim_rl.transforms.row_transform import follow_level


class Reading(Protocol):
    """Anything that reads an observation from the env's view: float32 [E, L]."""

    def __call__(self, view: Any) -> Num[Tensor, " E *L"]:
        """Return the clean reading of the current state."""
        ...


@dataclass(frozen=True, kw_only=True)
class ObservationTermCfg(Checked):
    """One term of a group; its chain runs in the order of the fields, each as the transform of that name."""

    term: Reading
    noise: NoiseCfg | None = None
    clip: tuple[float | None, float | None] | None = None
    scale: PerDim = 1.0
    delay: DelayCfg | None = None
    history: int | HistoryCfg | None = None

    def _check_fields(self) -> None:
        super()._check_fields()
        if not callable(self.term):
            raise ValueError(f"term={self.term!r}: expected a callable that reads the env's view")
        if self.clip is not None:
            check_clip("clip", self.clip)
        check_scale("scale", self.scale)
        frames = history_cfg(self.history)
        # Stacked frames are no columns of a vector.
        if frames is not None and not frames.flat:
            raise ValueError(
                "history.flat=False: frames in a vector are flat; stack frames of the whole group"
            )

    def least_numbers(self, num_envs: int) -> Mapping[tuple[str, ...], float]:
        """Return the numbers of a history that is given by its length."""
        return _numbers_of_frames(self.history, num_envs)

    @property
    def is_image(self) -> bool:
        """Whether the term reads an image, which is not put into a vector."""
        return bool(getattr(self.term, "is_image", False))


@dataclass(frozen=True, kw_only=True)
class ObservationGroupCfg(Checked):
    """A vector made of terms, concatenated in order; or one image, which stays one.

    The env writes the clean reading to `("obs", name)`; `keep_terms` also writes each term, as it stands in the vector,
    to `("<group>_terms", name)`. `delay` and `history` are for the terms that define none; these share one
    lag. A history with `flat=False` stacks the last vectors to [E, N, L]. `enable_noise=False` leaves out all noise.
    """

    terms: Annotated[Mapping[str, ObservationTermCfg], Filled("expected at least one term")]
    keep_terms: bool = False
    enable_noise: bool = True
    delay: DelayCfg | None = None
    history: int | HistoryCfg | None = None

    def _check_fields(self) -> None:
        super()._check_fields()
        history_cfg(self.history)
        # An image has no place in a vector.
        images = [name for name, cfg in self.terms.items() if cfg.is_image]
        if images and len(self.terms) > 1:
            other = next(name for name in self.terms if name != images[0])
            raise ValueError(
                f"terms: {images[0]!r} is an image, which is not concatenated with {other!r}: "
                "give it a group of its own"
            )
        # Both kinds of history are flat where they are given by their length.
        for name in images:
            for where, history in (
                (f"terms.{name}.", self.terms[name].history),
                ("", self.history),
            ):
                frames = history_cfg(history)
                if frames is not None and frames.flat:
                    raise ValueError(
                        f"{where}history would flatten the image {name!r}: stack the frames of its group, "
                        f"history=HistoryCfg(length={frames.length}, flat=False)"
                    )

    def least_numbers(self, num_envs: int) -> Mapping[tuple[str, ...], float]:
        """Return the numbers of a history that is given by its length."""
        return _numbers_of_frames(self.history, num_envs)

    @property
    def num_stacked(self) -> int | None:
        """How many vectors or images the group stacks, or None where there is no dim of frames."""
        frames = history_cfg(self.history)
        if frames is None or frames.flat:
            return None
        return frames.length

    def num_frames(self, term: str) -> int:
        """Return how many frames of a term the vector holds side by side."""
        for history in (self.terms[term].history, self.history):
            if history is not None:
                frames = history_cfg(history)
                if frames is not None and frames.flat:
                    return frames.length
                return 1
        return 1


def _numbers_of_frames(
    history: int | HistoryCfg | None, num_envs: int
) -> Mapping[tuple[str, ...], float]:
    # A config of its own tells for itself.
    if isinstance(history, int):
        return {("history",): num_envs * history}
    return {}


def history_cfg(history: int | HistoryCfg | None) -> HistoryCfg | None:
    """Return the full config of a history, or None where it is the present frame only."""
    if history is None:
        return None
    try:
        if isinstance(history, HistoryCfg):
            cfg = history
        else:
            cfg = HistoryCfg(length=history)
    except ValueError as error:
        raise ValueError(f"history.{error}") from None
    # One flat frame is the observation itself.
    if cfg.length > 1 or not cfg.flat:
        return cfg
    return None


def compile_groups(
    groups: Mapping[str, ObservationGroupCfg], *, level: Float32[Tensor, ""] | None = None
) -> list[Transform]:
    """Return the transforms that write each group's vector, or image, under the group's name.

    Per group: noise -> clip -> scale -> delay -> history -> concatenate. A term without any of these goes straight
    from `("obs", name)` into the vector; the others pass through `("<group>_terms", name)`, which only groups with
    `keep_terms` keep. Transforms with `by_level` follow `level`, where it is given.
    """
    transforms: list[Transform] = []
    vectors: dict[NestedKey, list[NestedKey]] = {}
    stacked: list[Transform] = []
    images: list[Transform] = []
    drop: list[NestedKey] = []
    for group, cfg in groups.items():
        # Per group: first the chains of single terms, then the vector of all of them.
        terms = {name: _completed(term, cfg) for name, term in cfg.terms.items()}
        chained = {name: term for name, term in terms.items() if _has_chain(term)}
        transforms += _chain(group, cfg, chained)
        # Terms without a chain go into the vector straight from the env.
        plain = [name for name in terms if name not in chained]
        if cfg.keep_terms and plain:
            transforms.append(
                RenameTransform(
                    [("obs", name) for name in plain],
                    [_term_key(group, name) for name in plain],
                    create_copy=True,
                )
            )
        keys: list[NestedKey] = [
            _term_key(group, name) if name in chained else ("obs", name) for name in terms
        ]
        # Stacked histories are of whole vectors, so they come after all groups are made.
        frames = history_cfg(cfg.history)
        if frames is not None and not frames.flat:
            stacked.append(ObservationHistory([group], [group], **vars(frames)))
        # An image is the group's only term, and only takes the group's name.
        if any(term.is_image for term in terms.values()):
            images.append(RenameTransform(keys, [group], create_copy=bool(plain) or cfg.keep_terms))
            continue
        vectors[group] = keys
        # The steps of a chain are no observations of the env, unless they are asked for.
        if not cfg.keep_terms:
            drop += [_term_key(group, name) for name in chained]
    transforms += images
    if vectors:
        transforms.append(ObservationGroups(vectors, drop=drop))
    transforms += stacked
    if level is not None:
        follow_level(transforms, level)
    return transforms


def _completed(term: ObservationTermCfg, group: ObservationGroupCfg) -> ObservationTermCfg:
    """Return the term with the settings that its group decides."""
    frames = history_cfg(group.history)
    return dataclasses.replace(
        term,
        noise=term.noise if group.enable_noise else None,
        delay=term.delay or group.delay,
        history=term.history
        if term.history is not None or frames is None or not frames.flat
        else frames,
    )


def _chain(
    group: str, cfg: ObservationGroupCfg, terms: Mapping[str, ObservationTermCfg]
) -> list[Transform]:
    """Return the transforms of the terms that need some; each term starts at its clean reading."""
    transforms: list[Transform] = []
    current: dict[str, NestedKey] = {name: ("obs", name) for name in terms}

    # Each stage reads a term where the last one has left it, and writes to the term's own key.
    def advance(names: list[str]) -> tuple[list[NestedKey], list[NestedKey]]:
        in_keys = [current[name] for name in names]
        current.update({name: _term_key(group, name) for name in names})
        return in_keys, [current[name] for name in names]

    noisy = {name: term.noise for name, term in terms.items() if term.noise is not None}
    if noisy:
        transforms.append(ObservationNoise(*advance(list(noisy)), noise=list(noisy.values())))
    makers: dict[str, tuple[Any, Any]] = {
        "clip": (ObservationClip, None),
        "scale": (ObservationScale, 1.0),
    }
    for field, (make, neutral) in makers.items():
        # Terms with the same stage share one transform, which saves launches.
        given = {
            name: value
            for name, term in terms.items()
            if (value := getattr(term, field)) != neutral
        }
        if given:
            in_keys, out_keys = advance(list(given))
            by_key = dict(zip(in_keys, given.values(), strict=True))
            transforms.append(make(in_keys, out_keys, **{field: by_key}))
    for name, term in terms.items():
        if term.delay is not None and cfg.terms[name].delay is not None:
            # One transform per term: each sensor has its own lag.
            transforms.append(ObservationDelay(*advance([name]), delay=term.delay))
    # Terms without their own delay share one lag, as signals that come by one bus do.
    sharing = [name for name in terms if cfg.terms[name].delay is None]
    if cfg.delay is not None and sharing:
        transforms.append(ObservationDelay(*advance(sharing), delay=cfg.delay))
    # Histories of the same length and stride share one ring.
    by_frames: dict[HistoryCfg, list[str]] = {}
    for name, term in terms.items():
        if (frames := history_cfg(term.history)) is not None:
            by_frames.setdefault(frames, []).append(name)
    for frames, names in sorted(
        by_frames.items(), key=lambda item: (item[0].length, item[0].stride)
    ):
        transforms.append(ObservationHistory(*advance(names), **vars(frames)))
    return transforms


def _has_chain(term: ObservationTermCfg) -> bool:
    steps = (term.noise, term.clip, term.delay, history_cfg(term.history))
    return any(step is not None for step in steps) or term.scale != 1.0


def _term_key(group: str, name: str) -> NestedKey:
    return (f"{group}_terms", name)
