"""Records episodes of a training while it goes on: the `recorders` of a run's config."""

import hashlib
import warnings
from collections.abc import Iterator
from pathlib import Path

from tensordict import NestedKey, TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from ksim_rl.checks import check_known
from ksim_rl.data import EpisodeRecorder, EpisodeWriter, Origin, RecorderCfg, leaves_of
from ksim_rl.data.episode_recorder import DONE_KEY
from ksim_rl.envs.contract import EpisodeClock, SimulatedWorld, part
from ksim_rl.physics.model_checks import model_bytes
from ksim_rl.trainers.run_cfg import RunCfg
from ksim_rl.transforms import observation_columns
from ksim_rl.transforms.specs import spell

FOLDER = "episodes"


class TrainingRecorder:
    """Records the episodes of the first envs of a run, from an iteration on, until there are enough of them.

    It is a listener of the run's collector. A disk that is full costs the rest of the recording, and not the run.
    """

    def __init__(
        self,
        cfg: RecorderCfg,
        folder: Path,
        *,
        keys: list[NestedKey],
        origin: Origin,
        max_length: int,
        iteration: int,
    ) -> None:
        self._cfg = cfg
        self._folder = folder
        self._keys = keys
        self._origin = origin
        self._max_length = max_length
        # A recorder that starts late, or resumes with a run, starts in the middle of episodes.
        self._starts_within = iteration > 0
        self._iteration = iteration
        self._recorder: EpisodeRecorder | None = None
        self._is_over = False

    def record(self, rollout_ET: TensorDictBase, *, restarted: bool = False) -> None:
        """Take the rollout of the next iteration."""
        self._iteration += 1
        if self._is_over:
            return
        # A view: only these envs are copied.
        own_ET = rollout_ET.select(*self._keys)[: self._cfg.num_envs]
        try:
            # Memory and folder are taken at the first rollout, so that a lack of them is not found hours later.
            if self._recorder is None:
                self._recorder = self._begin(own_ET)
            if self._iteration < self._cfg.from_iteration:
                return
            self._recorder.record(own_ET, restarted=restarted)
        except OSError as error:
            self._give_up(error)
            return
        if self._recorder.is_done:
            self.close()

    def close(self) -> None:
        """Write all rollouts that were taken."""
        self._is_over = True
        recorder = self._recorder
        self._recorder = None
        if recorder is not None:
            try:
                recorder.close()
            except OSError as error:
                self._give_up(error)

    def _begin(self, own_ET: TensorDictBase) -> EpisodeRecorder:
        asked = self._cfg.num_episodes
        writer = EpisodeWriter(self._folder, leaves_of(own_ET), origin=self._origin, asked=asked)
        return EpisodeRecorder(
            writer,
            episodes_E=self._cfg.episodes_E,
            max_length=self._max_length,
            starts_within=self._starts_within or self._iteration < self._cfg.from_iteration,
        )

    def _give_up(self, error: OSError) -> None:
        self._is_over = True
        warnings.warn(
            f"{self._folder}: {error}: nothing more is recorded; the run goes on",
            RuntimeWarning,
            stacklevel=3,
        )


def make_recorders(
    cfg: RunCfg, env: EnvBase, run_folder: Path, *, iteration: int
) -> Iterator[TrainingRecorder]:
    """Yield the recorders of a run that has done so many iterations; each has a folder of its own."""
    for name, recorder in cfg.recorders.items():
        yield TrainingRecorder(
            recorder,
            _free_folder(run_folder / FOLDER / name, iteration),
            keys=keys_of(recorder, env),
            origin=origin_of(cfg, env, title=f"{cfg.task_name}, training"),
            max_length=max_length_of(env),
            iteration=iteration,
        )


def _free_folder(folder: Path, iteration: int) -> Path:
    """Return a folder that is not there yet: a run that goes on adds to no file of before."""
    own = folder / f"from_iteration_{iteration + 1:06d}"
    times = 1
    while own.exists():
        times += 1
        own = folder / f"from_iteration_{iteration + 1:06d}_{times}"
    return own


def recorded_keys(cfg: RunCfg, env: EnvBase) -> list[NestedKey]:
    """Return the leaves that recorders of a run read; a ValueError names a key that is wrong, and the near ones."""
    keys: list[NestedKey] = []
    for name, recorder in cfg.recorders.items():
        if recorder.num_envs > cfg.num_envs:
            raise ValueError(
                f"recorders.{name}.num_envs={recorder.num_envs}: expected at most num_envs={cfg.num_envs}"
            )
        keys += keys_of(recorder, env)
        max_length_of(env)
    return list(dict.fromkeys(keys))


def keys_of(cfg: RecorderCfg, env: EnvBase) -> list[NestedKey]:
    """Return the leaves that a recorder keeps."""
    known = {spell(key): key for key in env_state_keys(env)}
    if cfg.keys is None:
        return list(known.values())
    for text in cfg.keys:
        check_known("key of an env state", text, known)
    chosen = [known[text] for text in cfg.keys]
    return list(dict.fromkeys([*chosen, DONE_KEY]))


def env_state_keys(env: EnvBase) -> list[NestedKey]:
    """Return the keys of an EnvState: what the env observes, the action, and under "next" what follows it."""
    observed = list(env.observation_spec.keys(True, True))
    now = [*observed, *env.action_keys]
    following = [*observed, *env.reward_keys, *env.done_keys]
    return [*now, *(unravel_key(("next", key)) for key in following)]


def max_length_of(env: EnvBase) -> int:
    """Return the most env states of an episode; a ValueError where episodes have no end."""
    clock = part(env, EpisodeClock)
    longest = clock and clock.max_episode_length
    if not longest:
        raise ValueError(
            "task.episode_length_s=0: episodes without an end are never whole: give one, task.episode_length_s=20"
        )
    return longest


def origin_of(
    cfg: RunCfg, env: EnvBase, *, title: str, policy: TensorDictModuleBase | None = None
) -> Origin:
    """Return where the episodes of a run's env come from; a `policy` is one that stays as it is."""
    clock = part(env, EpisodeClock)
    assert clock is not None
    simulated = part(env, SimulatedWorld)
    assert simulated is not None  # the env of a config is ours
    columns = {
        group: {term: (start, stop) for term, (start, stop) in terms.items()}
        for group, terms in observation_columns(env).items()
    }
    return Origin(
        task=cfg.task_name,
        policy=title,
        step_dt=clock.step_dt,
        weights_sha256=_weights_sha256(policy),
        model_sha256=model_sha256(simulated),
        columns=columns,
    )


def model_sha256(simulated: SimulatedWorld) -> str:
    """Return the hash of the compiled MuJoCo model of an env's worlds."""
    return hashlib.sha256(model_bytes(simulated.world.mj_model).tobytes()).hexdigest()


def _weights_sha256(policy: TensorDictModuleBase | None) -> str:
    """Return the hash of a policy's weights by name, or nothing for an agent without weights."""
    weights = policy.state_dict() if policy is not None else {}
    if not weights:
        return ""
    found = hashlib.sha256()
    for name, value in weights.items():
        found.update(name.encode())
        found.update(value.detach().cpu().contiguous().flatten().numpy().tobytes())
    return found.hexdigest()
