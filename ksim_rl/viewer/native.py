"""MuJoCo's own window shows a session, on a machine with a display."""

import copy
import time
import warnings
from collections.abc import Callable

import glfw
import mujoco
import mujoco.viewer

from ksim_rl.scene.rendering.rendering import pose_env
from ksim_rl.scene.rendering.visualizer import DebugVisualizer
from ksim_rl.viewer.session import SPEEDS, Session

FRAME_S = 1.0 / 60.0
# MuJoCo's window itself takes all letters, to switch parts of its picture.
HELP = "space pauses, right steps, Backspace resets, Enter pushes, - and = set the speed, up and down the env"


def check_display() -> None:
    """Raise a ValueError where there is no display to open a window on."""
    # GLFW warns where there is no display; our error says it better.
    with warnings.catch_warnings(category=glfw.GLFWError, action="ignore"):
        if not glfw.init():
            raise ValueError(
                "--viewer native: no display to open a window on; --viewer browser needs none"
            )
    glfw.terminate()


def show(session: Session, *, note: Callable[[str], None]) -> None:
    """Show a session in a window until that is closed; `HELP` lists the keys.

    Without a display it waits forever: see `check_display`.
    """
    # A copy, since the shown env's own fields are written into it.
    mj_model = copy.copy(session.ours.world.mj_model)
    data = mujoco.MjData(mj_model)
    keys = _keys(session)

    def pressed(code: int) -> None:
        if code in keys:
            # Called in the window's thread.
            session.ask(keys[code])

    note(HELP)
    window = mujoco.viewer.launch_passive(mj_model, data, key_callback=pressed, show_left_ui=False)
    said = ""
    with window:
        while window.is_running():
            start = time.monotonic()
            session.advance()
            if session.error and session.error != said:
                note(f"paused by an error: {session.error}; space goes on")
            said = session.error
            # The window draws in a thread of its own: hold it while the state changes.
            with window.lock():
                pose_env(mj_model, data, session.ours.world, session.env_index)
                marks = window.user_scn
                assert marks is not None
                # The marks of the last frame.
                marks.ngeom = 0
                session.ours.update_visualizers(DebugVisualizer(mj_model, marks), session.env_index)
            window.sync()
            time.sleep(max(0.001, FRAME_S - (time.monotonic() - start)))


def _keys(session: Session) -> dict[int, Callable[[], None]]:
    def speed(change: int) -> None:
        now = SPEEDS.index(session.speed)
        session.speed = SPEEDS[min(max(now + change, 0), len(SPEEDS) - 1)]

    def env(change: int) -> None:
        session.choose((session.env_index + change) % session.ours.num_envs)

    return {
        glfw.KEY_SPACE: lambda: session.play(not session.playing),
        glfw.KEY_RIGHT: session.step_once,
        glfw.KEY_BACKSPACE: session.reset,
        glfw.KEY_ENTER: lambda: session.push(1.0),
        glfw.KEY_MINUS: lambda: speed(-1),
        glfw.KEY_EQUAL: lambda: speed(1),
        glfw.KEY_DOWN: lambda: env(-1),
        glfw.KEY_UP: lambda: env(1),
    }
