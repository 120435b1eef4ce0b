"""Writes a folder of episodes as a dataset of LeRobot, version 3.0: Parquet for numbers, videos for pictures.

The layout is `lerobot` 0.4's (https://huggingface.co/docs/lerobot/lerobot-dataset-v3): each file of `data` and
`videos` has many episodes, and `meta/episodes` says where each of them lies. Frames are env states: observations, the
action taken, and under `next.` the reward and how the episode stands. Observations that follow stand in the next
frame, so the last of each episode is in no dataset of this kind.
"""

import importlib.util
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ksim_rl.data.episode_folder import EPISODE_KEY, Contents
from ksim_rl.data.episode_reader import Episodes, read_episodes
from ksim_rl.data.lerobot_layout import DataFile, Feature, features_of, files_of
from ksim_rl.data.lerobot_meta import write_meta
from ksim_rl.files.writing import whole_folder

# Key frames stand close, as LeRobot reads single frames.
MOST_FPS = 1e6
H264 = ["-crf", "18", "-g", "2"]
ENCODER = "libx264"


def check_lerobot() -> None:
    """Raise a ValueError where a package is missing that writes a dataset of LeRobot."""
    if importlib.util.find_spec("pyarrow") is None:
        raise ValueError("a dataset of LeRobot needs pyarrow: pip install 'ksim_rl[lerobot]'")


def write_lerobot(folder: Path | str, output: Path | str) -> Path:
    """Write the episodes of a folder as a dataset of LeRobot into a new folder, and return that.

    Leaves are named as LeRobot names them: "actor" is `observation.state`, other leaves are `observation.<name>`,
    pictures `observation.images.<name>`; scalars have the shape [1], and arrays of several dims that are no pictures
    are flattened, row by row. A ValueError refuses what LeRobot cannot hold: a number of frames per second that is not
    whole, or numbers that are not finite. Pictures are compressed, and so not kept bit by bit.
    """
    check_lerobot()
    output = Path(output)
    if output.exists():
        raise ValueError(f"{output}: it is there already: name a new folder")
    episodes = read_episodes(folder)
    fps = _fps(episodes.contents)
    features = features_of(episodes.contents)
    files = list(files_of(episodes, features))
    output.parent.mkdir(parents=True, exist_ok=True)
    with whole_folder(output, below=output.parent) as unfinished:
        for file in files:
            _write_numbers(episodes, features, file, unfinished, fps)
            for feature in features:
                if feature.is_video:
                    _write_video(episodes, feature, file, unfinished, fps)
        write_meta(episodes, features, files, unfinished, fps)
    return output


def _fps(contents: Contents) -> int:
    step_dt = contents.origin.step_dt
    if step_dt > 0.0:
        rate = 1.0 / step_dt
    else:
        rate = 0.0
    # A rate that rounds to 0 is below one frame per second, and one that is infinite has no whole number.
    if not 0.5 < rate < MOST_FPS or abs(rate - round(rate)) > 1e-6:
        raise ValueError(
            f"step_dt={step_dt:g} s is no whole number of frames per second, and LeRobot knows no other: choose "
            "task.decimation and the time step so that it is"
        )
    return round(rate)


def _write_numbers(
    episodes: Episodes, features: Sequence[Feature], file: DataFile, folder: Path, fps: int
) -> None:
    """Write the frames of a file as a table."""
    import pyarrow
    from pyarrow import parquet

    columns: dict[str, Any] = {}
    for feature in features:
        if feature.is_video:
            continue
        flat = episodes.env_states_D.get(feature.leaf.key)[file.frames].reshape(-1).numpy()
        values = pyarrow.array(flat)
        if feature.size != 1:
            values = pyarrow.FixedSizeListArray.from_arrays(values, feature.size)
        columns[feature.name] = values
    index = np.arange(file.frames.start, file.frames.stop, dtype=np.int64)
    episode = episodes.env_states_D.get(EPISODE_KEY)[file.frames].numpy()
    frame = np.concatenate([np.arange(stop - start) for start, stop in file.episodes.values()])
    columns |= {
        "timestamp": (frame / fps).astype(np.float32),
        "frame_index": frame.astype(np.int64),
        "episode_index": episode,
        "index": index,
        "task_index": np.zeros(len(index), dtype=np.int64),
    }
    path = folder / "data" / f"{file.name}.parquet"
    path.parent.mkdir(parents=True, exist_ok=True)
    parquet.write_table(pyarrow.table(columns), path)


def _write_video(
    episodes: Episodes, feature: Feature, file: DataFile, folder: Path, fps: int
) -> None:
    """Write the pictures of a file's frames as a video."""
    height, width, channels = feature.leaf.shape
    # Half the colours need even sides.
    if height % 2 or width % 2:
        colours = "yuv444p"
    else:
        colours = "yuv420p"
    path = folder / "videos" / feature.name / f"{file.name}.mp4"
    path.parent.mkdir(parents=True, exist_ok=True)
    options: dict[str, Any] = {
        "fps": fps,
        "codec": ENCODER,
        "quality": None,
        "pixelformat": colours,
        "macro_block_size": 1,
        "output_params": H264,
    }
    try:
        # Only pictures need it.
        import imageio.v2 as imageio

        writer: Any = imageio.get_writer(path, **options)
        with writer:
            for picture_HWC in episodes.env_states_D.get(feature.leaf.key)[file.frames]:
                writer.append_data(picture_HWC.expand(height, width, 3).numpy())
    except (ImportError, RuntimeError, OSError) as error:
        what = " ".join(str(error).split())[:500]
        raise RuntimeError(
            f"pictures of {'/'.join(feature.leaf.key)} ({channels} channels) did not become a video: {what}; ffmpeg "
            "comes with pip install imageio-ffmpeg"
        ) from error
