"""Videos of what `env.render()` shows."""

import os
import signal
from contextlib import suppress

import imageio.v2 as imageio
import numpy as np
import pytest
import torch
from tensordict.nn import TensorDictModule

from ksim_rl.envs.contract import Pictures
from ksim_rl.trainers import video
from ksim_rl.trainers.video import VideoUnavailableError, record
from tests.trainers.target_env import TargetEnv, make_env


@pytest.fixture(autouse=True)
def _nothing_failed_yet(monkeypatch):
    monkeypatch.setattr(video, "_failed", [])


Pictures.register(TargetEnv)


def filmed(render):
    env = make_env(1)
    env.base_env.__dict__["render"] = render

    return env


def still():
    return TensorDictModule(torch.zeros_like, in_keys=["actor"], out_keys=["action"])


class Camera:
    """Gives frames that brighten."""

    def __init__(self):
        self.count = 0

    def __call__(self):
        self.count += 1
        return np.full((48, 64, 3), min(255, 20 * self.count), np.uint8)


def test_an_mp4_has_a_frame_per_step(tmp_path):
    path = record(filmed(Camera()), still(), tmp_path / "video.mp4", steps=10, step_dt=0.04)
    frames = imageio.mimread(path)
    assert path.name == "video.mp4"
    assert len(frames) == 10
    assert frames[0].shape == (48, 64, 3)
    assert frames[8].mean() > frames[0].mean() + 100


@pytest.mark.parametrize(
    ("step_dt", "fps", "drawn", "shown"),
    [
        (0.02, 25.0, 10, 25.0),
        (0.02, 5.0, 2, 5.0),
        (0.01, 50.0, 10, 50.0),
        (0.04, 50.0, 20, 25.0),
        (0.02, 20.0, 10, 25.0),
        (0.02, 15.0, 7, 50 / 3),
    ],
    ids=["half", "a tenth", "fast steps", "slow steps", "between", "every third"],
)
def test_so_many_pictures_are_drawn_as_asked_at_real_speed(tmp_path, step_dt, fps, drawn, shown):
    camera = Camera()
    path = record(
        filmed(camera), still(), tmp_path / "video.mp4", steps=20, step_dt=step_dt, fps=fps
    )
    assert camera.count == drawn
    told = imageio.get_reader(path).get_meta_data()
    assert told["fps"] == pytest.approx(shown, rel=1e-3)
    assert told["duration"] == pytest.approx(drawn / shown, abs=0.02)


def test_without_an_encoder_there_is_a_gif(tmp_path, monkeypatch):
    real = imageio.get_writer

    def no_ffmpeg(path, **options):
        if str(path).endswith(".mp4"):
            raise RuntimeError("No ffmpeg exe could be found")
        return real(path, **options)

    monkeypatch.setattr(imageio, "get_writer", no_ffmpeg)
    path = record(filmed(Camera()), still(), tmp_path / "video.mp4", steps=4, step_dt=0.04)
    assert path.name == "video.gif"
    assert len(imageio.mimread(path)) == 4
    assert imageio.get_reader(path).get_meta_data()["duration"] == pytest.approx(40.0)


def test_a_signal_that_comes_while_the_encoder_is_forked_is_not_lost(tmp_path, monkeypatch):
    class Forking:
        frames = 0

        def append_data(self, frame):
            # Python drops what is raised in its hooks around a fork.
            with suppress(KeyboardInterrupt):
                os.kill(os.getpid(), signal.SIGTERM)
            self.frames += 1

        def __enter__(self):
            return self

        def __exit__(self, *_):
            pass

    def interrupt(number, _frame):
        raise KeyboardInterrupt(number)

    writer = Forking()
    monkeypatch.setattr(imageio, "get_writer", lambda *_, **__: writer)
    previous = signal.signal(signal.SIGTERM, interrupt)
    try:
        with pytest.raises(KeyboardInterrupt):
            record(filmed(Camera()), still(), tmp_path / "video.mp4", steps=4, step_dt=0.04)
    finally:
        signal.signal(signal.SIGTERM, previous)
    assert writer.frames == 1 and list(tmp_path.iterdir()) == []


def test_without_opengl_the_reason_and_the_fix_are_passed_on(tmp_path):
    def blind():
        raise RuntimeError("no OpenGL platform for off-screen rendering. Fixes: ...")

    with pytest.raises(VideoUnavailableError, match="Fixes"):
        record(filmed(blind), still(), tmp_path / "video.mp4", steps=4, step_dt=0.04)
    assert list(tmp_path.iterdir()) == []


def test_a_platform_that_failed_is_not_tried_again(tmp_path):
    calls = []

    def blind():
        calls.append(1)
        raise RuntimeError("no OpenGL platform")

    for _ in range(2):
        with pytest.raises(VideoUnavailableError, match="no OpenGL platform"):
            record(filmed(blind), still(), tmp_path / "video.mp4", steps=4, step_dt=0.04)
    assert len(calls) == 1


def test_an_env_without_render_mode_is_named(tmp_path):
    with pytest.raises(VideoUnavailableError, match="render_mode='rgb_array'"):
        record(filmed(lambda: None), still(), tmp_path / "video.mp4", steps=4, step_dt=0.04)
