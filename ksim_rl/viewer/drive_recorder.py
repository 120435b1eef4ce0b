"""Records what a person drives in a viewer as whole episodes, in the layout of `ksim-rl collect`."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from omegaconf import OmegaConf
from tensordict import TensorDictBase

from ksim_rl.data import EpisodeRecorder, EpisodeWriter, leaves_of
from ksim_rl.files.writing import check_place, write_whole
from ksim_rl.runs.listing import CONFIG
from ksim_rl.runs.record import recorded
from ksim_rl.trainers.recorders import env_state_keys, max_length_of, origin_of
from ksim_rl.viewer.played import Played
from ksim_rl.viewer.session import Session

# A person drives until the viewer is closed.
MOST_EPISODES = 2**31


def check_new(folder: Path) -> None:
    """Refuse a folder that holds something, or is none, by a ValueError."""
    check_place("--record", folder, is_folder=True)
    if folder.exists() and any(folder.iterdir()):
        raise ValueError(f"--record {folder}: it holds something: name a new folder")


@contextmanager
def recording(
    session: Session, played: Played, folder: Path, *, note: Callable[[str], None]
) -> Iterator[None]:
    """Write the whole episodes of a session of one env to a new folder until the block ends.

    Episodes that are reset, or whose env is built again under other conditions, have no end and are left out. A
    ValueError refuses a folder that holds something, several envs, and envs whose episodes have no end.
    """
    check_new(folder)
    env = session.env
    if session.ours.num_envs != 1:
        raise ValueError(
            f"--record with --num-envs {session.ours.num_envs}: one env is driven: use --num-envs 1"
        )
    max_length = max_length_of(env)
    keys = env_state_keys(env)
    origin = origin_of(
        played.cfg, env, title=f"{session.title}, driven in a viewer", policy=played.actor
    )
    shown_E = session.root_E.clone()
    # A step that leaves no trace would have moved the world: specs say what its leaves are.
    shown_E.update(env.full_action_spec.zero())
    following_E = shown_E.select(*env.observation_spec.keys(True, True), strict=False)
    for spec in (env.full_reward_spec, env.full_done_spec):
        following_E.update(spec.zero())
    shown_E.set("next", following_E)
    folder.mkdir(parents=True, exist_ok=True)
    tree = OmegaConf.create(played.cfg.to_tree())
    write_whole(folder / CONFIG, OmegaConf.to_yaml(tree))
    with recorded(folder, note=note) as ended:
        writer = EpisodeWriter(folder, leaves_of(shown_E.select(*keys)), origin=origin)
        with EpisodeRecorder(writer, episodes_E=[MOST_EPISODES], max_length=max_length) as recorder:

            def record(stepped_E: TensorDictBase, restarted: bool) -> None:
                rollout_ET = stepped_E.select(*keys).unsqueeze(1)
                recorder.record(rollout_ET, restarted=restarted)

            session.listener = record
            try:
                yield
            finally:
                session.listener = None
                ended("done", "")
    note(f"{writer.contents.num_episodes} whole episodes are in {folder}")
