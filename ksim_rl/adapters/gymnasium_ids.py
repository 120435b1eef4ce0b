"""Registers the tasks with Gymnasium, under names such as "ksim_rl/walker_walk-v0"."""

import gymnasium

from ksim_rl import envs

NAMESPACE = "ksim_rl"
MODULE = "ksim_rl.adapters.gymnasium"


def register() -> None:
    """Register all tasks, plug-ins' too, for `gymnasium.make` and `gymnasium.make_vec`; those registered before stay.

    Gymnasium has looked for no plug-ins since its version 1.0: a module has to be imported, which
    `gymnasium.make("<module>:<name>")` does.
    """
    for task in envs.names():
        name = f"{NAMESPACE}/{task}-v0"
        if name in gymnasium.registry:
            continue
        gymnasium.register(
            name,
            entry_point=f"{MODULE}:make_task",
            vector_entry_point=f"{MODULE}:make_tasks",
            kwargs={"task": task},
        )
