"""What the command line uses of Hydra beyond its documents is still there; each failure names the thing that moved."""

from importlib.metadata import version

import pytest

from ksim_rl.cli import upstream

FLAGS = (
    "help",
    "hydra_help",
    "shell_completion",
    "cfg",
    "info",
    "multirun",
    "config_dir",
    "config_name",
)


@pytest.mark.parametrize("flag", [*FLAGS, "config_path", "overrides"])
def test_hydras_parser_knows_the_flags_that_we_read(flag):
    known, unknown = upstream.parse_flags(["--multirun", "seed=1", "--seed=2"])
    flags = vars(known)
    assert unknown == ["--seed=2"]
    assert flag in flags, f"Hydra {version('hydra-core')}: get_args_parser has no {flag}"
    assert flags["overrides"] == ["seed=1"] and flags["multirun"]
