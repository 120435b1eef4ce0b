"""Names the parts that an export of a policy will lack, before its training, when there is time to mend it."""

from collections.abc import Callable

from torchrl.envs import EnvBase

from ksim_rl.envs import ManagerBasedRlEnv
from ksim_rl.envs.contract import part
from ksim_rl.export import controls
from ksim_rl.export.described_commands import described_commands
from ksim_rl.export.exported_transforms import sort_transforms
from ksim_rl.export.metadata import metadata
from ksim_rl.export.picture_inputs import describe_sight
from ksim_rl.export.traced_task import trace_task
from ksim_rl.trainers.run_cfg import RunCfg


def say_lacks(cfg: RunCfg, env: EnvBase, note: Callable[[str], None]) -> None:
    """Name in one line each the terms that `export` will refuse or leave out of a policy trained in this env."""
    # Other envs cannot be exported at all, which `export` says itself.
    ours = part(env, ManagerBasedRlEnv)
    if ours is None:
        return
    keys = cfg.modules.observation_keys("actor")
    # Tracing and describing are the parts of an export that may fail; they write nothing here.
    try:
        sight = describe_sight(ours.cfg, keys)
        seen = {picture.group for picture in sight.pictures}
        groups = [str(key) for key in keys if key not in seen]
        transforms = sort_transforms(ours.cfg, groups)
        for name in dict.fromkeys([*transforms.training_only, *sight.training_only]):
            note(f"task.transforms.{name} acts in training only: an export leaves it out")
        traced = trace_task(ours, groups, note)
        commands = described_commands(ours, ours.cfg.curriculum.values(), 0)
        metadata(ours, controls.observations(ours, groups), transforms, traced, commands)
    except ValueError as error:
        note(f"`ksim-rl export` will refuse this run: {error}")
