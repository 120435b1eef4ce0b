"""Records a video of a policy: the pictures that its env renders while it acts."""

import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import numpy as np
import torch
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from ksim_rl.envs.contract import Pictures, part
from ksim_rl.files.writing import whole_file
from ksim_rl.trainers.interrupt import InterruptRequest

# Pictures per second of simulated time. Software rendering takes 50 to 90 ms each, far more than a step of one env.
FPS = 25.0
# The reason that rendering failed in this process. MuJoCo aborts the process when it tries a second time without a
# working OpenGL platform.
_failed: list[str] = []


class VideoUnavailableError(RuntimeError):
    """There is no video; the message says why and how to get one."""


def record(
    env: EnvBase,
    policy: TensorDictModuleBase,
    path: Path,
    *,
    steps: int,
    step_dt: float,
    fps: float = FPS,
    seed: int = 0,
    status: Callable[[str], None] = lambda _: None,
) -> Path:
    """Let the policy act, deterministically, and write the pictures of a camera; return the file written.

    The env has the part `Pictures`, and `path` ends in `.mp4`; without a video encoder a `.gif` next to it is written
    instead. It plays at real speed, `step_dt` being the seconds of an env step, with as near to `fps` pictures per
    second as whole steps allow: at most one each. A VideoUnavailableError says why nothing can be rendered, and a fix.
    """
    if _failed:
        raise VideoUnavailableError(_failed[0])
    # A whole number of env steps per picture; the file's rate follows from it, so that time runs right.
    every = max(1, round(1.0 / (fps * step_dt)))
    shown = 1.0 / (every * step_dt)

    def acting() -> Iterator[np.ndarray]:
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            env.set_seed(seed)
            current_E = env.reset()
            for step in range(steps):
                if step % every == 0:
                    if (pictures := part(env, Pictures)) is None:
                        frame = None
                    else:
                        frame = pictures.render()
                    if frame is None:
                        raise VideoUnavailableError(
                            "the env has no render mode: build it with render_mode='rgb_array'"
                        )
                    status(f"drawing the video: {step / steps:.0%}")
                    yield frame
                _, current_E = env.step_and_maybe_reset(policy(current_E))

    frames = acting()
    try:
        # The first picture opens OpenGL: if that fails, no file has been begun.
        first = next(frames)
    except VideoUnavailableError:
        raise
    except RuntimeError as error:
        # Remembered for the life of the process; see above.
        _failed.append(str(error))
        raise VideoUnavailableError(str(error)) from error
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        return _write(path, first, frames, fps=shown)
    except (ImportError, RuntimeError, OSError):
        # No ffmpeg for this platform: a GIF needs only Pillow. The frames begin again, as the generator is spent.
        frames = acting()
        return _write(path.with_suffix(".gif"), next(frames), frames, fps=shown)


def _write(path: Path, first: np.ndarray, rest: Iterator[np.ndarray], *, fps: float) -> Path:
    # H.264 wants even sides; with macro_block_size=2 imageio pads only odd ones.
    h264 = {"fps": fps, "codec": "libx264", "quality": 7, "macro_block_size": 2}
    if path.suffix == ".gif":
        options = {"duration": 1000 / fps, "loop": 0}
    else:
        options = h264
    with whole_file(path) as temporary:
        writer: Any = imageio.get_writer(temporary, **options)
        with writer:
            # Python drops what a handler raises while a process forks, as this one does for the encoder.
            with InterruptRequest("the run ends when the encoder has started") as interrupt:
                writer.append_data(first)
            if interrupt.signal is not None:
                signal.raise_signal(interrupt.signal)
            for frame in rest:
                writer.append_data(frame)
    return path
