"""Reads BVH files (Biovision hierarchy): a skeleton's offsets, and its joints' Euler angles by frame."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ksim_rl.checks import near
from ksim_rl.clips.recording import Array, Recording, chain, from_rotation_vector, multiply, refused
from ksim_rl.files.reading import MOST_TEXT_BYTES, read_bytes

CHANNELS = tuple(f"{axis}{kind}" for kind in ("position", "rotation") for axis in "XYZ")
# Turns (x, y, z) with y up and z ahead into (x ahead, y left, z up): z, x, y.
_UPRIGHT = np.array((0.5, 0.5, 0.5, 0.5))


@dataclass
class _Skeleton:
    names: list[str] = field(default_factory=list)
    parents: list[int] = field(default_factory=list)
    offsets: list[list[float]] = field(default_factory=list)
    channels: list[list[str]] = field(default_factory=list)


class _Words:
    """The words of a file, which know their line."""

    def __init__(self, path: Path, text: str) -> None:
        self.path = path
        self.line = 0
        self._words = self._split(text)

    def _split(self, text: str) -> Iterator[str]:
        # A generator, so that `line` is the one of the word that was read last.
        for number, line in enumerate(text.splitlines(), 1):
            for word in line.split():
                self.line = number
                yield word

    def next(self, expected: str = "") -> str:
        word = next(self._words, "")
        # Keywords are written in any case by the programs that export them.
        if not word or (expected and word.upper() != expected.upper()):
            if word:
                said = repr(word)
            else:
                said = "the end of the file"
            raise self.wrong(f"{said} in place of {expected or 'a word'}")
        return word

    def number(self) -> float:
        word = self.next()
        try:
            value = float(word)
        except ValueError:
            raise self.wrong(f"{word!r} in place of a number") from None
        # Python reads "nan" and "inf" as numbers.
        if not np.isfinite(value):
            raise self.wrong(f"{word!r}, which is not finite")
        return value

    def wrong(self, what: str) -> ValueError:
        return refused(
            self.path, f"line {self.line}: {what}", "expected a BVH file; export it again"
        )


def read_bvh(path: Path, *, scale: float = 0.01, y_up: bool = True) -> Recording:
    """Return where a BVH file's joints are; ends of limbs are called as the joint before them with "_end" behind.

    `scale` is m per unit of the file, most often a centimetre. With `y_up`, as most files have it, the y axis becomes
    the vertical one, and z the one ahead, x.
    """
    try:
        text = read_bytes(path, limit=MOST_TEXT_BYTES, follows_links=True).decode()
    except UnicodeDecodeError:
        raise refused(path, "it is no text", "give a BVH file") from None
    words = _Words(path, text)
    skeleton = _Skeleton()
    # The grammar in order: skeleton first, then the table of the motion.
    words.next("HIERARCHY")
    words.next("ROOT")
    _read_joint(words, skeleton, parent=-1)
    words.next("MOTION")
    words.next("Frames:")
    frames = words.number()
    words.next("Frame")
    words.next("Time:")
    frame_s = words.number()
    if frames < 2 or frame_s <= 0.0:
        raise words.wrong(f"{frames:g} frames of {frame_s:g} s")
    # Columns of the table, in the order in which the joints were read.
    count = sum(len(channels) for channels in skeleton.channels)
    # Each number takes a letter at least.
    if not 0 < frames * count <= len(text):
        raise words.wrong(f"{frames:g} frames of {count} numbers, in a file of {len(text)} letters")
    # One row per frame.
    size = int(frames) * count
    numbers = np.fromiter((words.number() for _ in range(size)), float, size)
    table_FC = numbers.reshape(-1, count)
    # Turns in the parents' frames become poses in the world, still in units of the file.
    turns_FN4, root_F3 = _turns(skeleton, table_FC)
    pos_FN3, quat_FN4 = chain(skeleton.parents, np.array(skeleton.offsets), turns_FN4, root_F3)
    pos_FN3 = pos_FN3 * scale
    # Positions have their axes permuted, and orientations are turned by the same rotation.
    if y_up:
        pos_FN3 = pos_FN3[..., [2, 0, 1]]
        quat_FN4 = multiply(np.broadcast_to(_UPRIGHT, quat_FN4.shape), quat_FN4)
    return Recording(
        fps=1.0 / frame_s, names=tuple(skeleton.names), pos_FN3=pos_FN3, quat_FN4=quat_FN4
    )


def _read_joint(words: _Words, skeleton: _Skeleton, *, parent: int) -> None:
    """Read a joint behind its keyword, and all below it."""
    # A stack in place of recursion: a file may nest deeper than Python's stack.
    open_joints = [_enter(words, skeleton, words.next(), parent)]
    while open_joints:
        word = words.next()
        if word == "}":
            open_joints.pop()
        elif word.upper() == "JOINT":
            open_joints.append(_enter(words, skeleton, words.next(), open_joints[-1]))
        elif word.upper() == "END":
            # The end of a limb has an offset only, no channels.
            words.next("Site")
            _enter(
                words,
                skeleton,
                f"{skeleton.names[open_joints[-1]]}_end",
                open_joints[-1],
                is_end=True,
            )
            words.next("}")
        else:
            raise words.wrong(f"{word!r} in place of JOINT, End or a bracket")


def _enter(
    words: _Words, skeleton: _Skeleton, name: str, parent: int, *, is_end: bool = False
) -> int:
    words.next("{")
    words.next("OFFSET")
    skeleton.names.append(name)
    skeleton.parents.append(parent)
    skeleton.offsets.append([words.number() for _ in range(3)])
    skeleton.channels.append([])
    if not is_end:
        words.next("CHANNELS")
        for _ in range(int(words.number())):
            channel = words.next()
            if channel not in CHANNELS:
                raise words.wrong(f"channel {channel!r}, {near(channel, CHANNELS)}")
            skeleton.channels[-1].append(channel)
    return len(skeleton.names) - 1


def _turns(skeleton: _Skeleton, table_FC: Array) -> tuple[Array, Array]:
    """Return how each joint turns in its parent's frame, and where the root is; only the root's place may change."""
    turns_FN4 = np.zeros((len(table_FC), len(skeleton.names), 4))
    # Identity: joints without channels do not turn.
    turns_FN4[..., 0] = 1.0
    root_F3 = np.tile(np.array(skeleton.offsets[0]), (len(table_FC), 1))
    column = 0
    # Columns are consumed in order, also those that are not used.
    for joint, channels in enumerate(skeleton.channels):
        for channel in channels:
            axis = "XYZ".index(channel[0])
            if channel.endswith("rotation"):
                turn_F3 = np.zeros((len(table_FC), 3))
                turn_F3[:, axis] = np.radians(table_FC[:, column])
                # In the order of the channels, each about the axis that the ones before have turned.
                turns_FN4[:, joint] = multiply(turns_FN4[:, joint], from_rotation_vector(turn_F3))
            # Other joints keep their offsets: bones do not change their length.
            elif joint == 0:
                root_F3[:, axis] += table_FC[:, column]
            column += 1
    return turns_FN4, root_F3
