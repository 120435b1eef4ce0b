"""`ksim-rl play` shows a policy, or an agent without one: as a video, in a browser or in MuJoCo's window."""

import argparse
import dataclasses
import importlib
import importlib.util
import os
from collections.abc import Callable
from contextlib import ExitStack, closing
from pathlib import Path
from urllib.parse import urlsplit

from torchrl.envs import EnvBase

from ksim_rl.checks import OneLineParser, check_count, check_in_range
from ksim_rl.device.kernel_loading import compile_notice
from ksim_rl.files.writing import check_links, check_place
from ksim_rl.trainers import RunProgress, record_video
from ksim_rl.trainers.build import build_env
from ksim_rl.trainers.video import FPS
from ksim_rl.viewer.drive_recorder import check_new, recording
from ksim_rl.viewer.driven_agent import HAND
from ksim_rl.viewer.played import Played, find, names_run
from ksim_rl.viewer.session import AGENTS, Conditions, Session
from ksim_rl.viewer.shown_motion import with_choice

DEMO = "zoo:cartpole"
VIDEO_SUFFIXES = (".mp4", ".gif")


def play(arguments: list[str]) -> int:
    """Run `ksim-rl play <arguments>` and return its exit code."""
    options = _parser().parse_args(arguments)
    # Faults of the command line before anything is compiled.
    _check(options)
    progress = RunProgress(1)
    with compile_notice(progress.status):
        # Kernels may compile for minutes: the notice says so.
        played = find(
            options.what, agent=options.agent, device=options.device, motion=options.motion
        )
        if options.viewer is None:
            return _record(played, options, progress)
        session = session_of(played, num_envs=options.num_envs, seed=options.seed)
    with ExitStack() as opened:
        opened.callback(session.close)
        if options.record is not None:
            kept = recording(session, played, options.record, note=progress.note)
            opened.enter_context(kept)
        _show(session, options, progress)
    return 0


def _show(session: Session, options: argparse.Namespace, progress: RunProgress) -> None:
    try:
        if options.viewer == "native":
            # Imported here: each needs packages or a display that the other does not.
            importlib.import_module("ksim_rl.viewer.native").show(session, note=progress.note)
        else:
            serve(session, host=options.host, port=options.port, note=progress.note)
    # Ctrl-C is the way to close a viewer, not a failure.
    except KeyboardInterrupt:
        progress.note("closed")


def demo(arguments: list[str]) -> int:
    """Play a policy of the zoo: nothing is trained or fetched."""
    return play([DEMO, *arguments])


def session_of(played: Played, *, num_envs: int, seed: int) -> Session:
    """Make a session of a policy or agent, in so many envs."""

    def make_env(conditions: Conditions) -> EnvBase:
        # Conditions change the task, so each change builds another env.
        task = with_choice(conditions.apply(played.cfg.task))
        cfg = dataclasses.replace(played.cfg, task=task)
        return build_env(cfg, num_envs=num_envs, seed=seed)

    return Session(make_env, played.policy, title=played.title, seed=seed)


def serve(session: Session, *, host: str, port: int, note: Callable[[str], None]) -> None:
    """Serve a session to browsers until Ctrl-C."""
    # viser is an extra.
    from ksim_rl.viewer.browser import BrowserViewer

    with closing(BrowserViewer(host=host, port=port, label=session.title)) as viewer:
        viewer.open(session)
        for line in addresses(viewer.address, viewer.pad_address):
            note(line)
        viewer.run()


def addresses(viewer: str, pad: str) -> list[str]:
    """Return the lines that say where the viewer is, and how to reach it from another machine."""
    ports = [urlsplit(address).port for address in (viewer, pad)]
    # Both ports, since the page for keyboard and gamepad has its own.
    forwarded = " ".join(f"-L {port}:127.0.0.1:{port}" for port in ports)
    return [
        f"viewer: {viewer}; with keyboard and gamepad: {pad} (Ctrl-C closes it)",
        f"from another machine: ssh -N {forwarded} THIS_MACHINE, then the same address there",
    ]


def check_viser() -> None:
    """Raise a ValueError where viser, which the browser viewer is made of, is missing."""
    if importlib.util.find_spec("viser") is None:
        raise ValueError('the browser viewer needs viser: pip install "ksim_rl[viewer]"')


def _parser() -> OneLineParser:
    parser = OneLineParser(
        prog="ksim-rl play",
        description="Show a policy, or with --agent a task without one: a video, or with --live a viewer to drive it.",
    )
    parser.add_argument(
        "what",
        nargs="+",
        metavar="RUN | zoo:NAME | task=NAME | field=value",
        help="a run folder or one of its checkpoints, or with --agent a task; then fields of its config to change",
    )
    parser.add_argument(
        "--live", dest="viewer", action="store_const", const="browser", help="as --viewer browser"
    )
    parser.add_argument(
        "--viewer", choices=("browser", "native"), help="look and drive; native is MuJoCo's window"
    )
    parser.add_argument(
        "--agent",
        choices=(*AGENTS, HAND),
        help="act without a policy: not at all, at random, or by hand in the browser viewer",
    )
    parser.add_argument(
        "--motion",
        help="of a run: the name of the clip that its policy follows; of a task: a reference motion that is played "
        "without physics, a clip of its sets, or a file",
    )
    parser.add_argument(
        "--num-envs",
        type=int,
        help="of a viewer, which shows one at a time; default: 4, or 1 with --record",
    )
    parser.add_argument(
        "--record",
        type=Path,
        metavar="FOLDER",
        help="of a viewer: keep what is driven, as whole episodes in a new folder",
    )
    parser.add_argument(
        "--host",
        default="127.0.0.1",
        help="where the browser viewer listens; default: this machine",
    )
    parser.add_argument(
        "--port", type=int, default=8080, help="of the browser viewer, or the next that is free"
    )
    parser.add_argument("--device", default="auto", help="cpu, cuda, cuda:<index> or auto")
    parser.add_argument("--seed", type=int, default=0, help="of the initial state")
    parser.add_argument(
        "--seconds",
        type=float,
        help="of a video, simulated time; default: as the run was configured",
    )
    parser.add_argument(
        "--fps", type=float, help=f"of a video, pictures per second; default: {FPS:g}"
    )
    parser.add_argument(
        "--output",
        type=Path,
        help="of a video: an .mp4 or .gif file; default: play.mp4 in the run folder",
    )
    return parser


def _check(options: argparse.Namespace) -> None:
    # Options that make no sense for a viewer.
    of_video = {"--seconds": options.seconds, "--fps": options.fps, "--output": options.output}
    given = {name: value for name, value in of_video.items() if value is not None}
    for name in ("--seconds", "--fps"):
        check_in_range(name, given.get(name, 1.0), low=0.0, low_open=True)
    if options.num_envs is None:
        options.num_envs = 4 if options.record is None else 1
    check_count("--num-envs", options.num_envs)
    if options.agent == HAND and options.viewer != "browser":
        raise ValueError("--agent hand: actions are driven in the browser viewer: add --live")
    if options.record is not None:
        if options.viewer is None:
            raise ValueError("--record: of a viewer, in which one drives: add --live")
        if options.num_envs != 1:
            raise ValueError(f"--record with --num-envs {options.num_envs}: one env is driven")
        if options.motion is not None and not names_run(options.what[0]):
            raise ValueError(
                f"--record with --motion {options.motion}: nothing acts in a motion: name a run whose policy follows it"
            )
        check_new(options.record)
    if options.output is not None and options.output.suffix not in VIDEO_SUFFIXES:
        raise ValueError(
            f"--output {options.output}: expected a file that ends in {' or '.join(VIDEO_SUFFIXES)}"
        )
    check_place("--output", options.output, is_folder=False)
    # A missing package, display or port is reported now, not after minutes of compiling.
    if options.viewer == "browser":
        check_viser()
        importlib.import_module("ksim_rl.viewer.gate").check_listens(options.host, options.port)
    if options.viewer == "native":
        importlib.import_module("ksim_rl.viewer.native").check_display()
    if options.viewer is not None and given:
        raise ValueError(f"{', '.join(given)}: of a video: leave that out, or leave out the viewer")


def _record(played: Played, options: argparse.Namespace, progress: RunProgress) -> int:
    # The video is written into the run's folder, which may hold links that lead elsewhere.
    if options.output is None and played.actor is not None:
        check_links(played.folder, below=())
    path = options.output or played.folder / "play.mp4"
    # A policy of an agent needs an env for its action spec; the video builds its own.
    probe = build_env(played.cfg, num_envs=1, seed=options.seed)
    actor = played.policy(probe)
    probe.close()
    how = {
        "note": progress.note,
        "seconds": options.seconds,
        "fps": options.fps or FPS,
        "seed": options.seed,
    }
    with progress.console.status("drawing the video") as spinner:
        if progress.console.is_terminal:
            status = spinner.update
        else:
            status = progress.status
        written = record_video(played.cfg, actor, path, status=status, **how)
    # Exit code 3: the run failed; `note` has given the reason.
    if written is None:
        return 3
    progress.note(f"{played.title}: {min(str(written), os.path.relpath(written), key=len)}")
    return 0
