"""A running training is watched in a separate process, on the CPU, which acts with the newest policy.

The training gives its weights away every few seconds, between two iterations and only while a browser is connected.
Otherwise it does nothing for the viewer: its graphs, its envs and its stream stay as they are.
"""

import io
import json
import os
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from subprocess import PIPE, Popen

import torch

from ksim_rl.config import plugins
from ksim_rl.config.child_processes import go_to_parents_folder, start_python
from ksim_rl.device import state_tree
from ksim_rl.files.writing import write_whole
from ksim_rl.trainers import Hook, RunCfg, Trainer
from ksim_rl.trainers.algorithm import make_policy
from ksim_rl.trainers.build import build_env
from ksim_rl.viewer.play_command import addresses, check_viser, session_of
from ksim_rl.viewer.played import Played

# Seconds between two policies that are given away: a hook lets the host wait for the device, so these are rare.
PERIOD_S = 2.0
CONFIG = "config.json"
WEIGHTS = "weights.pt"
# Words of the child's lines that are no notes.
_SOME = "watched"
_NOBODY = "alone"


class GiveWeights(Hook):
    """Writes the actor's weights for the viewer every `PERIOD_S`, while a page is open."""

    def __init__(self, folder: Path) -> None:
        self.is_watched = False
        # One iteration at first, until the time of an iteration is known.
        self._every = 1
        self._path = folder / WEIGHTS
        self._last: tuple[float, int] | None = None

    @property
    def interval(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Iterations between two calls. Another thread says whether there are any, so it is never 0, as in `%`."""
        if self.is_watched:
            return self._every
        return sys.maxsize

    def __call__(self, trainer: Trainer) -> None:
        """Write them, and find out in how many iterations it is time again."""
        now = time.monotonic()
        # From the pace of the last iterations, as these may become faster or slower.
        if self._last is not None:
            seconds = now - self._last[0]
            iterations = trainer.iteration - self._last[1]
            self._every = max(1, round(PERIOD_S * iterations / max(seconds, 1e-3)))
        self._last = now, trainer.iteration
        # To the host, as the viewer has no GPU.
        state = {name: tensor.cpu() for name, tensor in trainer.update.actor.state_dict().items()}
        # Torch's writer of files aborts the process where the disk is full.
        memory = io.BytesIO()
        torch.save({"iteration": trainer.iteration, "actor": state}, memory)
        write_whole(self._path, memory.getvalue())


@contextmanager
def watched(cfg: RunCfg, note: Callable[[str], None]) -> Iterator[list[Hook]]:
    """Open the viewer that `cfg.viewer` asks for, and yield the hooks that a run needs for it; close it at the end.

    A viewer that ends early costs a line of `note`, not the run.
    """
    if not cfg.viewer.browser:
        yield []
        return
    check_viser()
    with tempfile.TemporaryDirectory(prefix="ksim_rl_viewer_") as name:
        folder = Path(name)
        # Passed as a file: a config is too long for a command line.
        write_whole(folder / CONFIG, json.dumps(cfg.to_tree()))
        hook = GiveWeights(folder)
        child = start_python(
            # The pipe ends with this process, however it ends; its output says whether a page is open.
            ["-m", "ksim_rl.viewer.live_training", name],
            stdin=PIPE,
            stdout=PIPE,
            text=True,
            # No memory on the GPU, and no core that the training needs.
            environment={"CUDA_VISIBLE_DEVICES": "", "OMP_NUM_THREADS": "1"},
            preexec_fn=lambda: os.nice(10),
            start_new_session=True,  # Ctrl-C is for the training, which closes the viewer
        )
        # A thread of its own, as reading waits.
        threading.Thread(target=_listen, args=(child, hook, note), daemon=True).start()
        try:
            yield [hook]
        finally:
            # The server has nothing to save.
            child.terminate()
            child.wait()


def _listen(child: "Popen[str]", hook: GiveWeights, note: Callable[[str], None]) -> None:
    assert child.stdout is not None
    for line in child.stdout:
        if line.strip() in (_SOME, _NOBODY):
            # Weights are written only while a browser is open.
            hook.is_watched = line.strip() == _SOME
        else:
            note(line.strip())
    # The child has ended: the weights are not read any more.
    hook.is_watched = False


def _end_with_training() -> None:
    """Wait for the training's end of the pipe, which it holds for as long as it lives, and end this process."""
    sys.stdin.read()
    os._exit(0)


def main(folder: Path) -> None:
    """Serve the policies of the training in the other process, until that ends."""
    from ksim_rl.viewer.browser import BrowserViewer

    threading.Thread(target=_end_with_training, daemon=True).start()
    torch.set_num_threads(1)
    go_to_parents_folder()
    plugins.load(())
    # On the CPU and without weights of a checkpoint: the policy comes from the training.
    cfg = RunCfg.from_tree(
        {**json.loads((folder / CONFIG).read_text()), "device": "cpu", "checkpoint": None}
    )
    viewer = BrowserViewer(host=cfg.viewer.address, port=cfg.viewer.port, label="training")
    # A policy needs an env for its shapes.
    probe = build_env(cfg, num_envs=1, seed=cfg.seed)
    actor = make_policy(cfg, probe)
    probe.close()
    session = session_of(
        Played(cfg=cfg, title=cfg.task_name, folder=folder, actor=actor), num_envs=4, seed=0
    )
    viewer.open(session)
    # Flushed, as a pipe is no terminal; the training shows these lines.
    print(*addresses(viewer.address, viewer.pad_address), sep="\n", flush=True)
    read_at = 0
    said = False

    def follow() -> bool:
        nonlocal read_at, said
        if viewer.watched != said:
            said = viewer.watched
            print(_SOME if said else _NOBODY, flush=True)
        path = folder / WEIGHTS
        session.note = session.note or "waiting for the first policy"
        # A file that appears whole, so its time shows that a policy is new.
        if path.exists() and path.stat().st_mtime_ns != read_at:
            read_at = path.stat().st_mtime_ns
            # Data only: no code of a file is run.
            saved = torch.load(path, weights_only=True)
            # Into the same tensors, which the session's policy reads.
            state_tree.copy_into(actor.state_dict(), saved["actor"], what="actor")
            session.note = f"iteration {saved['iteration']} of a running training"
        return True

    viewer.run(goes_on=follow)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
