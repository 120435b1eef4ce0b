"""This module reads each observation term once, clean; what groups add is done by transforms."""

from collections.abc import Mapping

import torch
from jaxtyping import Shaped
from torch import Tensor

from ksim_rl.envs.driver import EnvDriver
from ksim_rl.transforms.groups.group_cfg import ObservationGroupCfg

IMAGE_DTYPES = (torch.float32, torch.int32, torch.uint8)


class ObservationManager:
    """Computes the union of the groups' terms; what groups add to them is done by transforms."""

    def __init__(self, groups: Mapping[str, ObservationGroupCfg], driver: EnvDriver) -> None:
        self._driver = driver
        self._view = view = driver.view
        self.terms = {name: cfg.term for group in groups.values() for name, cfg in group.terms.items()}
        for name, reading in self.read().items():
            if getattr(self.terms[name], "is_image", False):
                fits = reading.ndim in (3, 4) and reading.dtype in IMAGE_DTYPES
                expected = f"[{view.num_envs}, H, W] or [{view.num_envs}, H, W, C], float32, int32 or uint8"
            else:
                fits = reading.ndim == 2 and reading.dtype == torch.float32
                expected = f"torch.float32 [{view.num_envs}, L], one row per env"
            if not fits or reading.shape[0] != view.num_envs:
                raise ValueError(
                    f"observation term {name!r} returns {reading.dtype} {tuple(reading.shape)}: expected {expected}"
                )

    def read(self) -> dict[str, Shaped[Tensor, " E *?leaf"]]:
        """Return the readings of the current state by term, none of them aliasing the state.

        They are float32 [E, L], side by side in one tensor, and images [E, H, W] or [E, H, W, C].
        """
        readings, vectors = {}, []
        for name, term in self.terms.items():
            with self._driver.scope(f"observations/{name}"):
                readings[name] = term(self._view)
            if readings[name].ndim == 2 and readings[name].dtype == torch.float32:
                vectors.append(name)
            else:
                readings[name] = self._driver.detached(readings[name])
        if len(vectors) < 2:
            for name, value in readings.items():
                if value.is_floating_point() and value.ndim > 1:
                    flat_EL = value.flatten(1)
                    self._driver.non_finite.watch("observation", flat_EL, (name,), flat_EL.shape[1:])
            return {name: self._driver.detached(value) for name, value in readings.items()}
        # One copy for all of them, which also takes them off the state.
        together_EL = torch.cat([readings[name] for name in vectors], dim=1)
        widths = [readings[name].shape[1] for name in vectors]
        self._driver.non_finite.watch("observation", together_EL, vectors, widths)
        return readings | dict(zip(vectors, together_EL.split(widths, dim=1), strict=True))
