"""Shows MuJoCo's warnings as lines on stderr.

Left alone, MuJoCo also writes them into MUJOCO_LOG.TXT of the working directory. In a stranger's folder that may be a
link, whose target would be written.
"""

import re

import mujoco

from ksim_rl.terminal import show

_shown: set[str] = set()


def show_warnings() -> None:
    """Show warnings from now on, each kind once, unless the program has a handler of its own."""
    if mujoco.get_mju_user_warning() is None:
        mujoco.set_mju_user_warning(_show)


def _show(text: bytes | str) -> None:
    line = text.decode(errors="replace") if isinstance(text, bytes) else text
    # Joints, worlds and times differ, and each of thousands of worlds may warn.
    kind = re.sub(r"[\d.]+", "", line)
    if kind not in _shown:
        _shown.add(kind)
        show(f"warning: MuJoCo: {' '.join(line.split())}", to_stderr=True)
