"""`ksim-rl export` writes a policy, of a run or of the zoo, into a folder that runs without this library."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ksim_rl.checks import OneLineParser
from ksim_rl.cli.errors import say
from ksim_rl.export import export
from ksim_rl.export.standalone.files import Json
from ksim_rl.files.writing import check_place
from ksim_rl.terminal import show
from ksim_rl.zoo import locate, read_card

ZOO = "zoo:"


def run_export(arguments: Sequence[str]) -> int:
    """Run `ksim-rl export RUN`."""
    parser = OneLineParser(
        prog="ksim-rl export",
        description="Write a policy into a folder that runs without this library.",
    )
    parser.add_argument(
        "run", metavar="RUN", help="a run folder, one of its checkpoints, or zoo:NAME"
    )
    parser.add_argument(
        "--output", type=Path, metavar="DIR", help="default: export in the run folder"
    )
    parser.add_argument(
        "--episodes", type=int, default=100, help="to record for sim2sim; 0 for none"
    )
    parser.add_argument(
        "--seed", type=int, help="of the recorded episodes; default: the seed of evaluations"
    )
    parser.add_argument(
        "--device", default="cpu", help="of the recorded episodes: cpu, cuda or auto"
    )
    parser.add_argument(
        "--no-noise", dest="noise", action="store_false", help="record without sensors' noise"
    )
    options: Any = parser.parse_args(arguments)
    check_place("--output", options.output, is_folder=True)
    how = {"episodes": options.episodes, "seed": options.seed, "noise": options.noise}
    run = locate(options.run, note=say)
    folder = export(run, options.output, device=options.device, origin=_origin(options.run), **how)
    show(f"{folder}: see README.md in it; next: ksim-rl sim2sim {folder}")
    return 0


def _origin(text: str) -> Json:
    """Return the commit that trained a policy of the zoo, whose run folder has no record of it."""
    if not text.startswith(ZOO):
        return {}
    return {"commit": read_card(text.removeprefix(ZOO)).commit}
