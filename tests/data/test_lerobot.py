"""A dataset of LeRobot has the numbers of its episodes, as its packages of version 0.4 read them."""

import json

import imageio.v2 as imageio
import numpy as np
import pytest
from pyarrow import parquet

from ksim_rl import data
from ksim_rl.data import lerobot, lerobot_layout
from ksim_rl.data.episode_folder import Origin
from ksim_rl.data.episode_writer import EpisodeWriter

LENGTHS = (4, 7, 5)


def episode_of(number, length):
    """An episode with a picture that changes smoothly, so that a video keeps it closely."""
    step_T = np.arange(length, dtype=np.float32)
    ramp_HW = np.add.outer(np.arange(16), np.arange(12)).astype(np.float32)
    rgb = ramp_HW[None, ..., None] * 5 + step_T[:, None, None, None] * 8 + np.array([0, 20, 40])
    end_T1 = step_T[:, None] == length - 1
    return {
        ("actor",): np.stack([step_T, step_T + number], 1),
        ("obs", "height"): step_T[:, None] * 2,
        ("obs", "grid"): np.arange(length * 6, dtype=np.float32).reshape(length, 2, 3),
        ("command", "speed"): np.full((length, 1), number, dtype=np.float32),
        ("rgb",): rgb.astype(np.uint8),
        ("action",): np.stack([step_T, -step_T, step_T], 1),
        ("next", "actor"): np.zeros((length, 2), dtype=np.float32),
        ("next", "reward"): step_T[:, None] + 10 * number,
        ("next", "done"): end_T1,
    }


def write_episodes(folder):
    episodes = [episode_of(number, length) for number, length in enumerate(LENGTHS)]
    leaves = [
        data.Leaf(key=key, shape=value.shape[1:], dtype=str(value.dtype))
        for key, value in episodes[0].items()
    ]
    columns = {"actor": {"obs/a": (0, 1), "obs/b": (1, 2)}}
    origin = Origin(task="fetch", step_dt=0.02, columns=columns)
    with EpisodeWriter(folder, leaves, origin=origin) as writer:
        for episode in episodes:
            writer.append(episode)


def columns_of(path):
    return parquet.read_table(path).to_pydict()


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """Written so that the first two episodes share a file, and the third has another."""
    folder = tmp_path_factory.mktemp("work")
    write_episodes(folder / "episodes")
    numbers = 4 * (2 + 1 + 6 + 1 + 3 + 1) + 1
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lerobot_layout, "MOST_NUMBER_BYTES", 11 * (numbers + 8))
        return data.write_lerobot(folder / "episodes", folder / "dataset")


def test_the_columns_are_named_as_lerobot_names_them(dataset):
    info = json.loads((dataset / "meta" / "info.json").read_text())
    assert info["codebase_version"] == "v3.0"
    assert (info["fps"], info["total_episodes"], info["total_frames"]) == (50, 3, 16)
    own = {name: feature["shape"] for name, feature in info["features"].items()}
    assert own == {
        "action": [3],
        "observation.state": [2],
        "observation.height": [1],
        "observation.grid": [6],
        "observation.command.speed": [1],
        "observation.images.rgb": [16, 12, 3],
        "next.reward": [1],
        "next.done": [1],
        **dict.fromkeys(["timestamp", "frame_index", "episode_index", "index", "task_index"], [1]),
    }
    assert info["features"]["observation.state"]["names"] == ["obs/a.0", "obs/b.0"]
    assert info["features"]["observation.images.rgb"]["dtype"] == "video"


def test_the_numbers_are_those_of_the_episodes(dataset):
    first = columns_of(dataset / "data" / "chunk-000" / "file-000.parquet")
    second = columns_of(dataset / "data" / "chunk-000" / "file-001.parquet")
    assert first["episode_index"] == [0] * 4 + [1] * 7
    assert second["index"] == list(range(11, 16))
    assert second["frame_index"] == list(range(5))
    assert second["timestamp"] == pytest.approx([0.0, 0.02, 0.04, 0.06, 0.08])
    episode = episode_of(2, 5)
    assert second["action"] == episode["action",].tolist()
    assert second["observation.grid"] == episode["obs", "grid"].reshape(5, 6).tolist()
    assert second["next.reward"] == [20.0, 21.0, 22.0, 23.0, 24.0]
    assert second["next.done"] == [False] * 4 + [True]


def test_the_videos_show_the_pictures(dataset):
    path = dataset / "videos" / "observation.images.rgb" / "chunk-000" / "file-000.mp4"
    frames = np.stack(imageio.mimread(path, memtest=False))
    pictures = [episode_of(number, length)["rgb",] for number, length in enumerate(LENGTHS[:2])]
    assert np.abs(frames - np.concatenate(pictures).astype(np.float32)).mean() < 3.0


def test_it_says_where_each_episode_lies(dataset):
    rows = columns_of(dataset / "meta" / "episodes" / "chunk-000" / "file-000.parquet")
    assert rows["data/file_index"] == [0, 0, 1]
    assert rows["dataset_from_index"] == [0, 4, 11]
    assert rows["dataset_to_index"] == [4, 11, 16]
    assert rows["tasks"] == [["fetch"]] * 3
    assert rows["videos/observation.images.rgb/from_timestamp"] == pytest.approx([0.0, 0.08, 0.0])
    assert rows["videos/observation.images.rgb/to_timestamp"] == pytest.approx([0.08, 0.22, 0.1])
    tasks = parquet.read_table(dataset / "meta" / "tasks.parquet")
    assert json.loads(tasks.schema.metadata[b"pandas"])["index_columns"] == ["task"]


def test_its_statistics_are_those_of_all_frames(dataset):
    stats = json.loads((dataset / "meta" / "stats.json").read_text())
    states = np.concatenate([episode_of(*pair)["actor",] for pair in enumerate(LENGTHS)])
    found = stats["observation.state"]
    assert found["mean"] == pytest.approx(states.mean(0).tolist())
    assert found["std"] == pytest.approx(states.std(0).tolist())
    assert found["q90"] == pytest.approx(np.quantile(states, 0.9, axis=0).tolist())
    assert found["count"] == [16]
    assert np.array(stats["observation.images.rgb"]["mean"]).shape == (3, 1, 1)
    assert stats["observation.images.rgb"]["max"][0][0][0] == pytest.approx((26 * 5 + 6 * 8) / 255)


def one_step(folder, value, **origin):
    leaves = [data.Leaf(key=("action",), shape=(1,))]
    with EpisodeWriter(folder, leaves, origin=Origin(**origin)) as writer:
        writer.append({("action",): np.full((1, 1), value, dtype=np.float32)})
    return folder


@pytest.mark.parametrize(
    ("value", "step_dt", "message"),
    [
        (0.0, 0.0, "step_dt=0 s is no whole number of frames"),
        (0.0, 0.03, "step_dt=0.03 s is no whole number of frames"),
        (0.0, 1e300, r"step_dt=1e\+300 s is no whole number of frames"),
        (0.0, 5e-324, "step_dt=4.94066e-324 s is no whole number of frames"),
        (np.nan, 0.02, "numbers that are not finite in action"),
    ],
)
def test_what_lerobot_cannot_hold_is_refused_and_leaves_nothing(tmp_path, value, step_dt, message):
    folder = one_step(tmp_path / "episodes", value, step_dt=step_dt)
    with pytest.raises(ValueError, match=message):
        data.write_lerobot(folder, tmp_path / "dataset")
    assert not (tmp_path / "dataset").exists()


def test_a_missing_package_is_named(monkeypatch):
    monkeypatch.setattr(lerobot.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"pip install 'ksim_rl\[lerobot\]'"):
        lerobot.check_lerobot()


def test_two_leaves_of_one_name_are_refused(tmp_path):
    leaves = [data.Leaf(key=("actor",)), data.Leaf(key=("state",))]
    with EpisodeWriter(tmp_path / "episodes", leaves, origin=Origin(step_dt=0.1)) as writer:
        writer.append({leaf.key: np.zeros(1, dtype=np.float32) for leaf in leaves})
    with pytest.raises(ValueError, match=r"two leaves would be called observation\.state"):
        data.write_lerobot(tmp_path / "episodes", tmp_path / "dataset")


def test_a_grey_picture_of_odd_sides_becomes_a_video(tmp_path):
    leaves = [data.Leaf(key=("depth",), shape=(15, 9, 1), dtype="uint8")]
    grey = np.full((6, 15, 9, 1), 80, dtype=np.uint8)
    with EpisodeWriter(tmp_path / "episodes", leaves, origin=Origin(step_dt=0.1)) as writer:
        writer.append({("depth",): grey})
    data.write_lerobot(tmp_path / "episodes", tmp_path / "dataset")
    path = next((tmp_path / "dataset").rglob("*.mp4"))
    frames = np.stack(imageio.mimread(path, memtest=False))
    assert frames.shape == (6, 15, 9, 3)
    assert np.abs(frames - 80.0).max() < 5.0
