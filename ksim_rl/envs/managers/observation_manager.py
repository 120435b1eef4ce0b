"""Reads each observation term once, without noise; transforms add noise, delay and history of the groups."""

from collections.abc import Mapping
from contextlib import nullcontext

import torch
from jaxtyping import Bool, Shaped
from torch import Tensor

from ksim_rl.envs.driver import EnvDriver
from ksim_rl.scene.state.buffers import Kept, only_in_rows
from ksim_rl.transforms.groups.group_cfg import ObservationGroupCfg

IMAGE_DTYPES = (torch.float32, torch.int32, torch.uint8)


class ObservationManager:
    """Computes the union of the groups' terms; transforms add noise, delay and the like for each group.

    `examples` are readings of no state in particular, without memory, which have the shapes and types of all others.
    """

    def __init__(self, groups: Mapping[str, ObservationGroupCfg], driver: EnvDriver) -> None:
        self._driver = driver
        self._view = driver.view
        self.terms = {
            name: cfg.term for group in groups.values() for name, cfg in group.terms.items()
        }
        # The buffers that each term writes whenever it is read; most write none.
        self._kept: dict[str, dict[str, Kept]] = {}
        self._shapes: dict[str, torch.Size] = {}
        # Reads each term once: wrong names and shapes are errors now.
        readings = self.read()
        self.examples = {name: reading.to("meta") for name, reading in readings.items()}

    def read(
        self, reset_E: Bool[Tensor, " E"] | None = None
    ) -> dict[str, Shaped[Tensor, " E *?leaf"]]:
        """Return the readings of the current state by term, in memory that no other code reads or writes.

        They are float32 [E, L], side by side in one tensor, and images [E, H, W] or [E, H, W, C]. Buffers of terms
        advance in all rows, once per env step, or after a reset in the rows of `reset_E` only; readings of other rows
        then mean nothing.
        """
        readings: dict[str, Tensor] = {}
        vectors: list[str] = []
        for name in self.terms:
            reading = self._read_one(name, reset_E)
            readings[name] = reading
            # Vectors can be joined; images and other dtypes stay on their own.
            if reading.ndim == 2 and reading.dtype == torch.float32:
                vectors.append(name)
        for name, reading in readings.items():
            # A term may return a window onto the state, or a quantity that others read too.
            if name not in vectors or len(vectors) == 1:
                readings[name] = reading.clone()
        watch = self._driver.non_finite.watch
        # Nothing to join: each reading was cloned above.
        if len(vectors) < 2:
            for name, value in readings.items():
                if value.is_floating_point() and value.ndim > 1:
                    flat_EL = value.flatten(1)
                    watch("observation", flat_EL, (name,), flat_EL.shape[1:])
            return readings
        # One copy for all of them, which also takes them off the state.
        together_EL = torch.cat([readings[name] for name in vectors], dim=1)
        widths = [readings[name].shape[1] for name in vectors]
        watch("observation", together_EL, vectors, widths)
        # Each vector is a window [E, L] onto the joined tensor.
        return readings | dict(zip(vectors, together_EL.split(widths, dim=1), strict=True))

    def rehearse(self) -> None:
        """Read each term once more; the caller puts back what changes."""
        self.read()

    def _read_one(self, name: str, reset_E: Tensor | None) -> Tensor:
        kept = self._kept.setdefault(name, {})
        rows = nullcontext()
        # After a reset, a term with memory advances in the rows that begin; the others have had their step.
        if reset_E is not None and kept:
            rows = only_in_rows(reset_E, list(kept.values()), is_step=False)
        with rows:
            with self._driver.scope(f"observations/{name}", part=self.terms[name]) as written:
                reading = self.terms[name](self._view)
                if not isinstance(reading, Tensor):
                    raise ValueError(
                        f"returns {type(reading).__name__}: expected a tensor, one row per env"
                    )
            kept.update(written)
        # The cheap comparison first, as this runs for each term in each eager step.
        if self._shapes.get(name) != reading.shape:
            self._check_shape(name, reading)
        return reading

    def _check_shape(self, name: str, reading: Tensor) -> None:
        """Refuse a reading that is none, or has another shape than the first one of its term."""
        num_envs = self._view.num_envs
        given = f"{reading.dtype} {tuple(reading.shape)}"
        if name in self._shapes:
            raise ValueError(
                f"observation term {name!r} returns {given}, and first had shape {tuple(self._shapes[name])}: expected "
                "the same in each step"
            )
        if getattr(self.terms[name], "is_image", False):
            fits = reading.ndim in (3, 4) and reading.dtype in IMAGE_DTYPES
            expected = f"[{num_envs}, H, W] or [{num_envs}, H, W, C], float32, int32 or uint8"
        else:
            fits = reading.ndim == 2 and reading.dtype == torch.float32
            expected = f"torch.float32 [{num_envs}, L], one row per env"
        if not fits or reading.shape[0] != num_envs:
            raise ValueError(f"observation term {name!r} returns {given}: expected {expected}")
        self._shapes[name] = reading.shape
