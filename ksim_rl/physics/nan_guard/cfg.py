"""This module holds the settings of the NaN guard."""

from dataclasses import dataclass

from ksim_rl.checks import check_count


@dataclass(frozen=True, kw_only=True)
class NanGuardCfg:
    """Keep the last substeps of each world, and save those of a world whose state became non-finite.

    Args:
        folder: where the files go; it is created with the world.
        history: substeps that are kept, on the device: 4 bytes for each number of a world's state, controls and
            applied forces (Go1: 0.7 kB per world and substep).
        max_files: most files that one world batch writes; further failures are only counted.
    """

    folder: str
    history: int = 20
    max_files: int = 4

    def __post_init__(self) -> None:
        if not isinstance(self.folder, str) or not self.folder:
            raise ValueError(f"folder={self.folder!r}: expected the path of a folder")
        check_count("history", self.history)
        check_count("max_files", self.max_files)
