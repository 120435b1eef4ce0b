"""Rules for the names and overrides of a table, which is data as a run folder is, after Hydra's own parsing."""

import re

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException

from ksim_rl.config.plain_data import check_plain

# Names of tables, groups and rows become parts of paths.
NAME = re.compile(r"\w[\w .+-]{0,99}")
# Fields of a run's config that a row has under other names.
OF_ROWS = ("task", "objective", "seed", "trainer.num_iterations")


def check_name(what: str, name: object) -> None:
    """Refuse a name that would lead out of the folder that is named by it."""
    if NAME.fullmatch(str(name)) is None:
        raise ValueError(
            f"{what} {str(name)[:100]!r}: expected letters, digits and '_ .+-', with a letter, a digit or _ in front"
        )


def check_override(text: str) -> None:
    r"""Refuse an override that is more than a value for a field, or a choice of a group.

    It is parsed first, since Hydra takes the text `$\{oc.env\:NAME\}` for an interpolation, too.
    """
    try:
        parsed = OverridesParser.create().parse_override(text)
    except HydraException as error:
        raise ValueError(
            f"overrides: {text!r} does not parse: {str(error).splitlines()[0]}"
        ) from None
    key = parsed.key_or_group
    if key in OF_ROWS:
        raise ValueError(f"overrides: {text!r} has a field of its own in the row")
    if parsed.is_sweep_override():
        raise ValueError(f"overrides: {text!r} has several values: write a row for each")
    if parsed.is_hydra_override() or key.partition("/")[0] == "hydra" or parsed.package is not None:
        raise ValueError(
            f"overrides: {text!r} is for Hydra itself, and a table holds fields of runs only"
        )
    check_plain(parsed.value(), f"overrides: {key}")
