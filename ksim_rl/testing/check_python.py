"""Finds Python code of an env that changes from step to step, which a recorded step would freeze."""

from torchrl.envs import EnvBase

from ksim_rl.envs.contract import SimulatedWorld, part
from ksim_rl.envs.recorded_python import FrozenPythonError, RecordedPython
from ksim_rl.testing.replays import Replays


def check_python(env: EnvBase, num_steps: int) -> None:
    """A step leaves all Python values as they are, and asks the host for no clock, random number or file.

    An env on the CPU without a world of ours may do otherwise, since nothing of it is recorded.
    """
    # There nothing is recorded, except where the world can be compiled.
    on_cpu = env.device is None or env.device.type == "cpu"
    is_compared = part(env, SimulatedWorld) is not None
    if on_cpu and not is_compared:
        return
    replays = Replays(env, num_steps)
    python = RecordedPython(env, is_compared=is_compared)
    root = replays.start()
    index = 0
    try:
        # As many steps as it takes to know: the first may fill caches, the second is judged.
        while not python.is_known:
            with python.calling():
                _, root = replays.step(root, index % num_steps)
            index += 1
    except FrozenPythonError as error:
        raise AssertionError(str(error)) from error
