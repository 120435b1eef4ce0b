"""Writes the folder that takes a policy out of the library: the policy, its robot, and their descriptions."""

import dataclasses
import importlib.util
import json
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ksim_rl.envs import ManagerBasedRlEnv
from ksim_rl.envs.contract import part
from ksim_rl.export import controls, policy, policy_check
from ksim_rl.export.described_commands import described_commands
from ksim_rl.export.exported_transforms import (
    TaskTransforms,
    check_equal,
    sort_transforms,
    with_transforms,
)
from ksim_rl.export.metadata import metadata
from ksim_rl.export.onnx_file import attach
from ksim_rl.export.picture_inputs import describe_sight
from ksim_rl.export.record import Kept, Recording
from ksim_rl.export.robot import write_robot
from ksim_rl.export.standalone.files import Json
from ksim_rl.export.traced_task import TracedTask, greatest_difference, trace_task
from ksim_rl.files.writing import check_folder, check_own, whole_folder
from ksim_rl.physics import prepare_spec
from ksim_rl.runs import record
from ksim_rl.scene.keyframes import add_joined
from ksim_rl.scene.scene import scene_spec
from ksim_rl.scene.state.default_state import default_data
from ksim_rl.terminal import show
from ksim_rl.trainers import checkpoint
from ksim_rl.trainers.build import EVALUATION_SEED_OFFSET, UNLIMITED_EPISODE_STEPS, build_env
from ksim_rl.trainers.run_cfg import RunCfg
from ksim_rl.trainers.run_folder import Policy, policy_of

STANDALONE = Path(__file__).parent / "standalone"
# Each needs only those before it, since they become one file.
PARTS = (
    "description",
    "files",
    "commands",
    "models",
    "contacts",
    "network",
    "signals",
    "sight",
    "stages",
    "runner",
    "robot_link",
    "simulated_robot",
    "command",
)
"""The modules of `runner.py`, in this order."""
LOOP_PARTS = (
    "description",
    "files",
    "commands",
    "network",
    "stages",
    "robot_link",
    "policy_control",
    "plan_control",
    "safety",
    "picture_watch",
    "deadlines",
    "dry_run",
    "states",
    "journal",
    "words",
    "loop",
    "loop_command",
)
"""The modules of `loop.py`, which has to run where there is no MuJoCo."""
_SIMULATED = "from ksim_rl.export.standalone.simulated_robot import SimulatedRobot\n"
# Episodes of trace.npz and env steps of each: enough for the causes, and small beside the recorded episodes.
TRACED = 4
TRACED_STEPS = 60
FILES = (
    "policy.onnx",
    "policy.pt2",
    "obs.onnx",
    "scores.onnx",
    "robot.xml",
    "export.json",
    "runner.py",
    "loop.py",
    "README.md",
    "episodes.npz",
    "trace.npz",
)
# The entries of export.json that controllers for mjlab's policies look for in the ONNX file, and more of the kind.
ATTACHED = (
    *(
        "run_path",
        "joint_names",
        "joint_stiffness",
        "joint_damping",
        "default_joint_pos",
        "action_scale",
    ),
    *(
        "command_names",
        "observation_names",
        "observation_history_lengths",
        "physics_dt",
        "decimation",
    ),
    *("step_dt", "task", "iteration", "commit"),
)
EXTRA = ("onnx", "onnxruntime", "onnxscript")
README = """# {task}, iteration {iteration}

| file | what is in it |
|---|---|
| `policy.onnx` | {read} to `actions` [batch, {num_actions}], normalization inside{state} |
| `policy.pt2` | the same for `torch.export.load` |
{observes}| `scores.onnx` | terminations, rewards and metrics, for simulators |
| `robot.xml` | the robot's model; actuators stand in the order of the actions |
| `export.json` | names, order, scales, gains, rates, noise, lags; which quantities the ONNX files read |
| `runner.py` | `python runner.py --episodes 100` runs it on MuJoCo's C engine; needs numpy, onnxruntime, mujoco |
| `loop.py` | `python loop.py --simulate` runs it as a loop in real time, as a robot's computer does |
| `episodes.npz`, `trace.npz` | starts, commands and pushes of recorded episodes, and steps to compare with |

The policy's actions equal the trained network's within {difference:.1e} on {checked} observations{equal}.
One step lasts {step_dt:g} s, of {decimation} physics steps. Joints, in the order of actions: {joints}.
"""

OBSERVES = (
    "| `obs.onnx` | what a robot measures, one batch row, to `obs` before noise, clip and scale; `obs` in "
    "`export.json` |\n"
)


def export(
    run: Path,
    folder: Path | None = None,
    *,
    device: str = "cpu",
    origin: Json | None = None,
    **options: Any,
) -> Path:
    """Write the policy of a run into `folder`, `<run>/export` by default, and return it; see `export_policy`.

    `origin` may hold another path, commit or versions than the record of the run.
    """
    saved = checkpoint.load_latest(run)
    run_folder = saved.run_folder
    # Relative to the folder of runs, so that the export names no folder of this machine.
    found: Json = {"run_path": str(saved.path.absolute().relative_to(run_folder.parent))}
    # Commit and versions that trained the policy, not those that export it.
    sessions = record.read(run_folder)
    if sessions:
        commit = sessions[-1].code.get("ksim_rl", {}).get("commit")
        found |= {"commit": commit, "versions": dict(sessions[-1].versions)}
    below = run_folder if folder is None else folder
    if folder is None:
        folder = run_folder / "export"
    check_folder(folder, below=below)
    for name in FILES:  # before minutes of work
        check_own(folder / name)
    return export_policy(
        policy_of(saved, device=device),
        folder,
        below=below,
        origin={**found, **(origin or {})},
        **options,
    )


def export_policy(
    trained: Policy,
    folder: Path,
    *,
    below: Path | None = None,
    origin: Json | None = None,
    episodes: int = 100,
    seed: int | None = None,
    noise: bool = True,
    note: Callable[[str], None] = show,
) -> Path:
    """Write a policy into a folder, and return it; `origin` holds the run's path, commit and versions.

    `episodes` are recorded from `seed` for `sim2sim` to compare with, with or without `noise` of the sensors; 0 leaves
    them out. The files appear at the end, all or none; links are refused in their places, and in folders from `below`
    on, by default `folder`. Raises ValueError where the policy or an observation term cannot be written down, naming
    it and the way out, or the files differ from the policy.
    """
    if episodes < 0:
        raise ValueError(f"--episodes {episodes}: expected 0 or more")
    missing = [name for name in EXTRA if importlib.util.find_spec(name) is None]
    if missing:
        # Asked before the env is built: the packages of the extra are used last.
        raise ValueError(f"no package {missing[0]!r}: pip install 'ksim_rl[export]'")
    with whole_folder(folder, below=folder if below is None else below) as unfinished:
        _fill(
            trained,
            unfinished,
            origin={"run_path": "", "commit": None, "versions": {}, **(origin or {})},
            episodes=episodes,
            seed=seed,
            noise=noise,
            note=note,
        )
    return folder


def _fill(
    trained: Policy,
    folder: Path,
    *,
    origin: Json,
    episodes: int,
    seed: int | None,
    noise: bool,
    note: Callable[[str], None],
) -> None:
    """Write the files of an export into a folder that is empty."""
    # A curriculum would change weights and ranges while episodes are recorded.
    cfg = dataclasses.replace(
        trained.cfg, task=dataclasses.replace(trained.cfg.task, curriculum={})
    )
    if seed is None:
        seed = cfg.seed + EVALUATION_SEED_OFFSET
    sight = describe_sight(cfg.task, cfg.modules.observation_keys("actor"))
    seen = {picture.group for picture in sight.pictures}
    groups: list[Any] = [key for key in cfg.modules.observation_keys("actor") if key not in seen]
    transforms = sort_transforms(cfg.task, groups)
    # One of several groups may be in both.
    training_only = dict.fromkeys([*transforms.training_only, *sight.training_only])
    transforms = dataclasses.replace(transforms, training_only=list(training_only))
    for name in transforms.training_only:
        note(f"task.transforms.{name} acts in training only, and is left out")
    kept = {
        name: one for name, one in cfg.task.transforms.items() if name not in transforms.removed
    }
    whole = cfg
    cfg = dataclasses.replace(cfg, task=dataclasses.replace(cfg.task, transforms=kept))
    if transforms.in_policy:
        note(
            f"made a part of the policy: task.transforms.{', task.transforms.'.join(transforms.in_policy)}"
        )
        _check_transforms(whole, cfg, transforms, groups, seed)
    actor = with_transforms(trained.actor.cpu(), transforms)
    # At least as many envs as episodes are traced.
    env = build_env(cfg, num_envs=max(episodes, TRACED), seed=seed)
    ours = part(env, ManagerBasedRlEnv)
    assert ours is not None  # the env of a config is ours
    terms = {str(group): controls.observations(ours, [str(group)]) for group in groups}
    # Before files: a term that cannot be traced is refused before minutes of work.
    traced = _traced(cfg, [str(group) for group in groups], seed, note)
    observed = [term for of_group in terms.values() for term in of_group]
    # What a curriculum had changed by then has been seen, too.
    step_count = trained.iteration * cfg.data.rollout_length(cfg.num_envs)
    commands = described_commands(ours, trained.cfg.task.curriculum.values(), step_count)
    meta = metadata(ours, observed, transforms, traced, commands)
    meta["pictures"] = [picture.described() for picture in sight.pictures]
    if traced.obs:
        note("writing obs.onnx")
        traced.obs.write(folder / "obs.onnx")
        names = [term["name"] for term in observed]
        path = folder / "obs.onnx"
        meta["obs"]["difference"] = greatest_difference(traced.obs, ours, path, names)
    if traced.scores:
        traced.scores.write(folder / "scores.onnx")
    columns = {
        group: [
            policy.Column(
                name=term["name"],
                size=term["size"],
                length=term["history_length"],
                stride=term["history_stride"],
            )
            for term in terms[str(group)]
        ]
        for group in groups
    }
    # In evaluation mode normalizers stop learning; on the CPU as the files are for it.
    exported = policy.ExportedPolicy(actor.eval(), columns, sight.pictures)
    note("writing policy.onnx and policy.pt2")
    policy.write(exported, folder)
    difference = policy_check.greatest_difference(exported, folder / "policy.onnx")
    # Written so that NaN is refused, too.
    if not difference <= policy_check.TOLERANCE:
        raise ValueError(
            f"policy.onnx differs from the policy by {difference:.2g}: expected at most {policy_check.TOLERANCE:g}; "
            "weights or observations that large lose digits in float32"
        )
    # Actuators of the model in the order of the policy's actions; those that no action names follow.
    first = [name for law in meta["actuators"] for name in law["actuators"]]
    asked = [name for action in meta["actions"] for name in action["names"]]
    by_joint = dict(
        zip((j for law in meta["actuators"] for j in law["joints"]), first, strict=True)
    )
    # The scene's spec once more: the env's own was compiled, and XML is written of a spec.
    spec = scene_spec(cfg.task.scene, cfg.task.sim)
    prepare_spec(spec, [])
    if not len(spec.keys):
        # What the env starts from without a keyframe: servos that hold the model's own pose.
        add_joined(spec, "default", [default_data(ours.world.mj_model)])
    wanted = dict.fromkeys(by_joint.get(name, name) for name in asked)
    order = write_robot(spec, ours.world.mj_model, list(wanted), folder / "robot.xml")
    states = [dataclasses.asdict(state) for state in exported.states]
    own = {"inputs": exported.input_names, "outputs": exported.output_names, "states": states}
    own |= {
        "num_actions": ours.action_manager.size,
        "obs_dim": exported.obs_dim,
        "difference": difference,
    }
    meta |= {"policy": own, "task": cfg.task_name, "iteration": trained.iteration, **origin}
    meta |= {"seed": seed, "ours": None, "noisy": noise}
    # In training mode the sensors have noise, in evaluation mode they have none.
    env.train(noise)
    if episodes:
        note(f"recording {episodes} episodes for sim2sim")
        params = sorted({name for law in meta["actuators"] for name in law["numbers"]})
        kept = Kept(
            groups=groups,
            pictures=sight.pictures,
            joints=meta["joints"]["names"],
            params=params,
            order=order,
        )
        steps = ours.max_episode_length or UNLIMITED_EPISODE_STEPS
        recorded = Recording(env, ours, actor, kept, steps=steps, seed=seed)
        figures = recorded.figures[:episodes]
        # The runner's figures are compared with these, episode by episode.
        meta["ours"] = {}
        for name in figures[0]:
            meta["ours"][name] = [one[name] for one in figures]
        np.savez_compressed(folder / "episodes.npz", **recorded.arrays)  # pyright: ignore
        # Traces have no noise: single steps have to agree to the digit.
        env.eval()
        traced = Recording(
            env, ours, actor, kept, steps=min(steps, TRACED_STEPS), seed=seed, traces=TRACED
        )
        rates = {
            "trace/dt": np.array(ours.physics_dt),
            "trace/decimation": np.array(ours.cfg.decimation),
        }
        np.savez_compressed(folder / "trace.npz", **traced.arrays, **rates)  # pyright: ignore
    env.close(raise_if_closed=False)
    for path in sorted(folder.glob("*.onnx")):
        attach(path, {key: meta[key] for key in ATTACHED})
    # NaN is no JSON, and stands for a mistake of ours.
    (folder / "export.json").write_text(json.dumps(meta, indent=1, allow_nan=False) + "\n")
    (folder / "runner.py").write_text(runner_source())
    (folder / "loop.py").write_text(loop_source())
    (folder / "README.md").write_text(
        README.format(
            **{**meta, **own, "joints": ", ".join(meta["joint_names"])},
            read=_read_by(exported),
            observes="" if meta["obs"] is None else OBSERVES,
            equal=_equal(meta),
            state="; " + ", ".join(state.input for state in exported.states) + " carry its state"
            if states
            else "",
            checked=policy_check.num_checked(exported),
        )
    )


def _read_by(exported: policy.ExportedPolicy) -> str:
    """Return the observations of a policy, for a reader."""
    found = []
    if exported.obs_dim:
        found.append(f"`obs` [batch, {exported.obs_dim}]")
    for picture in exported.pictures:
        found.append(f"`{picture.name}` {['batch', *picture.shape]}".replace("'", ""))
    return " and ".join(found)


def _equal(meta: Json) -> str:
    if meta["obs"] is None:
        return ""
    difference = meta["obs"]["difference"]
    return f", and the observations\nequal the observations of training within {difference:.1e}"


def _traced(
    cfg: RunCfg, groups: Sequence[str], seed: int, note: Callable[[str], None]
) -> TracedTask:
    """Trace the terms of a task in an env of its own, of one row on the CPU, as the files are for one robot."""
    env = build_env(dataclasses.replace(cfg, device="cpu"), num_envs=1, seed=seed)
    ours = part(env, ManagerBasedRlEnv)
    assert ours is not None
    try:
        return trace_task(ours, groups, note)
    finally:
        env.close(raise_if_closed=False)


def _check_transforms(
    whole: RunCfg, reduced: RunCfg, transforms: TaskTransforms, groups: Sequence[Any], seed: int
) -> None:
    """Compare the env of a run with one whose transforms are parts of the policy."""
    one = build_env(whole, num_envs=TRACED, seed=seed)
    other = build_env(reduced, num_envs=TRACED, seed=seed)
    try:
        check_equal(one, other, transforms, groups)
    finally:
        one.close(raise_if_closed=False)
        other.close(raise_if_closed=False)


def runner_source() -> str:
    """Return the text of `runner.py`: modules of the folder `standalone` as one."""
    return _as_one_file(PARTS)


def loop_source() -> str:
    """Return the text of `loop.py`."""
    text = _as_one_file(LOOP_PARTS)
    # With MuJoCo it takes its robot from the file beside it.
    return text.replace(_SIMULATED, "from runner import SimulatedRobot\n")


def _as_one_file(names: Sequence[str]) -> str:
    *parts, command = ((STANDALONE / f"{name}.py").read_text() for name in names)
    # The docstring of the command becomes the file's; the other modules lose theirs.
    doc, body = re.split(r'(?<=\n""")\n', command, maxsplit=1)
    inner = [re.sub(r'\A""".*?"""\n', "", text, flags=re.DOTALL) for text in parts]
    text = "\n\n".join([*inner, body])
    # Imports of the package go, on one line or several: all names are in the one file then.
    return (
        doc + "\n" + re.sub(r"^from ksim_rl\S* import (\([^)]*\)|[^\n]*)\n", "", text, flags=re.M)
    )
