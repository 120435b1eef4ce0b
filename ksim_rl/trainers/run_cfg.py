"""A training run is configured by one dataclass tree whose groups mirror the rooms."""

import os
import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, Literal

import torch

from ksim_rl import ranks
from ksim_rl.checked import Checked, Count, Seed, WholeNumber, Within
from ksim_rl.checks import near
from ksim_rl.collectors import CollectorCfg
from ksim_rl.config import class_paths, plugins
from ksim_rl.config.config_tree import from_tree, to_tree
from ksim_rl.config.plain_data import check_plain
from ksim_rl.config.trees import Plain, Tree
from ksim_rl.data import DatasetCfg, RecorderCfg, ReplayCfg, sequence_length
from ksim_rl.envs import ManagerBasedRlEnvCfg
from ksim_rl.modules import (
    FEATURES,
    ActorCfg,
    CriticCfg,
    DeterministicActorCfg,
    ObservationKey,
    QNetworkCfg,
    RecurrentCfg,
    SharedTrunkCfg,
    SquashedActorCfg,
)
from ksim_rl.objectives import AlgorithmCfg
from ksim_rl.scene.scene import NUMBERS_PER_WORLD
from ksim_rl.trainers.loggers import LoggerCfg

PLUGINS = "plugins"
# It becomes part of the path of the run folder.
TASK_NAME = re.compile(r"\w[\w.+-]*")
# Fields that reach beyond the run folder, to write or to listen, and the variables of those that have one.
WRITTEN = (
    "logger.mlflow.tracking_uri",
    "task.sim.nan_guard.folder",
    "viewer.browser",
    "viewer.host",
)
VOUCHED_BY = {"logger.mlflow.tracking_uri": "MLFLOW_TRACKING_URI"}


@dataclass(frozen=True, kw_only=True)
class TrainerCfg(Checked):
    """Options of `Trainer`. Intervals are in iterations, of one rollout and one update each; 0 means never.

    Attributes:
        stop_at: with values by metric, such as `{"reward/track_linear_velocity": 1.39}`, the run ends as soon as each
            reaches its value in one and the same iteration; figures of evaluations count as well.
        overlap: read the metrics of an iteration while the next one runs; None does so on CUDA. Where nothing else
            asks for them earlier, `stop_at` and the guards then act one iteration later; nothing else changes.
        num_threads: torch's threads on the CPU. None takes one for a run on the CPU, so that the same seed gives the
            same bits on every machine: torch's sums depend on how many threads share them, so another number stands for
            other bits, as another seed does. For a run on CUDA None leaves one core free, and takes eight at most. A
            thread that has to wait for a core that is busy elsewhere stalls all others.
    """

    num_iterations: Count = 100  # of one rollout and one update each
    eval_interval: WholeNumber = 20  # between evaluations in fresh envs
    eval_episodes: WholeNumber = 100  # one env each; 0 means no evaluation at all
    stop_when_solved: bool = True  # as soon as an evaluation reaches the task's threshold
    stop_at: Mapping[str, float] | None = None
    checkpoint_interval: WholeNumber = 20  # the last iteration is always saved
    keep_checkpoints: Count = 3  # how many of the newest stay
    log_interval: Count = 1  # between rows of the logs and lines of progress
    overlap: bool | None = None
    warm_up: bool = False  # compile and capture updates before the first env step and its seconds
    # Where threads cannot be made, torch ends the process instead of raising.
    num_threads: Annotated[int, Within(low=1, high=1024)] | None = None
    matmul_precision: Literal["highest", "high", "medium"] = "high"  # on CUDA; "high" is TF32
    video: bool = True  # of the final policy
    video_s: Annotated[float, Within(low=0.0, high=3600.0, low_open=True)] = 10.0  # its length, s

    def least_numbers(self, num_envs: int) -> Mapping[tuple[str, ...], float]:
        """Return the numbers of the smallest worlds of an evaluation."""
        return {("eval_episodes",): NUMBERS_PER_WORLD * self.eval_episodes}


@dataclass(frozen=True, kw_only=True)
class ModulesCfg(Checked):
    """Settings of the networks.

    Attributes:
        trunk: layers that actor and critic share, whose "features" both read then; their other inputs are separate.
        recurrent_actor: a recurrent layer in front of the actor.
        recurrent_critic: a recurrent layer in front of the critic, with a state of its own.
    """

    actor: ActorCfg | DeterministicActorCfg | SquashedActorCfg = field(default_factory=ActorCfg)
    critic: CriticCfg | QNetworkCfg = field(default_factory=CriticCfg)
    trunk: SharedTrunkCfg | None = None
    recurrent_actor: RecurrentCfg | None = None
    recurrent_critic: RecurrentCfg | None = None

    def _check_fields(self) -> None:
        """Refuse a trunk that a network does not read, and features that nothing writes."""
        super()._check_fields()
        for name, cfg in (("actor", self.actor), ("critic", self.critic)):
            # Either both or neither: a network without features would leave the trunk untrained.
            if (FEATURES in self._read_by(name)) != (self.trunk is not None):
                raise ValueError(
                    f"{name}.in_keys={self._read_by(name)!r}: {FEATURES!r} is what a trunk writes; name it with a "
                    "trunk, which modules=shared_trunk has, and only with one"
                )
            if self.trunk is not None and cfg.obs_normalization:
                raise ValueError(
                    f"{name}.obs_normalization=True: with a trunk, the trunk normalizes observations"
                )

    @property
    def recurrent(self) -> bool:
        """Whether a network is recurrent."""
        return self.recurrent_actor is not None or self.recurrent_critic is not None

    @property
    def kinds(self) -> tuple[type, type]:
        """The classes of the settings of actor and critic."""
        return type(self.actor), type(self.critic)

    def observation_keys(self, *names: str) -> list[ObservationKey]:
        """Return the keys of an EnvState that the networks read, or that the one named "actor" or "critic" reads."""
        if self.trunk is None:
            shared = ()
        else:
            shared = self.trunk.in_keys
        own = [key for name in names or ("actor", "critic") for key in self._read_by(name)]
        # Each key once, in a fixed order, without features, which are no leaf of an EnvState.
        return [key for key in dict.fromkeys((*shared, *own)) if key != FEATURES]

    def _read_by(self, name: str) -> tuple[ObservationKey, ...]:
        return getattr(self, name).in_keys


@dataclass(frozen=True, kw_only=True)
class BrowserCfg(Checked):
    """The viewer that `ksim-rl train` opens on a running training.

    Attributes:
        browser: open it.
        host: the address that it listens on; None is this machine only.
        port: the port that it listens on.
    """

    browser: bool = False
    host: str | None = None
    port: Annotated[int, Within(low=1, high=65000)] = 8080

    @property
    def address(self) -> str:
        """Where it listens."""
        return self.host or "127.0.0.1"


@dataclass(frozen=True, kw_only=True)
class TrainingCfg(Checked):
    """Settings of training without the env: recommended by a task, and the larger part of a run's config."""

    num_envs: Count  # parallel envs
    seed: Seed = 1  # of all draws
    objective: AlgorithmCfg  # its class says which algorithm learns
    data: DatasetCfg | ReplayCfg
    modules: ModulesCfg = field(default_factory=ModulesCfg)
    collector: CollectorCfg = field(default_factory=lambda: CollectorCfg(stagger_episodes=True))
    trainer: TrainerCfg = field(default_factory=TrainerCfg)

    def _check_fields(self) -> None:
        """Let the size of the data follow from `collector.rollout_length`, where that is given."""
        super()._check_fields()
        if self.collector.rollout_length is not None:
            # The config is frozen, so the field is set past its own check of assignments.
            data = self.data.with_rollout_length(self.collector.rollout_length, self.num_envs)
            object.__setattr__(self, "data", data)


@dataclass(frozen=True, kw_only=True)
class RunCfg(TrainingCfg):
    """A training run: the settings of `TrainingCfg`, with its task, device, loggers and viewer."""

    task_name: str  # the registered task that `task` began as; names the run and its threshold
    task: ManagerBasedRlEnvCfg  # the env; its number of envs and its seed are set to the run's
    device: str = "auto"  # "cpu", "cuda", "cuda:<index>", or "auto" for CUDA where there is a GPU
    checkpoint: str | None = None  # a run or checkpoint whose networks are the start
    logger: LoggerCfg = field(default_factory=LoggerCfg)
    viewer: BrowserCfg = field(default_factory=BrowserCfg)
    recorders: Mapping[str, RecorderCfg] = field(default_factory=dict)  # episodes to keep, by name

    def _check_fields(self) -> None:
        """Refuse values that no run can have, before any model is compiled."""
        super()._check_fields()
        if not TASK_NAME.fullmatch(self.task_name):
            raise ValueError(
                f"task_name={self.task_name!r}: expected letters, digits and _.+-, as it names a folder"
            )
        for name in self.recorders:
            if not TASK_NAME.fullmatch(name):
                raise ValueError(
                    f"recorders.{name}: expected letters, digits and _.+-, as it names a folder"
                )
        if not re.fullmatch(r"auto|cpu|cuda(:\d+)?", self.device):
            raise ValueError(
                f"device={self.device!r}: expected 'auto', 'cpu', 'cuda' or 'cuda:<index>'"
            )
        # "auto" passes, as it falls back to the CPU.
        if self.device.startswith("cuda") and not torch.cuda.is_available():
            raise ValueError(
                f"device={self.device!r}: torch finds no CUDA device here; use device=cpu"
            )
        if not self.task.actions:
            raise ValueError(
                "task.actions is empty: a policy needs one at least, which says what it controls"
            )
        # One source for the number of envs and the seed: the run's own.
        scene = replace(self.task.scene, num_envs=self.num_envs)
        object.__setattr__(self, "task", replace(self.task, scene=scene, seed=self.seed))
        # Nested keys are no groups, but leaves such as commands.
        groups = {key for key in self.modules.observation_keys() if isinstance(key, str)}
        groups |= set(self.objective.observation_groups)
        missing = sorted(groups - set(self.task.observations))
        if missing:
            raise ValueError(
                f"task.observations has no group {missing[0]!r}, which modules.*.in_keys or objective.style_group "
                f"name: {near(missing[0], self.task.observations)}"
            )
        # Raises if the number of envs does not divide the size of the data.
        self.data.rollout_length(self.num_envs)
        self._check_sequences()

    def _check_sequences(self) -> None:
        """Refuse sequences for networks that are not recurrent, recurrent ones without, and sizes that do not fit."""
        if not self.modules.recurrent:
            if isinstance(self.data, DatasetCfg) and (
                self.data.sequence_length or self.data.burn_in
            ):
                raise ValueError(
                    f"data.sequence_length={self.data.sequence_length}, data.burn_in={self.data.burn_in}: only "
                    "recurrent networks learn on sequences; use modules=lstm or modules=gru, or null and 0"
                )
            return
        if not self.objective.learns_on_sequences or not isinstance(self.data, DatasetCfg):
            raise ValueError(
                f"modules.recurrent_actor or recurrent_critic is set, and {type(self.objective).__name__} learns on "
                "single env states: set both to null, or choose an objective that learns on sequences"
            )
        self.objective.check_recurrent()
        sequence_length(
            self.data.rollout_length(self.num_envs),
            self.data.sequence_length,
            batch_size=self.data.num_env_states_per_minibatch,
            burn_in=self.data.burn_in,
        )

    @classmethod
    def from_tree(cls, tree: Tree) -> "RunCfg":
        """Build the config from plain data, also of an earlier version; a ValueError has the full path of a fault."""
        # Plain data and known packages first: the tree may come from another user's run.
        check_plain(tree, "config")
        plugins.check_remembered(tree.get(PLUGINS) or ())
        tree = up_to_date({key: value for key, value in tree.items() if key != PLUGINS})
        return from_tree(cls, without_env_size(tree))

    def to_tree(self) -> Tree:
        """Return the config as plain data, from which `from_tree` builds an equal one.

        Beside the fields it names the plug-ins of this process and of the classes in the config.
        """
        tree = without_env_size(to_tree(self, type(self)))
        needed = list(plugins.named())
        for target in class_paths.foreign(tree):
            needed.append(target.split(".")[0])
        if needed:
            return {**tree, PLUGINS: list(dict.fromkeys(needed))}
        return tree

    def resolved_device(self) -> torch.device:
        """Return the device that "auto" stands for here, with several ranks the own GPU of this one."""
        if torch.cuda.is_available():
            auto = "cuda"
        else:
            auto = "cpu"
        return torch.device(ranks.device(auto if self.device == "auto" else self.device))


def with_engine(cfg: RunCfg, engine: Literal["auto", "warp", "c"]) -> RunCfg:
    """Return the config of a run with another engine."""
    sim = replace(cfg.task.sim, engine=engine)
    return replace(cfg, task=replace(cfg.task, sim=sim))


def check_run_tree(tree: Tree, where: Path, *, given: Collection[str] = ()) -> None:
    """Refuse the config of a run folder if it holds more than a run's fields, or says what to write elsewhere.

    `given` are the fields, by dotted path, that the user sets himself.
    """
    # A run folder may come from another user, so unknown fields are refused.
    known = {*(entry.name for entry in fields(RunCfg)), PLUGINS}
    for name in tree:
        if name not in known:
            raise ValueError(
                f"{where}: {name!r} is no field of a run's config, and it may hold nothing else"
            )
    check_plain(tree, str(where))
    for path, value in reaching_outside(tree, given=given):
        raise ValueError(
            f"{where}: {path}={value!r} reaches outside of the run folder: if that is yours, set "
            f"{path} on the command line, or resume with --trust"
        )


def reaching_outside(tree: Tree, *, given: Collection[str] = ()) -> Iterator[tuple[str, Plain]]:
    """Yield the fields of a run's tree, by dotted path, that make a run write or listen elsewhere.

    Those that are `given` are left out, with all that is below them.
    """
    for path in WRITTEN:
        value: Plain = tree
        for name in path.split("."):
            if isinstance(value, Mapping):
                value = value.get(name)
            else:
                value = None
        # With dots at the ends, so that "viewer" covers "viewer.host" and not "viewers".
        own = any(f"{path}.".startswith(f"{field}.") for field in given)
        # Unset fields and switches that are off reach nothing.
        reaches = value is not None and value is not False
        if reaches and not own and value != os.environ.get(VOUCHED_BY.get(path, "")):
            yield path, value


def without_env_size(tree: Tree) -> Tree:
    """Return a run's tree without the env's own number of envs and seed, which must be the run's if given."""
    task = tree.get("task")
    if not isinstance(task, Mapping) or not isinstance(task.get("scene"), Mapping):
        return dict(tree)
    scene = dict(task["scene"])
    task = {**task, "scene": scene}
    for where, name, below in (
        ("task.scene.num_envs", "num_envs", scene),
        ("task.seed", "seed", task),
    ):
        # Older trees repeat the run's numbers here; other numbers are a mistake.
        value = below.pop(name, None)
        if value is not None and value != tree.get(name):
            raise ValueError(
                f"{where}={value!r} differs from {name}={tree.get(name)!r}: set {name}, which is the env's as well"
            )
    return {**tree, "task": task}


def up_to_date(tree: Tree) -> Tree:
    """Return the config tree of a run as this version writes it."""
    tree = dict(tree)
    objective = tree.get("objective")
    # Up to 0.1 an objective without a class was PPO's.
    if isinstance(objective, Mapping) and "_target_" not in objective:
        tree["objective"] = {"_target_": "ksim_rl.objectives.PPOCfg", **objective}
    task = tree.get("task")
    # Before there were two engines, all was made by Warp.
    if isinstance(task, Mapping) and isinstance(task.get("sim"), Mapping):
        tree["task"] = {**task, "sim": {"engine": "warp", **task["sim"]}}
    return tree
