"""Small files that would hang a program or fill its memory, each read in a process of its own with limits on both."""

import io
import os
import resource
import signal
import struct
import sys
import traceback
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from omegaconf import OmegaConf

from ksim_rl.clips.amass import read_amass
from ksim_rl.clips.bvh import read_bvh
from ksim_rl.clips.robot_csv import read_csv
from ksim_rl.conf.registration import check_groups
from ksim_rl.config.plain_data import read_yaml
from ksim_rl.runs import listing, record, run_lock
from ksim_rl.runs.csv_table import read_table
from ksim_rl.scene.actuators.nets import NetFile
from ksim_rl.scene.motions import motion
from ksim_rl.trainers import checkpoint

MOST_SECONDS, MOST_BYTES = 10, 2**30
BVH = """HIERARCHY
ROOT hips
{{
  OFFSET 0 0 0
  CHANNELS {channels}
}}
MOTION
Frames: 1000000000000
Frame Time: 0.01
"""
Reads = Callable[[], object]
BOMBS: dict[str, Callable[[Path], Reads]] = {}


def bomb(write: Callable[[Path], Reads]) -> Callable[[Path], Reads]:
    """Register what writes a file into a folder, and returns what reads it."""
    BOMBS[write.__name__] = write
    return write


@bomb
def yaml_of_4_mib(folder):
    path = folder / "config.yaml"
    path.write_text(
        "".join(f"key_{number}: {{a: [1.5e-3, x], b: y}}\n" for number in range(110_000))
    )
    return lambda: read_yaml(path)


@bomb
def yaml_as_large_as_it_may_be(folder):
    path = folder / "config.yaml"
    path.write_text("- [1, 2, {a: b}]\n" * 30_000)
    return lambda: read_yaml(path)


@bomb
def yaml_of_keys_that_are_compared(folder):
    path = folder / "config.yaml"
    path.write_text("".join(f"{number}:\n" for number in range(70_000)))
    return lambda: read_yaml(path)


@bomb
def yaml_of_a_number_that_nobody_can_print(folder):
    path = folder / "config.yaml"
    path.write_text("num_envs: 0x" + "f" * 500_000)
    return lambda: read_yaml(path)


@bomb
def yaml_of_more_digits_than_python_reads(folder):
    path = folder / "config.yaml"
    path.write_text("num_envs: " + "9" * 5000)
    return lambda: read_yaml(path)


@bomb
def group_of_references(folder):
    """Each text is the one before it twice, which Hydra writes out."""
    path = folder / "objective" / "long.yaml"
    path.parent.mkdir()
    path.write_text(
        "a0: xxxxxxxxxx\n" + "".join(f"a{n + 1}: '${{a{n}}}${{a{n}}}'\n" for n in range(30))
    )

    def read():
        check_groups(folder)
        return OmegaConf.to_container(OmegaConf.load(path), resolve=True)

    return read


@bomb
def group_of_anchors(folder):
    """Each list holds the one before it ten times, which the check of names wrote out."""
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    lines += [
        f"a{level}: &a{level} [{', '.join([f'*a{level - 1}'] * 10)}]" for level in range(1, 10)
    ]
    (folder / "logger").mkdir()
    (folder / "logger" / "mine.yaml").write_text("\n".join(lines))
    return lambda: check_groups(folder)


@bomb
def group_that_takes_minutes_to_read(folder):
    (folder / "logger").mkdir()
    (folder / "logger" / "mine.yaml").write_text(
        "".join(f"k{number}: [1, 2, 3]\n" for number in range(30_000))
    )
    return lambda: check_groups(folder)


@bomb
def table_of_30_mb(folder):
    """Its cells are one letter each, and a table of text took a hundred bytes for each."""
    path = folder / "metrics.csv"
    columns = 3000
    head = ",".join(["env_states", *(f"m{number}" for number in range(columns))])
    path.write_text(head + "\n" + (",".join(["1"] * (columns + 1)) + "\n") * 5000)
    return lambda: read_table(path)


@bomb
def table_of_empty_cells(folder):
    path = folder / "metrics.csv"
    head = ",".join(["env_states", *(f"m{number}" for number in range(9000))])
    path.write_text(head + "\n" + ("1" + "," * 9000 + "\n") * 3300)
    return lambda: read_table(path)


@bomb
def table_of_columns(folder):
    path = folder / "metrics.csv"
    path.write_text("env_states" + ",a" * 5_000_000 + "\n1\n")
    return lambda: read_table(path)


@bomb
def table_of_one_line(folder):
    path = folder / "metrics.csv"
    path.write_text("env_states,a\n" + "1" * 60_000_000)
    return lambda: read_table(path)


@bomb
def tensors_that_were_never_written(folder):
    saved = folder / "checkpoint" / "00000001"
    saved.mkdir(parents=True)
    size = 12 * 10**9
    files = {checkpoint.TENSORS: {"bytes": size, "sha256": "0" * 64}}
    manifest = {"format_version": 2, "iteration": 1, "files": files, "values": {}, "config": {}}
    (saved / checkpoint.MANIFEST).write_bytes(checkpoint._seal(manifest))
    with open(saved / checkpoint.TENSORS, "wb") as file:
        file.truncate(size)
    return lambda: checkpoint.load(saved)


@bomb
def motor_model_that_was_never_written(folder):
    path = folder / "net.safetensors"
    with open(path, "wb") as file:
        file.write(struct.pack("<Q", 2**30 - 8))
        file.truncate(2**30)
    return lambda: NetFile(str(path), None)


@bomb
def bvh_of_frames_without_numbers(folder):
    path = folder / "dance.bvh"
    path.write_text(BVH.format(channels=0))
    return lambda: read_bvh(path)


@bomb
def bvh_of_frames_that_are_not_there(folder):
    path = folder / "dance.bvh"
    path.write_text(BVH.format(channels="3 Xrotation Yrotation Zrotation"))
    return lambda: read_bvh(path)


def claims(path: Path, name: str, shape: tuple[int, ...], **others: np.ndarray) -> None:
    """Write an archive in which the header of one array claims more than its file holds."""
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        header, {"descr": "<f8", "fortran_order": False, "shape": shape}
    )
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(f"{name}.npy", header.getvalue() + bytes(64))
        for other, array in others.items():
            content = io.BytesIO()
            np.save(content, array)
            archive.writestr(f"{other}.npy", content.getvalue())


@bomb
def motion_of_terabytes(folder):
    path = folder / "motion.npz"
    claims(path, "qpos", (10**9, 1000), fps=np.float64(30.0), qvel=np.zeros((2, 6)))
    return lambda: motion._read(path)


@bomb
def motion_whose_size_overflows(folder):
    path = folder / "motion.npz"
    claims(path, "qpos", (2**62, 2**62), fps=np.float64(30.0), qvel=np.zeros((2, 6)))
    return lambda: motion._read(path)


def _archive_of(path: Path, shape: str) -> None:
    """Write a motion whose header has this text for a shape."""
    header = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(
            "qpos.npy", b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + bytes(8)
        )


@bomb
def motion_whose_header_exhausts_the_parser(folder):
    path = folder / "motion.npz"
    _archive_of(path, "(" + "-" * 8000 + "1,)")
    return lambda: motion._read(path)


@bomb
def motion_whose_header_never_ends(folder):
    path = folder / "motion.npz"
    _archive_of(path, "(" * 5000)
    return lambda: motion._read(path)


@bomb
def motion_whose_size_is_a_truth_value(folder):
    path = folder / "motion.npz"
    _archive_of(path, "(True,)")
    return lambda: motion._read(path)


@bomb
def motion_of_words(folder):
    path = folder / "motion.npz"
    np.savez(path, fps="fast", qpos=np.array([["a"]]), qvel=np.array([["b"]]))
    return lambda: motion._read(path)


@bomb
def recording_of_terabytes(folder):
    path = folder / "amass.npz"
    claims(path, "poses", (10**10, 156), trans=np.zeros((2, 3)), mocap_framerate=np.float64(30.0))
    return lambda: read_amass(path)


@bomb
def recording_that_unpacks_to_gigabytes(folder):
    path = folder / "amass.npz"
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
        archive.open("poses.npy", "w") as file,
    ):
        for _ in range(1500):
            file.write(bytes(2**20))
    return lambda: read_amass(path)


@bomb
def manifest_of_lists(folder):
    saved = folder / "checkpoint" / "00000001"
    saved.mkdir(parents=True)
    (saved / checkpoint.MANIFEST).write_text('{"manifest": [' + "[]," * 20_000_000 + "[]]}")
    return lambda: checkpoint.load(saved)


@bomb
def pipes_in_a_run_folder(folder):
    for name in (run_lock.LOCK, record.RECORD, listing.CONFIG, listing.METRICS):
        os.mkfifo(folder / name)
    return lambda: listing.summarize(folder)


@bomb
def pipe_for_a_recording(folder):
    path = folder / "walk.csv"
    os.mkfifo(path)
    return lambda: read_csv(path, _free_body(), fps=30.0)


def _free_body():
    import mujoco

    return mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body><freejoint/><geom size='1'/></body></worldbody></mujoco>"
    )


def read_apart(write: Callable[[Path], Reads], folder: Path) -> tuple[str, str]:
    """Read a bomb in a forked process; return "read", "refused", "crash" or "hang", and what was said."""
    reads = write(folder)
    read_end, write_end = os.pipe()
    pid = os.fork()
    if pid == 0:
        os.close(read_end)
        _read_and_say(reads, write_end)
    os.close(write_end)
    with os.fdopen(read_end, "rb") as said:
        verdict, _, message = said.read().decode(errors="replace").partition(" ")
    _, status = os.waitpid(pid, 0)
    if os.WIFSIGNALED(status):
        late = os.WTERMSIG(status) in (signal.SIGALRM, signal.SIGVTALRM)
        return "hang" if late else "crash", f"signal {os.WTERMSIG(status)}"
    if verdict == "refused" and (str(folder) not in message or "\n" in message):
        return "crash", f"not one line with the file's name: {message[:300]}"
    return verdict, message


def _read_and_say(reads: Reads, pipe: int) -> None:
    """Leave the process with what came of it in the pipe; the child of a test runner must not return."""
    try:
        # Coverage of `make test-full` would take three times the processor time.
        sys.settrace(None)
        mapped = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (mapped + MOST_BYTES, mapped + MOST_BYTES))
        # Processor time, since other programs may hold the machine up; wall time only ends what waits for ever.
        for kind, number, seconds in (
            (signal.ITIMER_VIRTUAL, signal.SIGVTALRM, MOST_SECONDS),
            (signal.ITIMER_REAL, signal.SIGALRM, 6 * MOST_SECONDS),
        ):
            signal.signal(number, signal.SIG_DFL)
            signal.setitimer(kind, seconds)
        reads()
        text = "read "
    except ValueError as error:
        text = f"refused {error}"
    except BaseException:
        text = f"crash {traceback.format_exc()[-600:]}"
    try:
        os.write(pipe, text.encode(errors="replace")[:4000])
    finally:
        os._exit(0)


def figures(names: list[str], folder: Path) -> dict[str, float]:
    """Return how many bombs were read or refused within the limits, and how many were not."""
    found = {"files": len(names), "crashes": 0, "hangs": 0}
    for name in names:
        (folder / name).mkdir()
        verdict, said = read_apart(BOMBS[name], folder / name)
        found["crashes"] += verdict == "crash"
        found["hangs"] += verdict == "hang"
        if verdict in ("crash", "hang"):
            print(f"{name}: {verdict}: {said}", flush=True)
    return found
