"""Undocumented interfaces of Hydra that the command line uses, checked with Hydra 1.3.7.

`tests/cli/test_upstream.py` names the part that a new version moved.
"""

import argparse
from collections.abc import Sequence

from hydra._internal.utils import get_args_parser


def parse_flags(arguments: Sequence[str]) -> tuple[argparse.Namespace, list[str]]:
    """Read Hydra's own flags from a command line; return them, and flags that Hydra does not know.

    Hydra does so only when the job starts, which is too late to check overrides before anything is written.
    """
    return get_args_parser().parse_known_intermixed_args(list(arguments))
