"""Pictures. What needs OpenGL is skipped, with the reason, where no platform works."""

import dataclasses
from dataclasses import dataclass

import mujoco
import numpy as np
import pytest
import torch

from ksim_rl.envs import (
    ImuSensor,
    ManagerBasedRlEnv,
    ManagerBasedRlEnvCfg,
    ViewerCfg,
)
from ksim_rl.scene.rendering import rendering
from ksim_rl.scene.scene import MjcfRobot, Placement, SceneCfg
from ksim_rl.scene.terrains import PlaneTerrain
from tests.envs.probe_env import DT, PUCK_XML, Launch, Position, Target, puck_cfg, push

WIDTH, HEIGHT = 64, 48
# From above, 0.1 m of radius in a picture that shows about 0.8 m of height.
TOP = ViewerCfg(
    lookat=(0.0, 0.0, 0.0), distance=1.0, elevation=-90.0, azimuth=90.0, width=WIDTH, height=HEIGHT
)


@pytest.fixture(scope="module")
def gl():
    """Skip where MuJoCo cannot draw."""
    try:
        rendering.choose_gl_platform()
        mujoco.Renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), HEIGHT, WIDTH).close()
    except Exception as error:
        pytest.skip(f"no OpenGL here: {error}")


@dataclass(frozen=True, kw_only=True)
class DrawnTarget(Target):
    """Draws a ball beside the puck, and remembers for which env."""

    def draw_debug(self, view, visualizer, env_index):
        x = float(view.joint_pos_EL[env_index, 0])
        visualizer.sphere((x, 0.25, 0.0), radius=0.08, rgba=(1.0, 0.0, 0.0, 1.0))


def filmed(viewer=TOP, **fields) -> ManagerBasedRlEnv:
    cfg = puck_cfg(limit=None, events={"launch": Launch(speed=0.0)}, viewer=viewer, **fields)
    return ManagerBasedRlEnv(cfg, render_mode="rgb_array")


def place(env, *positions):
    """Put each env's puck somewhere on its rail, after a reset."""
    env.reset()
    for row, x in enumerate(positions):
        env.world.qpos_EL[row] = x


def lit(picture):
    """Return where something is drawn: the background is black."""
    return picture.max(-1) > 20


def blobs(mask):
    """Count the runs of columns and of rows in which something is drawn."""
    return tuple(
        int((np.diff(mask.any(axis).astype(int), prepend=0) == 1).sum()) for axis in (0, 1)
    )


def test_a_picture_shows_the_puck_in_its_middle(gl):
    env = filmed()
    place(env, 0.0)
    picture = env.render()
    assert picture.shape == (HEIGHT, WIDTH, 3) and picture.dtype == np.uint8
    rows, columns = np.nonzero(lit(picture))
    assert 0.01 < lit(picture).mean() < 0.5
    assert abs(rows.mean() - (HEIGHT - 1) / 2) < 1.5 and abs(columns.mean() - (WIDTH - 1) / 2) < 1.5
    env.close()


def test_the_picture_is_of_the_present_state_and_the_chosen_env(gl):
    # Azimuth 90: the camera's right is world x.
    env = filmed(dataclasses.replace(TOP, env_index=1), num_envs=2)
    place(env, 0.0, 0.2)
    right = np.nonzero(lit(env.render()))[1].mean()
    place(env, 0.0, -0.2)
    left = np.nonzero(lit(env.render()))[1].mean()
    assert right > WIDTH / 2 + 5 and left < WIDTH / 2 - 5
    env.close()


def test_the_camera_follows_its_body(gl):
    env = filmed(dataclasses.replace(TOP, body="puck", lookat=(9.0, 9.0, 9.0)))
    place(env, 0.0)
    here = env.render()
    place(env, 3.0)
    there = env.render()
    assert lit(here).any() and np.array_equal(lit(here), lit(there))
    env.close()


def test_its_shadow_follows_too(gl):
    aside = dataclasses.replace(TOP, body="puck", elevation=-30.0, distance=2.0)
    robots, placements = (
        {"puck": MjcfRobot(source=PUCK_XML)},
        {"puck": Placement(pos=(0.0, 0.0, 0.5))},
    )
    scene = SceneCfg(robots=robots, placements=placements, terrain=PlaneTerrain(), num_envs=3)
    env = filmed(aside, scene=scene)

    def shadow(picture):
        return (picture[HEIGHT // 2 + 6 :].max(-1) < 25).sum()

    place(env, 0.0)
    here = env.render()
    place(env, 4.0)
    there = env.render()
    assert shadow(here) > 5 and shadow(there) > 5
    env.close()


def test_a_picture_may_be_larger_than_the_models_buffer(gl):
    env = filmed(dataclasses.replace(TOP, width=960, height=720))
    place(env, 0.0)
    assert env.render().shape == (720, 960, 3)
    env.close()


def test_several_envs_stand_side_by_side(gl):
    wide = dataclasses.replace(TOP, lookat=(0.25, 0.25, 0.0), distance=1.8, num_envs=4)
    scene = puck_cfg(num_envs=6).scene
    cfg = puck_cfg(limit=None, events={"launch": Launch(speed=0.0)}, viewer=wide)
    cfg = dataclasses.replace(cfg, scene=dataclasses.replace(scene, spacing=0.5))
    env = ManagerBasedRlEnv(cfg, render_mode="rgb_array")
    place(env, *[0.0] * 6)
    assert blobs(lit(env.render())) == (2, 2), "a square of four"
    env.close()


def test_no_more_envs_are_drawn_than_there_are(gl):
    env = filmed(dataclasses.replace(TOP, distance=8.0, num_envs=9), num_envs=2)
    place(env, 0.0, 0.0)
    assert blobs(lit(env.render())) == (2, 1)
    env.close()


def test_terms_draw_into_the_picture(gl):
    def red_pixels(commands):
        env = filmed(commands=commands)
        place(env, 0.0)
        picture = env.render().astype(int)
        env.close()
        return int((picture[..., 0] > picture[..., 1:].max(-1) + 80).sum())

    times = (DT, DT)
    assert red_pixels({"target": DrawnTarget(resampling_time_range_s=times)}) > 20
    assert red_pixels({"target": Target(resampling_time_range_s=times)}) == 0


def test_each_env_of_the_picture_is_drawn_with_its_marks(gl):
    wide = dataclasses.replace(TOP, lookat=(0.25, 0.25, 0.0), distance=1.8, num_envs=4)
    cfg = drawing_cfg(viewer=wide, num_envs=4, events={"launch": Launch(speed=0.0)})
    cfg = dataclasses.replace(cfg, scene=dataclasses.replace(cfg.scene, spacing=0.5))
    env = ManagerBasedRlEnv(cfg, render_mode="rgb_array")
    place(env, *[0.0] * 4)
    picture = env.render().astype(int)
    assert blobs(picture[..., 1] > picture[..., [0, 2]].max(-1) + 60) == (2, 2), (
        "a green ball over each puck"
    )
    assert blobs(picture[..., 0] > picture[..., 1:].max(-1) + 60) == (2, 2), "a red one beside it"
    env.close()


def test_the_picture_shows_the_envs_own_model_fields(gl):
    @dataclass(frozen=True, kw_only=True)
    class Grow(Launch):
        per_world_fields = ("geom_size",)

        def __call__(self, view, mask_E):
            super().__call__(view, mask_E)
            view.field("geom_size")[:, 0, 0] = torch.tensor([0.05, 0.2])

    def area(env_index):
        viewer = dataclasses.replace(TOP, env_index=env_index)
        cfg = puck_cfg(limit=None, events={"grow": Grow(speed=0.0)}, viewer=viewer, num_envs=2)
        env = ManagerBasedRlEnv(cfg, render_mode="rgb_array")
        place(env, 0.0, 0.0)
        picture = env.render()
        env.close()
        return lit(picture).sum()

    assert area(1) > 6 * area(0), "four times the radius"


def test_a_closed_renderer_opens_again_for_the_next_env(gl):
    for _ in range(2):
        env = filmed()
        place(env, 0.0)
        assert lit(env.render()).any()
        env.close()


# -- without OpenGL ----------------------------------------------------------------------------------------------


def test_without_opengl_the_error_names_the_fixes(monkeypatch):
    def no_opengl(*args, **kwargs):
        raise AttributeError("'NoneType' object has no attribute 'glGetError'")

    monkeypatch.setattr(rendering, "choose_gl_platform", lambda: "osmesa")
    monkeypatch.setattr(mujoco, "Renderer", no_opengl)
    env = filmed()
    env.reset()
    with pytest.raises(RuntimeError) as caught:
        env.render()
    for word in ("libegl1", "libosmesa6", "Xvfb", "DISPLAY", "MUJOCO_GL is 'osmesa'", "glGetError"):
        assert word in str(caught.value)
    env.close()


def test_without_a_render_mode_there_is_no_picture_and_no_opengl(monkeypatch):
    def unexpected(*args, **kwargs):
        raise AssertionError("nothing is to be drawn")

    monkeypatch.setattr(mujoco, "Renderer", unexpected)
    assert ManagerBasedRlEnv(puck_cfg()).render() is None


def test_an_unknown_render_mode_is_refused():
    with pytest.raises(ValueError, match="render_mode='human': expected one of"):
        ManagerBasedRlEnv(puck_cfg(), render_mode="human")


def test_an_unknown_body_is_refused_before_the_first_picture():
    with pytest.raises(ValueError, match=r"viewer\.body='puk': did you mean 'puck'"):
        filmed(dataclasses.replace(TOP, body="puk"))


def test_an_env_that_does_not_exist_cannot_be_drawn():
    with pytest.raises(
        ValueError, match=r"viewer\.env_index=3: expected less than scene\.num_envs=3"
    ):
        puck_cfg(num_envs=3, viewer=ViewerCfg(env_index=3))


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("distance", 0.0),
        ("elevation", -100.0),
        ("azimuth", 400.0),
        ("width", 0),
        ("num_envs", 0),
        ("env_index", -1),
    ],
)
def test_cameras_out_of_range_are_refused(field, value):
    with pytest.raises(ValueError, match=f"{field}={value}"):
        ViewerCfg(**{field: value})


class Recorder:
    """A visualizer that notes what is drawn."""

    def __init__(self):
        self.spheres = []

    def sphere(self, center, *, radius, rgba):
        self.spheres.append((tuple(center), radius))


def test_update_visualizers_calls_the_terms_that_draw():
    cfg: ManagerBasedRlEnvCfg = puck_cfg(
        num_envs=2,
        limit=None,
        viewer=ViewerCfg(env_index=1),
        commands={"target": DrawnTarget(resampling_time_range_s=(DT, DT))},
    )
    env = ManagerBasedRlEnv(cfg)
    push(env, env.reset())
    recorder = Recorder()
    env.update_visualizers(recorder)
    ((center, radius),) = recorder.spheres
    assert center == pytest.approx((2.0 * DT, 0.25, 0.0)) and radius == 0.08, "env 1 moves at 2 m/s"
    assert list(env.setup_manager_visualizers()) == ["commands/target"]
    env.update_visualizers(recorder, env_index=0)
    assert recorder.spheres[1][0] == pytest.approx((1.0 * DT, 0.25, 0.0))


@dataclass(frozen=True, kw_only=True)
class DrawnPosition(Position):
    """Draws a ball above the puck."""

    def draw_debug(self, view, visualizer, env_index):
        x = float(view.joint_pos_EL[env_index, 0])
        visualizer.sphere((x, 0.0, 0.3), radius=0.05, rgba=(0.0, 1.0, 0.0, 1.0))


def drawing_cfg(**fields) -> ManagerBasedRlEnvCfg:
    cfg = puck_cfg(
        limit=None,
        commands={
            "target": DrawnTarget(resampling_time_range_s=(DT, DT)),
            "other": Target(resampling_time_range_s=(DT, DT)),
        },
        rewards={
            "position": DrawnPosition(),
            "unused": DrawnPosition(weight=0.0),
            "plain": Position(),
        },
        **fields,
    )
    unit = ImuSensor(body="puck")
    return dataclasses.replace(cfg, scene=dataclasses.replace(cfg.scene, sensors={"imu": unit}))


@pytest.mark.parametrize(
    ("draw", "names"),
    [
        ((".*",), ["commands/target", "rewards/position", "sensors/imu"]),
        (("rewards/.*", "sensors/im."), ["rewards/position", "sensors/imu"]),
        ((), []),
    ],
)
def test_commands_rewards_and_sensors_draw_if_the_viewer_asks_for_them(draw, names):
    env = ManagerBasedRlEnv(drawing_cfg(viewer=ViewerCfg(draw=draw)))
    assert list(env.setup_manager_visualizers()) == names


def test_a_pattern_that_is_none_is_refused():
    with pytest.raises(ValueError, match=r"draw\[0\]='\(': no regular expression"):
        ViewerCfg(draw=("(",))
