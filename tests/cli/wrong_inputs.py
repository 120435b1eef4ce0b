"""Wrong inputs of users: words of the command line, terms, transforms and models, each in a process of its own.

`python -m tests.cli.wrong_inputs [PART ...]` prints what did not end in one clear line.
"""

import dataclasses
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

from benchmarks.faults import children
from ksim_rl import envs
from ksim_rl.cli.errors import report
from ksim_rl.cli.main import main
from tests.cli import wrong_models, wrong_terms

# Words of `ksim-rl train`, and what the line that refuses them names.
WORDS: Sequence[tuple[str, str]] = (
    ("num_envs=0", "num_envs"),
    ("num_envs=-1", "num_envs"),
    ("num_envs=1.5", "num_envs"),
    ("num_envs=many", "num_envs"),
    ("num_envs=null", "num_envs"),
    ("num_envs=[2]", "num_envs"),
    ("num_envs=99999999999999999999", "num_envs"),
    ("num_env=2", "num_env"),
    ("seed=-1", "seed"),
    ("seed=one", "seed"),
    ("seed=1e400", "seed"),
    ("device=tpu", "device"),
    ("device=cuda:x", "device"),
    ("device=", "device"),
    ("task=cartpole_balanc", "cartpole_balance"),
    ("task=", "task"),
    ("task=../x", "task"),
    ("objective=pppo", "objective"),
    ("objective.learning_rate=-1", "learning_rate"),
    ("objective.learning_rate=nan", "learning_rate"),
    ("objective.learning_rate=fast", "learning_rate"),
    ("objective.gamma=2", "gamma"),
    ("objective.clip_epsilon=-0.1", "clip_epsilon"),
    ("objective.num_epochs=0", "num_epochs"),
    ("objective.betas=[0.9]", "betas"),
    ("objective.betas=[0.9,1.5]", "betas"),
    ("objective.advantage=gaee", "advantage"),
    ("objective.precision=float8", "precision"),
    ("objective._target_=os.system", "os.system"),
    ("objective._target_=", "_target_"),
    ("data.num_minibatches=0", "num_minibatches"),
    ("data.num_env_states_per_minibatch=3", "num_env_states_per_minibatch"),
    ("data.shards=7", "shards"),
    ("data.sequence_length=0", "sequence_length"),
    ("collector.rollout_length=0", "rollout_length"),
    ("collector.warmup=-1", "warmup"),
    ("modules.actor.hidden_dims=[0]", "hidden_dims"),
    ("modules.actor.hidden_dims=4", "hidden_dims"),
    ("modules.actor.hidden_dims=[four]", "hidden_dims"),
    ("modules.actor.activation=eluu", "activation"),
    ("modules.actor.init_std=-1", "init_std"),
    ("modules.actor.in_keys=[]", "in_keys"),
    ("modules.actor.in_keys=[actr]", "actr"),
    ("modules.critic=null", "critic"),
    ("~modules", "modules"),
    ("~task.observations.actor", "actor"),
    ("~task.events.reset", ""),
    ("trainer.num_iterations=-1", "num_iterations"),
    ("trainer.eval_interval=-1", "eval_interval"),
    ("trainer.eval_episodes=-1", "eval_episodes"),
    ("trainer.num_threads=0", "num_threads"),
    ("trainer.keep_checkpoints=0", "keep_checkpoints"),
    ("trainer.stop_when_solved=perhaps", "stop_when_solved"),
    ("trainer.matmul_precision=highs", "matmul_precision"),
    ("task.decimation=0", "decimation"),
    ("task.episode_length_s=-1", "episode_length_s"),
    ("task.episode_length_s=1e30", "episode_length_s"),
    ("task.sim.timestep=0", "timestep"),
    ("task.sim.timestep=1e-30", "episode_length_s"),
    ("task.sim.timestep=nan", "timestep"),
    ("task.sim.solver=simplex", "solver"),
    ("task.sim.engine=d", "engine"),
    ("task.sim.iterations=-1", "iterations"),
    ("task.sim.nconmax=-1", "nconmax"),
    ("task.sim.nconmax=2000000000", "sim.nconmax"),
    ("task.sim.njmax=2147483648", "sim.njmax"),
    ("trainer.checkpoint_interval=-1", "checkpoint_interval"),
    ("trainer.num_threads=100000", "num_threads"),
    ("num_envs=\uff12", "num_envs"),
    ("seed=true", "seed"),
    ("objective.num_epochs=1e18", "num_epochs"),
    ("task.rewards.balance._target_=torch.load", "torch.load"),
    ("task.rewards.balance._target_=ksim_rl.cli.main.main", "ksim_rl.cli.main"),
    ("task.rewards.balance.weight=heavy", "weight"),
    ("task.rewards.balance.weight=inf", "weight"),
    ("task.rewards.balance=null", "balance"),
    ("task.rewards.balanc.weight=1", "balance"),
    ("task.actions.force.joints=slide", "slide"),
    ("task.actions.force.joints=[]", "actions.force"),
    ("task.actions.force.joints='('", "joint pattern"),
    ("task.actions.force.clip=[1,-1]", "clip"),
    ("task.actions.force.cutoff_hz=-1", "cutoff_hz"),
    ("task.terminations.fallen.limit=x", "limit"),
    ("task.scene.robots.cartpole=null", "cartpole"),
    ("~task.scene.robots.cartpole", "robots"),
    ("task.scene.spacing=-1", "spacing"),
    ("task.events.reset.mode=never", "mode"),
    ("task.viewer.env_index=7", "env_index"),
    ("viewer.port=70000", "port"),
    ("logger=telegraph", "logger"),
    ("checkpoint=/no/such/run", "/no/such/run"),
    ("hydra.run.dir=/dev/null/run", "/dev/null"),
    ("no.such.field=1", "no"),
    ("+no_such=1", "no_such"),
    ("seed", "seed"),
    ("=1", "unknown field"),
    ("seed='1", "seed"),
    ("seed={", "seed"),
    ("seed=${oc.env:HOME}", "seed"),
    ("seed=${seed}", "seed"),
    ("--no-such-flag", "--no-such-flag"),
)
# Changes of the task's transforms, likewise.
TRANSFORMS: Sequence[tuple[str, str]] = (
    ("+task.transforms.lag={_target_: ksim_rl.envs.transforms.ActionDelay}", "delay"),
    ("+task.transforms.lag={_target_: ksim_rl.envs.transforms.ActionDelays}", "ActionDelay"),
    ("+task.transforms.lag={_target_: ksim_rl.envs.transforms.ActionDelay, delay: 2}", "delay"),
    (
        "+task.transforms.lag={_target_: ksim_rl.envs.transforms.ActionDelay, delay: {max_lag: -1}}",
        "max_lag",
    ),
    (
        "+task.transforms.lag={_target_: ksim_rl.envs.transforms.ActionDelay, delay: {max_lag: 100}}",
        "max_lag",
    ),
    ("+task.transforms.lag={delay: 2}", "_target_"),
    ("+task.transforms.lag=3", "lag"),
    ("+task.transforms.lag=null", "lag"),
    (
        "+task.transforms.cut={_target_: ksim_rl.envs.transforms.ObservationClip, in_keys: [actor], clip: [1, -1]}",
        "clip",
    ),
    (
        "+task.transforms.cut={_target_: ksim_rl.envs.transforms.ObservationClip, in_keys: [aktor], clip: [-1, 1]}",
        "actor",
    ),
    (
        "+task.transforms.size={_target_: ksim_rl.envs.transforms.ObservationScale, in_keys: [actor], scale: nan}",
        "scale",
    ),
    ("+task.transforms.part={_target_: torchrl.envs.transforms.Compose}", "Compose"),
    ("+task.transforms.image={_target_: torchrl.envs.transforms.ToTensorImage}", "image"),
    ("+task.transforms.net={_target_: torchrl.envs.transforms.VIPTransform}", "VIPTransform"),
    ("+task.transforms.out={_target_: shutil.rmtree, path: /no/such}", "shutil"),
    ("task.observations.actor.delay={max_lag: 10}", "max_lag"),
    ("task.observations.actor.history={length: 0}", "length"),
    ("task.observations.actor.history={length: 3, stride: 0}", "stride"),
    ("task.observations.actor.terms.position.scale=[1,2,3,4,5]", "scale"),
    ("task.observations.actor.terms.position.clip=[2,1]", "clip"),
    (
        "task.observations.actor.terms.position.noise={_target_: ksim_rl.envs.transforms.GaussianNoise, std: -1}",
        "std",
    ),
    (
        "task.observations.actor.terms.position.noise={_target_: ksim_rl.envs.transforms.UniformNoise, low: 1}",
        "high",
    ),
    ("task.observations.actor.terms.velocity.term.joints=[elbow]", "velocity"),
)


def train(words: Sequence[str], folder: Path) -> int:
    """Train for an iteration as the command does; `words` replace the overrides of the smallest task."""
    given = [word.partition("=")[0] for word in words]
    few = ["trainer.num_iterations=1", "trainer.eval_episodes=0", f"hydra.run.dir={folder / 'run'}"]
    own = [word for word in children.SMALLEST if word.partition("=")[0] not in given]
    own = [
        word for word in own if word.partition("=")[0] not in [one.partition("=")[0] for one in few]
    ]
    few = [word for word in few if word.partition("=")[0] not in given]
    return _exit_code(["train", *own, *few, *words])


def _exit_code(words: Sequence[str]) -> int:
    try:
        main(words)
    except SystemExit as ended:
        return int(ended.code or 0)
    raise AssertionError("a command always exits")


def _build(change: Callable[[envs.ManagerBasedRlEnvCfg], envs.ManagerBasedRlEnvCfg]) -> int:
    """Build a task with a user's term in it, act, and tell an error as the command does."""
    try:
        cfg = change(envs.make_cfg("cartpole_balance", ["task.scene.num_envs=2"]))
        env = envs.build(dataclasses.replace(cfg, seed=1))
        env.rollout(3)
    except Exception as error:
        return report(error)
    return 0


def cases(folder: Path) -> dict[str, list[tuple[str, str, Callable[[], int]]]]:
    """Return for each part its inputs: a name, what the line names, and what runs it."""
    found: dict[str, list[tuple[str, str, Callable[[], int]]]] = {"words": [], "transforms": []}
    for part, inputs in (("words", WORDS), ("transforms", TRANSFORMS)):
        for word, named in inputs:
            found[part].append((word, named, lambda word=word: train([word], folder)))
    found["terms"] = []
    for name, named, change in wrong_terms.changes():
        found["terms"].append((name, named, lambda change=change: _build(change)))
    found["models"] = []
    for name, named, path in wrong_models.write(folder / "models"):
        words = ["robot", str(path)]
        found["models"].append((name, named, lambda words=words: _exit_code(words)))
    return found


def verdict(ended: children.Ended, named: str, *, own_error: bool = False) -> str:
    """Return what is wrong with how an input ended, or nothing: it works, or one line names what is wrong."""
    if ended.code in (0, 1):
        return ""
    if ended.code not in (2, 3):
        return f"exit code {ended.code}"
    lines = [line for line in ended.text.splitlines() if line.startswith("ksim-rl: error:")]
    if len(lines) != 1:
        return f"{len(lines)} lines of errors"
    if named not in lines[0]:
        return f"the line does not name {named!r}"
    # What a user's own code raises is shown with its traceback, in which the user looks for the place.
    if "Traceback" in ended.text and not own_error:
        return "a traceback"
    return ""


def figures(
    folder: Path,
    *,
    parts: Sequence[str] = (),
    inputs: int = 10**6,
    note: Callable[[str], None] = print,
):
    """Try inputs, each in a process of its own; count those that work, are refused in one clear line, or neither."""
    found = {"inputs": 0, "work": 0, "one_clear_line": 0, "neither": 0}
    every = cases(folder)
    chosen = [(part, *case) for part in every if not parts or part in parts for case in every[part]]
    for part, name, named, run in chosen[:: max(1, len(chosen) // inputs)]:
        ended = children.start(run, hangs_s=60).wait()
        wrong = verdict(ended, named, own_error=part == "terms" and "raises" in name)
        found["inputs"] += 1
        found["work"] += not wrong and ended.code in (0, 1)
        found["one_clear_line"] += not wrong and ended.code not in (0, 1)
        found["neither"] += bool(wrong)
        if wrong:
            note(f"{part}: {name}: {wrong}: {ended.text[-500:]}")
    return found


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as temporary:
        print(figures(Path(temporary), parts=sys.argv[1:]))
