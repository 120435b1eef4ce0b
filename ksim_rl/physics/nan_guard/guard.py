"""The NaN guard keeps the last substeps of each world on the device, and writes them to files for failed worlds."""

# pyright: reportIndexIssue=false, reportOperatorIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportAssignmentType=false, reportCallIssue=false

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Annotated

import mujoco
import numpy as np
import torch
import warp as wp
from jaxtyping import Int, Shaped
from torch import Tensor

from ksim_rl.checked import Checked, Count, Filled
from ksim_rl.physics.views import SUBSTEP_INPUTS

# A world is watched, has failed in this step, or has failed and its fields have been kept.
_WATCHED = 0
_FAILED = 1
_KEPT = 2


@dataclass(frozen=True, kw_only=True)
class NanGuardCfg(Checked):
    """Keep the last `history` substeps of each world, and save them for a world whose state became non-finite.

    That takes, on the device, 4 bytes for each number of a world's state, controls and applied forces (Go1: 0.7 kB per
    world and substep). Of one world batch at most `max_files` failures are saved; further ones are only counted.
    """

    folder: Annotated[str, Filled("expected the path of a folder")]
    history: Count = 20
    max_files: Count = 4

    def least_numbers(self, num_envs: int) -> Mapping[tuple[str, ...], float]:
        """Return the numbers of the substeps that are kept."""
        return {("history",): num_envs * self.history}


@dataclass(frozen=True, kw_only=True)
class NanReport:
    """Which worlds became non-finite since the last report, the files of up to `max_files` of them, and a line each."""

    worlds: tuple[int, ...] = ()
    files: tuple[Path, ...] = ()
    messages: tuple[str, ...] = ()

    @property
    def ok(self) -> bool:
        """Whether all worlds stayed finite."""
        return not self.worlds


@wp.kernel(enable_backward=False)
def keep_rows(
    rows: wp.array2d[float], failed: wp.array[int], count: wp.array[int], ring: wp.array3d[float]
):
    """Write each world's row into the next place of its ring, unless the world has failed."""
    world, i = wp.tid()
    # A failed world's ring stands still, so that its last substeps stay readable.
    if failed[world] == 0:
        ring[world, count[world] % ring.shape[1], i] = rows[world, i]


@wp.kernel(enable_backward=False)
def mark_failed(
    qpos: wp.array2d[float],
    qvel: wp.array2d[float],
    failed: wp.array[int],
    count: wp.array[int],
    reached_qpos: wp.array2d[float],
    reached_qvel: wp.array2d[float],
):
    """Count the substep; where the sum of the state is not finite, keep the state and stop the world's ring."""
    world = wp.tid()
    if failed[world] == 0:
        count[world] = count[world] + 1
        # One sum instead of a test of each number: a NaN or an infinity in any makes the sum non-finite.
        total = float(0.0)  # noqa: UP018 (Warp: a variable that changes in a loop)
        for i in range(qpos.shape[1]):
            total += qpos[world, i]
        for i in range(qvel.shape[1]):
            total += qvel[world, i]
        if not wp.isfinite(total):
            failed[world] = 1
            for i in range(qpos.shape[1]):
                reached_qpos[world, i] = qpos[world, i]
            for i in range(qvel.shape[1]):
                reached_qvel[world, i] = qvel[world, i]


class NanGuard:
    """Rings of the last substeps. A world's ring stops when its state becomes non-finite, until `report` reads it."""

    def __init__(
        self,
        cfg: NanGuardCfg,
        mj_model: mujoco.MjModel,
        state: Mapping[str, Shaped[Tensor, "*?shape"]],
        fields: Mapping[str, Shaped[Tensor, " E *?leaf"]],
        *,
        num_envs: int,
        by_warp: bool,
    ) -> None:
        self.cfg = cfg
        self._mj_model = mj_model
        # Found now, so that a missing package is named at construction.
        self._failures = _failures(cfg)
        self._launches = by_warp
        self._folder = Path(cfg.folder)
        # A folder that cannot be made fails here, before a run of hours.
        self._folder.mkdir(parents=True, exist_ok=True)
        self._written = 0
        self._names = [name for name in SUBSTEP_INPUTS if name in state and state[name].numel()]
        self._rows = [_as_rows(state[name], num_envs) for name in self._names]
        self._reached_from = {name: _as_rows(state[name], num_envs) for name in ("qpos", "qvel")}
        self._rings = [
            wp.zeros((num_envs, cfg.history, rows.shape[1]), dtype=float) for rows in self._rows
        ]
        self._failed = wp.zeros(num_envs, dtype=int)
        self._count = wp.zeros(num_envs, dtype=int)
        self._reached = {name: wp.zeros_like(rows) for name, rows in self._reached_from.items()}
        self._failed_E = wp.to_torch(self._failed)
        self._count_E = wp.to_torch(self._count)
        self._fields = dict(fields)
        # A reset draws new fields before the report is read: the failed world's are copied.
        self._kept_fields = {name: tensor.clone() for name, tensor in fields.items()}

    def before_substep(self) -> None:
        """Launch the copies of the state that the substep starts from."""
        if not self._launches:
            self._keep_rows()
            return
        for rows, ring in zip(self._rows, self._rings, strict=True):
            wp.launch(
                keep_rows, dim=rows.shape, inputs=[rows, self._failed, self._count], outputs=[ring]
            )

    def after_substep(self) -> None:
        """Launch the search for worlds that failed in this substep."""
        if not self._launches:
            self._mark_failed()
            return
        wp.launch(
            mark_failed,
            dim=self._failed.shape,
            inputs=[
                self._reached_from["qpos"],
                self._reached_from["qvel"],
                self._failed,
                self._count,
            ],
            outputs=[self._reached["qpos"], self._reached["qvel"]],
        )

    def _keep_rows(self) -> None:
        """Do the work of `keep_rows` by torch, where no kernel is to be compiled."""
        # Row numbers may wait for the device here, since this is the path of the C engine on a CPU.
        watched_E = (self._failed_E == _WATCHED).nonzero().flatten()
        places_E = (self._count_E % self.cfg.history)[watched_E].long()
        for rows, ring in zip(self._rows, self._rings, strict=True):
            wp.to_torch(ring)[watched_E, places_E] = wp.to_torch(rows)[watched_E]

    def _mark_failed(self) -> None:
        """Do the work of `mark_failed` by torch."""
        watched_E = self._failed_E == _WATCHED
        self._count_E += watched_E
        reached = {name: wp.to_torch(rows) for name, rows in self._reached_from.items()}
        total_E = reached["qpos"].sum(-1) + reached["qvel"].sum(-1)
        fails_E = watched_E & ~total_E.isfinite()
        self._failed_E[fails_E] = _FAILED
        for name, rows in reached.items():
            wp.to_torch(self._reached[name])[fails_E] = rows[fails_E]

    def keep_fields(self) -> None:
        """Copy the model fields of the worlds that just failed, before a reset draws new ones."""
        # A mask and no row numbers, for which the host would wait.
        fails_E = self._failed_E == _FAILED
        for name, field in self._fields.items():
            kept = self._kept_fields[name]
            # A mask [E] broadcasts over the leaf dims of the field.
            fails = fails_E.view(-1, *[1] * (field.ndim - 1))
            torch.where(fails, field, kept, out=kept)
        self._failed_E.masked_fill_(fails_E, _KEPT)

    def count(self) -> Int[Tensor, ""]:
        """Return the number of worlds that failed since the last report, on the device."""
        return (self._failed_E != _WATCHED).sum()

    def report(self) -> NanReport:
        """Write the worlds that failed since the last report, and watch them again; reads the device."""
        failed = (self._failed_E != _WATCHED).nonzero().flatten().cpu()
        worlds = tuple(int(world) for world in failed)
        if not worlds:
            return NanReport()
        files = []
        messages = []
        try:
            # At most `max_files` over the life of the guard, so that a broken run does not fill the disk.
            for world in worlds[: max(self.cfg.max_files - self._written, 0)]:
                files.append(self._write(world))
                messages.append(
                    f"world {world} became non-finite: python -m ksim_rl.physics.nan_guard.replay {files[-1]}"
                )
        # A full disk must not end the run: the failure is still named.
        except OSError as error:
            messages.append(
                f"world {worlds[len(files)]} became non-finite, and could not be saved: {error}"
            )
        self._failed_E.zero_()
        # Their rings start again from the first place.
        self._count_E[list(worlds)] = 0
        return NanReport(worlds=worlds, files=tuple(files), messages=tuple(messages))

    def forget(self) -> None:
        """Watch the worlds that failed again, without a report of them."""
        failed_E = self._failed_E != _WATCHED
        self._count_E.masked_fill_(failed_E, 0)
        self._failed_E.zero_()

    def _write(self, world: int) -> Path:
        count = int(self._count_E[world])
        history = self.cfg.history
        # The newest row stands at count - 1; fewer substeps than places leave the rest unused.
        places = [place % history for place in range(max(0, count - history), count)]
        failure = self._failures.Failure(
            mj_model=self._mj_model,
            world=world,
            substep=count,
            states={
                name: wp.to_torch(ring)[world].cpu().numpy()[places]
                for name, ring in zip(self._names, self._rings, strict=True)
            },
            reached={
                name: wp.to_torch(array)[world].cpu().numpy()
                for name, array in self._reached.items()
            },
            fields={
                name: np.asarray(kept[world].cpu()) for name, kept in self._kept_fields.items()
            },
        )
        path = self._folder / f"nan-{os.getpid()}-{self._written:03d}-world{world}.safetensors"
        self._failures.write(path, failure)
        self._written += 1
        return path


def _failures(cfg: NanGuardCfg) -> ModuleType:
    """Return the module of the files, imported where a guard is asked for: a world without one needs no safetensors."""
    try:
        from ksim_rl.physics.nan_guard import failures
    except ModuleNotFoundError as error:
        if error.name != "safetensors":
            raise
        raise ValueError(
            f"nan_guard={cfg}: its files need the package safetensors; install it"
        ) from error
    return failures


def _as_rows(tensor: Tensor, num_envs: int) -> wp.array:
    """Return a tensor as rows of floats, one per world, on the same memory."""
    return wp.from_torch(tensor.reshape(num_envs, -1), dtype=wp.float32)
