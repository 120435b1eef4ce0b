"""Observation groups are described by the configs of this module, which `compile_groups` turns into transforms."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from jaxtyping import Num
from torch import Tensor

from ksim_rl.transforms.clip import check_clip
from ksim_rl.transforms.history import HistoryCfg
from ksim_rl.transforms.lagged_transform import DelayCfg
from ksim_rl.transforms.noise.cfg import NoiseCfg, PerDim
from ksim_rl.transforms.scale import check_scale


class Reading(Protocol):
    """Anything that reads an observation from the env's view: float32 [E, L]."""

    def __call__(self, view: Any) -> Num[Tensor, " E *L"]:
        """Return the clean reading of the current state."""
        ...


@dataclass(frozen=True, kw_only=True)
class ObservationTermCfg:
    """One term of a group; its chain runs in the order of the fields.

    Args:
        term: what reads the clean observation.
        noise: sensor noise.
        clip: (low, high); None is no limit on that side.
        scale: factor, or one per element.
        delay: sensor latency in env steps.
        history: number of frames, or these with a stride; 1 and None are the present one alone.
    """

    term: Reading
    noise: NoiseCfg | None = None
    clip: tuple[float | None, float | None] | None = None
    scale: PerDim = 1.0
    delay: DelayCfg | None = None
    history: int | HistoryCfg | None = None

    def __post_init__(self) -> None:
        if not callable(self.term):
            raise ValueError(f"term={self.term!r}: expected a callable that reads the env's view")
        if self.noise is not None and not isinstance(self.noise, NoiseCfg):
            raise ValueError(f"noise={self.noise!r}: expected UniformNoise, GaussianNoise or ConstantNoise")
        if self.clip is not None:
            check_clip("clip", self.clip)
        check_scale("scale", self.scale)
        frames = history_cfg(self.history)
        if frames is not None and not frames.flat:
            raise ValueError(
                "history.flat=False: frames in a vector are flat; stack those of the whole group"
            )

    @property
    def is_image(self) -> bool:
        """Whether the term reads an image, which is not put into a vector."""
        return bool(getattr(self.term, "is_image", False))


@dataclass(frozen=True, kw_only=True)
class ObservationGroupCfg:
    """A vector made of terms, concatenated in order; or one image, which stays one.

    Args:
        terms: by name; the env writes the clean reading to `("obs", name)`.
        keep_terms: whether each term, as it stands in the vector, is also written to `("<group>_terms", name)`.
        enable_noise: False leaves all noise of the group out.
        delay: sensor latency of the terms that have none of their own; these share one lag.
        history: frames of the terms that have none of their own. With `flat=False` it is the last vectors instead,
            stacked to [E, N, L].
    """

    terms: Mapping[str, ObservationTermCfg]
    keep_terms: bool = False
    enable_noise: bool = True
    delay: DelayCfg | None = None
    history: int | HistoryCfg | None = None

    def __post_init__(self) -> None:
        if not self.terms:
            raise ValueError("terms={}: expected at least one term")
        history_cfg(self.history)
        images = [name for name, cfg in self.terms.items() if cfg.is_image]
        if images and len(self.terms) > 1:
            other = next(name for name in self.terms if name != images[0])
            raise ValueError(
                f"terms: {images[0]!r} is an image, which is not concatenated with {other!r}: "
                "give it a group of its own"
            )

    def num_frames(self, term: str) -> int:
        """Return how many frames of a term the vector holds side by side."""
        for history in (self.terms[term].history, self.history):
            if history is not None:
                frames = history_cfg(history)
                return frames.length if frames is not None and frames.flat else 1
        return 1


def history_cfg(history: int | HistoryCfg | None) -> HistoryCfg | None:
    """Return what a history is in full, or None where it is the present frame alone.

    Raises:
        ValueError: if a number of frames is not valid.
    """
    if history is None:
        return None
    try:
        cfg = history if isinstance(history, HistoryCfg) else HistoryCfg(length=history)
    except ValueError as error:
        raise ValueError(f"history.{error}") from None
    return cfg if cfg.length > 1 or not cfg.flat else None
