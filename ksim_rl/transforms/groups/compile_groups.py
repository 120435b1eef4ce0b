"""This module compiles observation groups into transforms, the same ones that a user composes by hand."""

import dataclasses
from collections.abc import Mapping

from jaxtyping import Float32
from tensordict import NestedKey
from torch import Tensor
from torchrl.envs.transforms import RenameTransform, Transform

from ksim_rl.transforms.clip import ObservationClip
from ksim_rl.transforms.delay import ObservationDelay
from ksim_rl.transforms.groups.group_cfg import ObservationGroupCfg, ObservationTermCfg, history_cfg
from ksim_rl.transforms.groups.groups import ObservationGroups
from ksim_rl.transforms.history import HistoryCfg, ObservationHistory
from ksim_rl.transforms.level import follow_level
from ksim_rl.transforms.noise.observation_noise import ObservationNoise
from ksim_rl.transforms.scale import ObservationScale


def compile_groups(
    groups: Mapping[str, ObservationGroupCfg], *, level: Float32[Tensor, ""] | None = None
) -> list[Transform]:
    """Return the transforms that write each group's vector, or image, under the group's name.

    Per group: noise -> clip -> scale -> delay -> history -> concatenate. A term without any of these goes straight
    from `("obs", name)` into the vector; the others pass through `("<group>_terms", name)`, which only groups with
    `keep_terms` keep.

    Args:
        groups: by name.
        level: what transforms with `by_level` follow, float32 []; None leaves them at 1.
    """
    transforms: list[Transform] = []
    vectors: dict[NestedKey, list[NestedKey]] = {}
    stacked: list[Transform] = []
    images: list[Transform] = []
    drop: list[NestedKey] = []
    for group, cfg in groups.items():
        terms = {name: _completed(term, cfg) for name, term in cfg.terms.items()}
        chained = {name: term for name, term in terms.items() if _has_chain(term)}
        transforms += _chain(group, cfg, chained)
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
        frames = history_cfg(cfg.history)
        if frames is not None and not frames.flat:
            stacked.append(_history([group], [group], frames))
        if any(term.is_image for term in terms.values()):
            images.append(RenameTransform(keys, [group], create_copy=bool(plain) or cfg.keep_terms))
            continue
        vectors[group] = keys
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
    """Return the term with what the group decides for it."""
    frames = history_cfg(group.history)
    return dataclasses.replace(
        term,
        noise=term.noise if group.enable_noise else None,
        delay=term.delay or group.delay,
        history=term.history if term.history is not None or frames is None or not frames.flat else frames,
    )


def _chain(group: str, cfg: ObservationGroupCfg, terms: Mapping[str, ObservationTermCfg]) -> list[Transform]:
    """Return the transforms of the terms that need some; each term starts at its clean reading."""
    transforms: list[Transform] = []
    current: dict[str, NestedKey] = {name: ("obs", name) for name in terms}

    def advance(names: list[str]) -> tuple[list[NestedKey], list[NestedKey]]:
        in_keys = [current[name] for name in names]
        current.update({name: _term_key(group, name) for name in names})
        return in_keys, [current[name] for name in names]

    noisy = {name: term.noise for name, term in terms.items() if term.noise is not None}
    if noisy:
        transforms.append(ObservationNoise(*advance(list(noisy)), noise=list(noisy.values())))
    clipped = [name for name, term in terms.items() if term.clip is not None]
    if clipped:
        in_keys, out_keys = advance(clipped)
        clips = {key: terms[name].clip for key, name in zip(in_keys, clipped, strict=True)}
        transforms.append(ObservationClip(in_keys, out_keys, clip=clips))  # pyright: ignore[reportArgumentType]
    scaled = [name for name, term in terms.items() if term.scale != 1.0]
    if scaled:
        in_keys, out_keys = advance(scaled)
        scales = {key: terms[name].scale for key, name in zip(in_keys, scaled, strict=True)}
        transforms.append(ObservationScale(in_keys, out_keys, scale=scales))
    for name, term in terms.items():
        if term.delay is not None and cfg.terms[name].delay is not None:
            # One transform per term: each sensor has a lag of its own.
            transforms.append(ObservationDelay(*advance([name]), delay=term.delay))
    sharing = [name for name in terms if cfg.terms[name].delay is None]
    if cfg.delay is not None and sharing:
        transforms.append(ObservationDelay(*advance(sharing), delay=cfg.delay))
    by_frames: dict[HistoryCfg, list[str]] = {}
    for name, term in terms.items():
        if (frames := history_cfg(term.history)) is not None:
            by_frames.setdefault(frames, []).append(name)
    for frames, names in sorted(by_frames.items(), key=lambda item: (item[0].length, item[0].stride)):
        transforms.append(_history(*advance(names), frames))
    return transforms


def _history(in_keys: list[NestedKey], out_keys: list[NestedKey], frames: HistoryCfg) -> Transform:
    return ObservationHistory(in_keys, out_keys, length=frames.length, stride=frames.stride, flat=frames.flat)


def _has_chain(term: ObservationTermCfg) -> bool:
    steps = (term.noise, term.clip, term.delay, history_cfg(term.history))
    return any(step is not None for step in steps) or term.scale != 1.0


def _term_key(group: str, name: str) -> NestedKey:
    return (f"{group}_terms", name)
