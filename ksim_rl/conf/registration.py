"""Registers the parts of configs with Hydra, and the config of a run that is made once more."""

import os
import re
from collections.abc import Collection, Sequence
from functools import cache, partial
from pathlib import Path

import yaml
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.config_store import ConfigStore
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.plugins import Plugins
from hydra.plugins.search_path_plugin import SearchPathPlugin
from omegaconf import OmegaConf

from ksim_rl import algorithms, envs
from ksim_rl.checks import naming
from ksim_rl.conf import choices
from ksim_rl.config import plain_data, plugins, upstream
from ksim_rl.config.trees import Tree
from ksim_rl.files.reading import read_bytes
from ksim_rl.runs.listing import CONFIG
from ksim_rl.trainers.run_cfg import check_run_tree, up_to_date, without_env_size

MODULE = "ksim_rl.conf"
NAME = "train"
RUN_AGAIN = "run_again"
RUN_CONFIG = CONFIG
CHOSEN_BY_TASK = TRAINING, OBJECTIVE_TRAINING = "task/training", "task/objective_training"
WRITTEN_BY_LOGGERS = ("wandb", "mlflow")

# Names of folders stay below the limit of file systems, with room for the number.
MOST_LETTERS = 120
# Hydra reads a group in Python, a letter in some 50 us.
MOST_GROUP_BYTES = 2**16
# Thirty references, each to two before it, are a text of gigabytes.
MOST_REFERENCES = 16


def job_folder(number: int, task: str, overrides: str) -> str:
    """Return the name of the folder of a multirun's job: its number, and the overrides that differ."""
    # Signs of Hydra's grammar, such as brackets and quotes, have no place in a folder's name.
    name = re.sub(r"[^\w.+=,-]", "-", overrides or task)
    return f"{number}_{name[:MOST_LETTERS]}"


# Where this room is imported, so that it is known too in the processes that a launcher starts.
OmegaConf.register_new_resolver("job_folder", job_folder, replace=True)


def register() -> None:
    """Let Hydra find other packages' configs, and store the groups' choices, the tasks and their training defaults.

    The last go to the groups `task`, `task/training` (settings for any objective) and `task/objective_training`.
    """
    _register(plugins.named())


@cache
def _register(_named: tuple[str, ...]) -> None:
    # Once: the same plug-ins register the same configs.
    Plugins.instance().register(DeclaredConfigs)
    envs.register_configs()
    store = partial(upstream.store_config, package="_global_")
    choices.store_choices()
    for name in envs.names():
        store(TRAINING, name, partial(choices.training_defaults, name))
        for objective in algorithms.names():
            make = partial(choices.objective_defaults, name, objective)
            store(OBJECTIVE_TRAINING, f"{name}_{objective}", make)
    # After all is stored: lists of groups are then quick.
    upstream.quicken()


def register_run(folder: Path, given: Collection[str] = ()) -> None:
    """Store the config that a run left in its folder, which is data, as the primary config `RUN_AGAIN`.

    A ValueError names anything else in the config or beside it; see `check_run_tree`.
    """
    path = folder / RUN_CONFIG
    tree = plain_data.read_yaml(path)
    if not isinstance(tree, dict) or not {"task_name", "task"} <= tree.keys():
        raise ValueError(
            f"--config-dir {folder}: expected a run folder, whose {RUN_CONFIG} has a task and its name"
        )
    # Loggers write YAML files of their own beside the run's config.
    for beside in config_files(folder):
        if beside.parts[0] not in (RUN_CONFIG, *WRITTEN_BY_LOGGERS):
            raise ValueError(f"{folder / beside}: a run folder has no configs but its {RUN_CONFIG}")
    check_run_tree(tree, path, given=given)
    store_run(tree, path)


def store_run(tree: Tree, path: Path) -> None:
    """Store the config of a run, which `check_run_tree` has seen, as the primary config `RUN_AGAIN`."""
    task = tree.get("task")
    if not isinstance(task, dict) or not isinstance(task.get("scene"), dict):
        raise ValueError(
            f"{path}: task={task!r}: expected the config of an env, as a run writes it"
        )
    # The number of envs and the seed of the env follow the run's, as in a new config.
    plain = without_env_size(up_to_date(tree))
    ConfigStore.instance().store(name=RUN_AGAIN, node={**plain, "defaults": ["launch", "_self_"]})


def config_files(folder: Path) -> list[Path]:
    """Return the YAML files in a folder, relative to it."""
    names = (os.path.join(root, name) for root, _, files in os.walk(folder) for name in files)
    return sorted(
        Path(name).relative_to(folder) for name in names if name.endswith((".yaml", ".yml"))
    )


def check_groups(folder: Path) -> None:
    """Refuse a folder of config groups that holds more than values for fields and choices of groups.

    Refused are, as in a run's config, tags, anchors and resolvers such as `${oc.env:HOME}`, and also links and settings
    of how Hydra launches, logs or calls back. References to other fields, such as `${num_envs}`, are values, of which
    `MOST_REFERENCES` are taken.
    """
    found = config_files(folder)
    if not any(len(path.parts) > 1 and path.name != RUN_CONFIG for path in found):
        # Hydra would go on as if the folder had not been named.
        raise ValueError(
            f"--config-dir {folder}: expected a run folder, which has the {RUN_CONFIG} of a run, or a folder with "
            "config groups of yours"
        )
    for root, folders, _ in os.walk(folder):
        for name in folders:
            if os.path.islink(os.path.join(root, name)):  # which Hydra follows
                raise ValueError(
                    f"{os.path.join(root, name)}: a link, and what it leads to is no part of the folder"
                )
    # Counted over the whole folder: references multiply when they name each other.
    references = 0
    for path in found:
        text = read_bytes(folder / path, limit=MOST_GROUP_BYTES).decode(errors="replace")
        try:
            plain_data.check_events(folder / path, text)
            # Numbers of more digits than Python reads.
            with naming(f"{folder / path}: cannot be read"):
                # As well as the text, in which a name may be spelled with escapes.
                tree = yaml.safe_load(text)
        except yaml.YAMLError as error:
            raise ValueError(
                f"{folder / path}: cannot be read: {' '.join(str(error).split())}"
            ) from error
        plain_data.check_references(tree, str(folder / path))
        references += str(tree).count("${")
        if references > MOST_REFERENCES:
            raise ValueError(
                f"{folder / path}: the folder has more than {MOST_REFERENCES} references to other fields, such as "
                "${num_envs}: give values"
            )
        # A config at the top would be a primary config, and one that names Hydra could start programs.
        if len(path.parts) == 1 or "hydra" in f"{path} {text} {tree}".lower():
            raise ValueError(
                f"{folder / path}: a folder of config groups holds choices of groups only, which do not name Hydra; "
                "a config of your own that may do all that a program can is named with --config-name"
            )


def searched_folders(overrides: Sequence[str]) -> list[Path]:
    """Return the folders that overrides of `hydra.searchpath` name, which hold groups as `--config-dir` does."""
    found = []
    for text in overrides:
        if text.lstrip("+").partition("=")[0] == "hydra.searchpath":
            value = OverridesParser.create().parse_override(text).value()
            if isinstance(value, list):
                places = value
            else:
                places = [value]
            found += [
                # Packages are installed, and so are trusted.
                Path(str(place).removeprefix("file://"))
                for place in places
                if "pkg://" not in str(place)
            ]
    return found


class DeclaredConfigs(SearchPathPlugin):
    """Lets Hydra find the configs that other packages declare (see `ksim_rl.config.plugins`); ours come first."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        """Append them."""
        for origin, package in plugins.conf_packages():
            search_path.append(provider=f"ksim_rl.conf:{origin}", path=f"pkg://{package}")
