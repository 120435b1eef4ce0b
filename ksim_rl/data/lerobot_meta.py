"""Writes LeRobot's metadata of a dataset: sizes, columns, where episodes lie, the task and statistics."""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Shaped
from torch import Tensor

from ksim_rl.data.episode_folder import Contents
from ksim_rl.data.episode_reader import Episodes
from ksim_rl.data.lerobot_layout import FILES_PER_CHUNK, DataFile, Feature
from ksim_rl.files.writing import write_whole

VERSION = "v3.0"
# What LeRobot's own tools keep to where they add to a dataset, in MB.
DATA_MB = 100
VIDEO_MB = 200
QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
# Statistics of quantiles and pictures are of so many frames, evenly spaced.
MOST_FRAMES_OF_QUANTILES = 100_000
MOST_FRAMES_OF_PICTURES = 1_000


def write_meta(
    episodes: Episodes,
    features: Sequence[Feature],
    files: Sequence[DataFile],
    folder: Path,
    fps: int,
) -> None:
    """Write the metadata: sizes, columns, where episodes lie, the task and statistics."""
    import pyarrow
    from pyarrow import parquet

    contents = episodes.contents
    meta = folder / "meta"
    table = pyarrow.Table.from_pylist(list(_episode_rows(contents, features, files, fps)))
    path = meta / "episodes" / "chunk-000" / "file-000.parquet"
    path.parent.mkdir(parents=True, exist_ok=True)
    parquet.write_table(table, path)
    parquet.write_table(_tasks(contents.origin.task), meta / "tasks.parquet")
    stats = {feature.name: _stats(episodes, feature) for feature in features}
    try:
        text = json.dumps(stats, allow_nan=False, indent=1)
    except ValueError:
        broken = [name for name, found in stats.items() if not np.isfinite(found["mean"]).all()]
        raise ValueError(
            f"numbers that are not finite in {', '.join(broken)}: LeRobot's statistics cannot hold them"
        ) from None
    write_whole(meta / "stats.json", text)
    own = {feature.name: feature.about for feature in features}
    indices = ("frame_index", "episode_index", "index", "task_index")
    own["timestamp"] = {"dtype": "float32", "shape": [1], "names": None}
    for name in indices:
        own[name] = {"dtype": "int64", "shape": [1], "names": None}
    has_videos = any(feature.is_video for feature in features)
    info = {
        "codebase_version": VERSION,
        "robot_type": None,
        "total_episodes": contents.num_episodes,
        "total_frames": contents.num_env_states,
        "total_tasks": 1,
        "chunks_size": FILES_PER_CHUNK,
        "data_files_size_in_mb": DATA_MB,
        "video_files_size_in_mb": VIDEO_MB,
        "fps": fps,
        "splits": {"train": f"0:{contents.num_episodes}"},
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": None,
        "features": own,
    }
    if has_videos:
        info["video_path"] = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
    write_whole(meta / "info.json", json.dumps(info, indent=1))


def _episode_rows(
    contents: Contents, features: Sequence[Feature], files: Sequence[DataFile], fps: int
) -> Iterator[dict[str, Any]]:
    """Yield the line of each episode, which says where its frames lie."""
    for file in files:
        chunk, number = file.place
        for episode, (start, stop) in file.episodes.items():
            row: dict[str, Any] = {
                "episode_index": episode,
                "tasks": [contents.origin.task],
                "length": stop - start,
                "data/chunk_index": chunk,
                "data/file_index": number,
                "dataset_from_index": start,
                "dataset_to_index": stop,
                "meta/episodes/chunk_index": 0,
                "meta/episodes/file_index": 0,
            }
            for feature in features:
                if feature.is_video:
                    of_video = f"videos/{feature.name}"
                    row[f"{of_video}/chunk_index"] = chunk
                    row[f"{of_video}/file_index"] = number
                    row[f"{of_video}/from_timestamp"] = (start - file.frames.start) / fps
                    row[f"{of_video}/to_timestamp"] = (stop - file.frames.start) / fps
            yield row


def _tasks(task: str) -> Any:
    """Return the table of tasks, whose index is the text: pandas, by which LeRobot reads it, finds it in the schema."""
    import pyarrow

    table = pyarrow.table({"task_index": np.zeros(1, dtype=np.int64), "task": [task]})
    columns = [
        {"name": "task_index", "numpy_type": "int64", "pandas_type": "int64"},
        {"name": "task", "numpy_type": "object", "pandas_type": "unicode"},
    ]
    for column in columns:
        column |= {"field_name": column["name"], "metadata": None}
    about = {"columns": columns, "index_columns": ["task"], "column_indexes": []}
    return table.replace_schema_metadata({"pandas": json.dumps(about)})


def _stats(episodes: Episodes, feature: Feature) -> dict[str, Any]:
    """Return the statistics of a column, of each number by itself; of a picture of each channel, from 0 to 1."""
    rows_D = episodes.env_states_D.get(feature.leaf.key)
    count = len(rows_D)
    if feature.is_video:
        rows_D = _evenly(rows_D, MOST_FRAMES_OF_PICTURES)
        count = len(rows_D)
        values = rows_D.expand(*rows_D.shape[:3], 3).reshape(-1, 3).numpy() / 255.0
        shape = (3, 1, 1)
    else:
        values = rows_D.reshape(count, -1).numpy().astype(np.float64)
        shape = (feature.size,)
    found: dict[str, Any] = {
        "min": values.min(0),
        "max": values.max(0),
        "mean": values.mean(0),
        "std": values.std(0),
    }
    some = _evenly(torch.from_numpy(values), MOST_FRAMES_OF_QUANTILES).numpy()
    for name, share in QUANTILES.items():
        found[name] = np.quantile(some, share, axis=0)
    plain: dict[str, Any] = {name: value.reshape(shape).tolist() for name, value in found.items()}
    return {**plain, "count": [count]}


def _evenly(rows_D: Shaped[Tensor, "D *?leaf"], most: int) -> Shaped[Tensor, "N *?leaf"]:
    """Return so many rows at most, evenly spaced."""
    step = -(-len(rows_D) // most)
    return rows_D[::step]
