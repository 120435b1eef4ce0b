"""The commands that take no Hydra overrides: resume, eval, play, envs, robot."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import torch

from ksim_rl import conf, envs, ranks
from ksim_rl.checks import OneLineParser, check_count
from ksim_rl.cli.errors import say
from ksim_rl.cli.report import run_and_report, shown_working, verdict
from ksim_rl.cli.runs import print_table
from ksim_rl.device.state_tree import branch, number
from ksim_rl.envs.contract import part
from ksim_rl.files.writing import check_links, check_place
from ksim_rl.objectives import AMPCfg
from ksim_rl.scene.robots import analyse
from ksim_rl.scene.robots.analysis import TRIAL_S
from ksim_rl.terminal import show
from ksim_rl.tracking.trials import run_trials
from ksim_rl.trainers import RunCfg, checkpoint
from ksim_rl.trainers.build import build_evaluator, solved_at
from ksim_rl.trainers.kept_models import with_kept_models
from ksim_rl.trainers.metrics import losses_of
from ksim_rl.trainers.other_physics import ENGINE, check_physics_alone, judged_by, trained_with
from ksim_rl.trainers.run_cfg import check_run_tree
from ksim_rl.trainers.run_folder import FOLDERS, policy_of
from ksim_rl.trainers.sources import check_sources
from ksim_rl.zoo import locate

# Settings that belong to a checkpoint, and that a resumed run cannot change.
KEPT = ("task_name", "num_envs", "seed", "modules", "checkpoint")


def resume(arguments: list[str]) -> int:
    """Continue a run from its newest checkpoint."""
    parser = _parser("resume", "Continue a run from its newest checkpoint, in the same folder.")
    parser.add_argument(
        "overrides",
        nargs="*",
        metavar="field=value",
        help="what changes: objective.learning_rate=1e-4",
    )
    parser.add_argument(
        "--num-iterations", type=int, help="of the whole run; default: as it was configured"
    )
    parser.add_argument(
        "--trust",
        action="store_true",
        help="the folder is yours: it may hold links, and say where to write",
    )
    # Intermixed, since overrides may stand before and after flags.
    options = parser.parse_intermixed_args(arguments)
    saved = checkpoint.load_latest(options.run, note=say)
    overrides = list(options.overrides)
    if options.num_iterations is not None:
        overrides.append(f"trainer.num_iterations={options.num_iterations}")
    fields = conf.fields_of(overrides)
    for field in fields:
        # The first word of a field says which part of the config it changes.
        if field.partition(".")[0] in KEPT:
            raise ValueError(
                f"{field}: a resumed run keeps it: start a new run from these weights, "
                f"ksim-rl train --config-dir {options.run} checkpoint={options.run} {field}=..."
            )
    folder = saved.run_folder
    # A folder from another user may hold links that lead our writing elsewhere.
    if not options.trust:
        check_links(folder, below=FOLDERS)
        check_run_tree(saved.config, saved.path, given=fields)
    tree = {**saved.config, "device": options.device}
    if overrides:
        cfg = conf.changed(tree, saved.path, overrides, learns=True)
    else:
        cfg = RunCfg.from_tree(tree)
    # The device of this machine, not of the machine where the run began.
    cfg = dataclasses.replace(_on_these_ranks(cfg, saved), device=str(cfg.resolved_device()))
    if cfg.trainer.num_iterations < saved.iteration:
        raise ValueError(
            f"trainer.num_iterations={cfg.trainer.num_iterations}: expected at least {saved.iteration}, those that are "
            "done"
        )
    # Models of the run's own copies, so that a changed file of the user changes no run.
    cfg = with_kept_models(cfg, folder, note=say)
    check_sources(cfg, resumes=True)
    return run_and_report(cfg, folder.resolve(), resume_from=saved)


def _on_these_ranks(cfg: RunCfg, saved: checkpoint.Checkpoint) -> RunCfg:
    """Share the envs out again where a run goes on with another number of ranks: the whole dataset stays as large."""
    # Checkpoints of before there were ranks say nothing of them: they had one.
    before = 1
    if checkpoint.RANKS in saved.state:
        before = int(number(branch(saved.state, checkpoint.RANKS), "size"))
    now = ranks.size()
    if before == now:
        return cfg
    data = cfg.data
    objective = cfg.objective
    # Sizes in the config are for one rank: the share changes, the whole stays.
    size = ranks.share_of(data, "num_env_states_per_minibatch", before)
    # At least one shard, also where there are now more ranks than shards were.
    shards = data.shards * before // now
    data = dataclasses.replace(data, num_env_states_per_minibatch=size, shards=max(1, shards))
    if isinstance(objective, AMPCfg):
        size = ranks.share_of(objective, "num_transitions_per_step", before)
        objective = dataclasses.replace(objective, num_transitions_per_step=size)
    num_envs = ranks.share_of(cfg, "num_envs", before)
    return dataclasses.replace(cfg, num_envs=num_envs, data=data, objective=objective)


def evaluate(arguments: list[str]) -> int:
    """Evaluate a policy and print the verdict."""
    parser = _parser(
        "eval", "Evaluate a policy: deterministic actions, fresh envs, whole episodes."
    )
    number = parser.add_mutually_exclusive_group()
    # Episodes and trials are two kinds of evaluation: only one can be meant.
    number.add_argument("--episodes", type=int, help="default: as the run was configured")
    number.add_argument(
        "--trials", type=int, help="of a tracking run: how many follow the motion to its end"
    )
    parser.add_argument(
        "--pushes", action="store_true", help="of trials: push the robot as in training"
    )
    parser.add_argument(
        "--seed", type=int, help="of the initial states; default: the run's evaluation seed"
    )
    parser.add_argument(
        "overrides", nargs="*", metavar="field=value", help="of the physics: task.sim.engine=c"
    )
    options = parser.parse_intermixed_args(arguments)
    for name in ("episodes", "trials"):
        if getattr(options, name) is not None:
            check_count(f"--{name}", getattr(options, name))
    if options.pushes and options.trials is None:
        raise ValueError("--pushes: it is of trials: give their number, --trials 1024")
    # Everything that compiles or loads is inside, so that the wait is explained.
    with shown_working("evaluating"):
        run = locate(options.run, note=say)
        saved = checkpoint.load_latest(run, note=say)
        cfg, physics = _in_physics(saved, options.overrides, device=options.device)
        policy = policy_of(saved, device=options.device, cfg=cfg)
        judged = f"{policy.cfg.task_name}, iteration {policy.iteration}{physics}"
        if options.trials is not None:
            how = {
                "trials": options.trials,
                "seed": options.seed,
                "pushes": options.pushes,
                "note": say,
            }
            show(f"{judged}: {run_trials(policy.cfg, policy.actor, **how)}")
            return 0
        # From the command line, else as the run was configured; a run without evaluations gets 100.
        episodes = options.episodes or policy.cfg.trainer.eval_episodes or 100
        how = {"episodes": episodes, "seed": options.seed, "note": say}
        evaluate = build_evaluator(policy.cfg, policy.actor, **how)
        evaluation = evaluate()
        # Before the env goes out of scope: contacts that found no room spoil the result.
        losses = losses_of(evaluate.env).lines
    for text in losses:
        say(f"warning: {text}")
    assert evaluation is not None
    threshold = solved_at(policy.cfg)
    show(f"{judged}: {verdict(evaluation, threshold)}")
    # Code 1 is for a policy that misses the threshold, so that scripts can ask.
    if threshold is None or evaluation.return_mean >= threshold:
        return 0
    return 1


def _in_physics(
    saved: checkpoint.Checkpoint, overrides: Sequence[str], *, device: str
) -> tuple[RunCfg | None, str]:
    """Return a run's config with overrides of its physics, None without, and the verdict's words for them."""
    if not overrides:
        return None, ""
    fields = conf.fields_of(overrides)
    # An evaluation judges the policy as it was trained: only physics may differ.
    check_physics_alone(fields, "eval")
    check_run_tree(saved.config, saved.path, given=fields)
    cfg = conf.changed({**saved.config, "device": device}, saved.path, overrides)
    trained = trained_with(saved.config)
    # With a tolerance alone nothing more is asked for.
    if ENGINE not in fields:
        return cfg, f", with {' '.join(overrides)}"
    cfg, physics = judged_by(cfg, trained=trained, given=fields)
    return cfg, f", {physics}"


def list_envs(arguments: list[str]) -> int:
    """List the tasks, or print the managers of one."""
    parser = OneLineParser(
        prog="ksim-rl envs", description="List the tasks, or print what one of them is made of."
    )
    parser.add_argument("task", nargs="?", help="build this one and print its managers as tables")
    options = parser.parse_args(arguments)
    if options.task is not None:
        # Building compiles kernels, and one env is enough for its tables.
        with shown_working(f"building {options.task}"):
            if torch.cuda.is_available():
                device = "cuda"
            else:
                device = "cpu"
            env = envs.make(options.task, num_envs=1, device=device)
        ours = part(env, envs.ManagerBasedRlEnv)
        assert ours is not None
        show(ours.explain(), end="")
        return 0
    rows = []
    broken = []
    for name in envs.names():
        task = envs.task(name)
        # Configs are built for the list; a task that cannot be built must not hide the others.
        try:
            cfg = task.cfg()
        # Of a plug-in, or of its robot's file: the other tasks are listed.
        except Exception as error:
            broken.append(name)
            say(
                f"task {name!r} is left out of the list: {' '.join(str(error).split()) or type(error).__name__}"
            )
            continue
        rows.append(
            [
                name,
                ", ".join(cfg.scene.robots),
                f"{cfg.episode_length_s:g} s" if cfg.episode_length_s else "no limit",
                ", ".join(
                    f"{group} ({len(spec.terms)} terms)" for group, spec in cfg.observations.items()
                ),
                "-" if task.solved_at is None else f"return {task.solved_at:g}",
                task.description,
            ]
        )
    print_table(("task", "robot", "episode", "observations", "solved at", "description"), rows)
    return 1 if broken else 0


def robot(arguments: list[str]) -> int:
    """Analyse a robot; the code is 1 for one that does not stand."""
    parser = OneLineParser(
        prog="ksim-rl robot",
        description="Say what a legged robot's model holds, and propose all that walking needs.",
    )
    parser.add_argument(
        "model", metavar="PATH", help="an MJCF or URDF file, or a menagerie name: unitree_a1/a1"
    )
    parser.add_argument(
        "--pose",
        metavar="NAME",
        help='the keyframe to stand in, or "qpos0"; default: the first that stands',
    )
    parser.add_argument(
        "--drop",
        metavar="BODY",
        action="append",
        default=[],
        help="leave a body out, such as a prop; repeatable",
    )
    parser.add_argument(
        "--code", action="store_true", help="print Python to paste, in place of the table"
    )
    parser.add_argument(
        "--picture", type=Path, metavar="PNG", help="also draw the stance into this file"
    )
    options = parser.parse_args(arguments)
    check_place("--picture", options.picture, is_folder=False)
    if options.picture is not None and options.picture.suffix != ".png":
        raise ValueError(f"--picture {options.picture}: expected a file that ends in .png")
    # Trials of several poses take seconds.
    with shown_working(f"analysing {options.model}"):
        found = analyse(options.model, pose=options.pose, drop=options.drop)
    show(found.code() if options.code else found.table(), end="")
    if options.picture is not None:
        found.draw(options.picture)
    # Standing for the whole trial is the least that a task needs.
    return 0 if found.stands_s >= TRIAL_S else 1


def _parser(command: str, description: str) -> OneLineParser:
    parser = OneLineParser(prog=f"ksim-rl {command}", description=description)
    parser.add_argument(
        "run", type=Path, metavar="RUN", help="a run folder, or one of its checkpoints"
    )
    parser.add_argument("--device", default="auto", help="cpu, cuda, cuda:<index> or auto")
    return parser
