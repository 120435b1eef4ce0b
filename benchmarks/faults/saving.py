"""Checkpoints under fire: killed while saving, damaged at random, and what `latest` makes of it."""

from __future__ import annotations

import os
import random
import shutil
import signal
from pathlib import Path

from benchmarks.faults import children
from benchmarks.faults.file_operations import on_each
from benchmarks.faults.row import AT_LEAST, AT_MOST, EXACTLY, Figures, Row
from ksim_rl.device import state_tree
from ksim_rl.trainers import Hook, Trainer, checkpoint
from ksim_rl.trainers.checkpoint import MANIFEST, TENSORS, CheckpointError

FILES = (
    "ksim_rl/trainers/checkpoint.py",
    "ksim_rl/trainers/trainer.py",
    "ksim_rl/files/writing.py",
)
# About as many file operations as a save makes with the deletion of an old checkpoint, so all of them are hit.
OPERATIONS_OF_A_SAVE = 12


class _Report(Hook):
    """Says which iteration is done and which is saved, and kills the process in the middle of a save on request."""

    interval = 1

    def __init__(self, folder: Path, *, die_at: int | None) -> None:
        self.folder, self.die_at, self.saves, self.operations = folder, die_at, 0, 0
        self.inside = False

    def __call__(self, trainer: Trainer) -> None:
        os.write(1, f"done {trainer.iteration} {trainer.saved_at}\n".encode())
        if self.saves == 0 and self.die_at is not None:
            on_each(self.folder, self.count)
        self.saves += 1

    def count(self, kind: str, path: str) -> None:
        # The first two saves make old checkpoints, which the third one deletes.
        if self.saves < 3 or "checkpoint" not in path:
            return
        self.operations += 1
        if self.operations == self.die_at:
            if kind == "fsync" and os.path.isfile(path):  # as if only half had come to the disk
                os.truncate(path, os.path.getsize(path) // 2)
            os.kill(os.getpid(), signal.SIGKILL)


def kill9(folder: Path, *, kills: int, inside: int) -> Figures:
    """Kill a real loop again and again, `inside` times in the middle of a save, and let the next one go on."""
    children.warm()
    run = folder / "run"
    choose = random.Random(kills)
    order = [True] * inside + [False] * (kills - inside)
    choose.shuffle(order)
    found = {
        "kills": 0,
        "kills_inside_a_save": 0,
        "corrupt": 0,
        "absent": 0,
        "intervals_lost": 0,
        "stray": 0,
    }
    for number, in_save in enumerate(order):
        # The newest whole one, which is what `ksim-rl resume` takes.
        before = _newest(run)
        die_at = 1 + number % OPERATIONS_OF_A_SAVE if in_save else None

        def work(before=before, die_at=die_at) -> int:
            resumed = None if before is None else checkpoint.load(before)
            report = _Report(run, die_at=die_at)
            return children.train(
                run, hooks=(report,), resume_from=resumed, num_iterations=10**6, eval_interval=0
            )

        child = children.start(work)
        if in_save:
            ended = child.wait()
        else:
            child.read(until=b"done")
            children.pause(choose.uniform(0.0, 0.2))
            ended = child.kill()
        found["kills"] += ended.code == -signal.SIGKILL
        found["kills_inside_a_save"] += in_save and ended.code == -signal.SIGKILL
        lines = [line.split() for line in ended.text.splitlines() if line.startswith("done")]
        done, saved = (int(lines[-1][1]), int(lines[-1][2])) if lines else (0, -1)
        corrupt = [path for path in checkpoint.saved(run / "checkpoint") if not _whole(path)]
        found["corrupt"] += len(corrupt)
        newest = _newest(run)
        if newest is None:
            found["absent"] += saved >= 0
            continue
        kept = int(newest.name.partition("_")[0])
        found["absent"] += kept < saved
        found["intervals_lost"] = max(found["intervals_lost"], done - kept)
    # What the last kill left goes when the run goes on.
    at = _newest(run)

    def finish() -> int:
        assert at is not None
        saved = checkpoint.load(at)
        return children.train(
            run,
            hooks=(Hook(),),
            resume_from=saved,
            num_iterations=saved.iteration + 1,
            eval_interval=0,
        )

    found["restart_ends_well"] = children.start(finish).wait().code in (0, 1)
    found["stray"] = len(children.leftovers(run))
    return found


def _whole(path: Path) -> bool:
    try:
        made = state_tree.number(checkpoint.load(path).state, "iteration")
        return made == int(path.name.partition("_")[0])
    except CheckpointError:
        return False


def _newest(run: Path) -> Path | None:
    try:
        return checkpoint.load_latest(run, note=lambda _: None).path
    except CheckpointError:
        return None


def damaged(content: bytes, choose: random.Random) -> bytes:
    """Return content with a flipped bit, a cut, an insertion or a swap, anywhere."""
    new = bytearray(content)
    at = choose.randrange(len(new))
    kind = choose.choice(["flip", "flip", "cut", "insert", "swap"])
    if kind == "cut":
        del new[at:]
    elif kind == "insert":
        new.insert(at, choose.randrange(256))
    elif kind == "swap":
        other = choose.randrange(len(new))
        new[at], new[other] = new[other], new[at]
    if kind == "flip" or bytes(new) == content:
        new[at] ^= 1 << choose.randrange(8)
    return bytes(new)


def corruption(folder: Path, *, damages: int) -> Figures:
    """Damage a checkpoint of a real run at random, and load it."""
    _, trainer = children.warm()
    saved = checkpoint.save(
        folder / "checkpoint", trainer.state_dict(), iteration=1, config={"a": 1}
    )
    whole = {name: (saved / name).read_bytes() for name in (MANIFEST, TENSORS)}
    choose = random.Random(damages)
    refused = reasons = 0
    for _ in range(damages):
        name = choose.choice([MANIFEST, TENSORS])
        (saved / name).write_bytes(damaged(whole[name], choose))
        try:
            checkpoint.load(saved)
        except CheckpointError as error:
            refused += 1
            reasons += str(saved) in str(error) and "\n" not in str(error)
        (saved / name).write_bytes(whole[name])
    intact = checkpoint.load(saved).iteration == 1
    return {
        "damages": damages,
        "refused": refused,
        "with_file_and_reason": reasons,
        "intact_loads": intact,
    }


def _emptied(path: Path) -> None:
    for entry in path.iterdir():
        entry.unlink()


def _cut(path: Path) -> None:
    os.truncate(path / TENSORS, 100)


def _without_manifest(path: Path) -> None:
    (path / MANIFEST).unlink()


def latest(folder: Path) -> Figures:
    """Damage the newest checkpoints of a run folder, and ask for the latest."""
    taken = said = asked = 0
    for harm in (_emptied, _cut, _without_manifest):
        for newest in (1, 2):
            run = folder / f"{harm.__name__}{newest}"
            run.mkdir()
            paths = [
                checkpoint.save(run / "checkpoint", {"iteration": i}, iteration=i, config={})
                for i in (1, 2, 3)
            ]
            for path in paths[-newest:]:
                harm(path)
            notes: list[str] = []
            expected = paths[-newest - 1]
            asked += 1
            taken += checkpoint.load_latest(run, note=notes.append).path == expected
            said += any(expected.name in note and paths[-1].name in note for note in notes)
    return {"damaged_folders": asked, "whole_one_taken": taken, "said": said}


def same_bits(one: state_tree.State, other: state_tree.State) -> int:
    """Return how many tensors and values of two states differ, but for the seconds that they took."""
    from benchmarks.resume import compare

    return compare(one, other).tensors_that_differ


def resume(folder: Path) -> Figures:
    """Train at a stretch, and in two processes; compare every tensor of the final checkpoints."""
    children.warm()
    straight, halves = folder / "straight", folder / "halves"
    children.start(lambda: children.train(straight, num_iterations=4)).wait()
    children.start(lambda: children.train(halves, num_iterations=2)).wait()
    shutil.copytree(halves, folder / "kept")

    def go_on() -> int:
        return children.train(halves, resume_from=checkpoint.load_latest(halves), num_iterations=4)

    children.start(go_on).wait()
    one, other = (checkpoint.load_latest(run) for run in (straight, halves))
    assert one.iteration == other.iteration == 4
    tensors, values = state_tree.split(one.state)
    return {"compared": len(tensors) + len(values), "differ": same_bits(one.state, other.state)}


ROWS = {
    "kill9": Row(
        fault="kill -9 of a real loop that saves each iteration, some of them in the middle of a save",
        must="no checkpoint corrupt or absent, at most one interval lost, no stray files after the restart",
        limits={
            "kills": (AT_LEAST, "kills"),
            "kills_inside_a_save": (AT_LEAST, "inside"),
            "corrupt": (EXACTLY, 0),
            "absent": (EXACTLY, 0),
            "intervals_lost": (AT_MOST, 1),
            "restart_ends_well": (EXACTLY, 1),
            "stray": (EXACTLY, 0),
        },
        measure=kill9,
        amounts={"kills": 200, "inside": 60},
        short={"kills": 10, "inside": 6},
        files=FILES,
    ),
    "corruption": Row(
        fault="random damage of a checkpoint: flipped bits, cuts, insertions, swaps",
        must="every one refused, with the file and the reason in one line",
        limits={
            "damages": (AT_LEAST, "damages"),
            "refused": (AT_LEAST, "damages"),
            "with_file_and_reason": (AT_LEAST, "damages"),
            "intact_loads": (EXACTLY, 1),
        },
        measure=corruption,
        amounts={"damages": 1000},
        short={"damages": 100},
        files=FILES,
    ),
    "latest": Row(
        fault="the newest checkpoints are empty, cut, or without a manifest",
        must="`latest` passes over them, and says which one it takes",
        limits={
            "damaged_folders": (EXACTLY, 6),
            "whole_one_taken": (EXACTLY, 6),
            "said": (EXACTLY, 6),
        },
        measure=latest,
        files=FILES,
    ),
    "resume": Row(
        fault="a run is ended, and resumed in a new process",
        must="every tensor and value of its last checkpoint is as in a run without a break; more cases: resume.json",
        limits={"compared": (AT_LEAST, 40), "differ": (EXACTLY, 0)},
        measure=resume,
        files=FILES,
    ),
}
