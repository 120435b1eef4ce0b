"""Checks and composes a `ksim-rl train` command line as a whole, before anything is built or written."""

import itertools
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path

import hydra
from hydra.core.config_loader import ConfigLoader
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from ksim_rl import envs
from ksim_rl.checks import check_known
from ksim_rl.conf import spelling
from ksim_rl.conf.registration import CHOSEN_BY_TASK, MODULE, NAME, RUN_AGAIN, register, store_run
from ksim_rl.config.overrides import check_parsed, quoting
from ksim_rl.config.trees import Tree
from ksim_rl.envs.managers.replaced_fields import check_not_replaced, overridden_curricula
from ksim_rl.trainers import RunCfg

# A sweep over more combinations than this is checked in part here; each job checks its own config again.
MAX_CHECKED_JOBS = 50
# Fields that follow from a rollout length.
SIZES = ("data.num_env_states_per_minibatch", "data.num_steps")


def compose(overrides: Sequence[str] = (), *, learns: bool = True) -> RunCfg:
    """Compose a run's config, as `ksim-rl train <overrides>` does; a ValueError lists the near names.

    Without `learns` no curriculum runs, and the fields that it replaces can be overridden.
    """
    register()
    return check_command_line(overrides, name=NAME, multirun=False, values=True, learns=learns)[0]


def changed(tree: Tree, path: Path, overrides: Sequence[str], *, learns: bool = False) -> RunCfg:
    """Return a run's config, the `tree` of its file at `path`, with overrides; a ValueError names a bad one.

    With `learns` curricula run, and the fields that they replace cannot be overridden alone.
    """
    register()
    store_run(tree, path)
    return check_command_line(
        overrides, name=RUN_AGAIN, multirun=False, values=True, learns=learns
    )[0]


def check_command_line(
    texts: Sequence[str], *, name: str, multirun: bool, values: bool, learns: bool = True
) -> list[RunCfg]:
    """Refuse overrides that name an unknown group, choice or field, or (with `values`) give a field a bad value.

    The primary config is `name`; sweeps such as `seed=1,2` need `multirun`. With `values` it returns the config, of
    each job of a sweep. With `learns` overrides of what a curriculum replaces are refused. The ValueError is one line
    that names the fault, and the near names or the valid values.
    """
    # Hydra keeps one global state: an earlier call in this process would be found in the way.
    GlobalHydra.instance().clear()
    try:
        with hydra.initialize_config_module(MODULE, version_base="1.3"):
            loader = GlobalHydra.instance().config_loader()
            # Parsed before anything is composed, for errors that name one override.
            overrides = [_parse(spelling.in_full(text), loader) for text in texts]
            sweeps = [
                str(override.input_line) for override in overrides if override.is_sweep_override()
            ]
            if sweeps and not multirun:
                raise ValueError(
                    f"override {sweeps[0]!r} has several values: add --multirun to run one job for each"
                    f"{quoting(sweeps[0])}"
                )
            # Names before values: Hydra's own messages about them are long.
            _check_names(overrides, loader, name)
            # Many jobs are checked in part; each of them checks itself when it starts.
            jobs = itertools.islice(_jobs(overrides), MAX_CHECKED_JOBS if values else 0)
            return [_compose(job, name, learns=learns) for job in jobs]
    except (HydraException, OmegaConfBaseException) as error:
        raise ValueError(f"the overrides do not compose: {' '.join(str(error).split())}") from error


def fields_of(overrides: Sequence[str]) -> list[str]:
    """Return the fields that overrides name: "task.sim.njmax" of "+task.sim.njmax=90"."""
    # "+" adds and "~" deletes: the field behind is the same.
    return [text.lstrip("+~").partition("=")[0] for text in overrides]


def without_sweeps(texts: Sequence[str]) -> list[str]:
    """Return the keys of overrides that are the same in all jobs of a multirun."""
    parsed = (OverridesParser.create().parse_override(text) for text in texts)
    return [override.get_key_element() for override in parsed if not override.is_sweep_override()]


def _compose(overrides: list[str], name: str, *, learns: bool) -> RunCfg:
    # Interpolations are resolved here, as the run's config holds values only.
    plain = OmegaConf.to_container(hydra.compose(name, overrides=overrides), resolve=True)
    assert isinstance(plain, dict)
    cfg = RunCfg.from_tree({str(key): value for key, value in plain.items()})
    check_composed(cfg, overrides, learns=learns, again=name == RUN_AGAIN)
    return cfg


def check_composed(
    cfg: RunCfg, overrides: Sequence[str], *, learns: bool = True, again: bool = False
) -> None:
    """Refuse overrides of one job whose values the composed config would not keep, of data sizes or by a curriculum.

    Where a run is made `again` or goes on, a curriculum that it was given itself need not be named once more.
    """
    # Data sizes follow from the rollout length, so only one of the two may be given.
    for override in overrides:
        if override.partition("=")[0] in SIZES and cfg.collector.rollout_length is not None:
            raise ValueError(
                f"override {override!r}: collector.rollout_length={cfg.collector.rollout_length} sets it; leave one of "
                "the two out, or set collector.rollout_length=null"
            )
    if learns:
        given_before = []
        # The task of a package that is not loaded here, or of a program, has no curriculum to compare with.
        if again and cfg.task_name in envs.names():
            own = envs.task(cfg.task_name).cfg().curriculum
            given_before = overridden_curricula(cfg.task.curriculum, own)
        check_not_replaced(cfg.task.curriculum, overrides, given_before)


def _parse(text: str, loader: ConfigLoader) -> Override:
    # A flag among the overrides is a slip of habit: the error has the right spelling.
    if text.startswith("-"):
        raise spelling.of_flag(text)
    if not text.isascii() and text.encode(errors="replace").decode() != text:
        raise ValueError(
            f"override {text!r}: bytes that are no UTF-8, which Hydra's configs need: give the folder or file "
            "another name"
        )
    try:
        return OverridesParser.create(config_loader=loader).parse_override(text)
    except HydraException as error:
        # A single word may be a task or a folder; the error shows its right use.
        if "=" not in text and (explained := spelling.of_word(text)) is not None:
            raise explained from error
        reason = " ".join(str(error).split())
        raise ValueError(
            f"override {text!r} does not parse (expected group=name or field=value): {reason}{quoting(text)}"
        ) from error


def _check_names(overrides: Sequence[Override], loader: ConfigLoader, name: str) -> None:
    groups = _groups(loader)
    choices = []
    fields = []
    for override in overrides:
        # The name is a part of the task, and would not change the task.
        if override.key_or_group == "task_name":
            raise ValueError(
                f"override {override.input_line!r}: the name comes with the task; choose that with task=name"
            )
        if override.key_or_group in groups:
            # A run that is made again has one config, and no groups to choose from.
            if name == RUN_AGAIN:
                raise ValueError(
                    f"override {override.input_line!r}: a run's config has no groups; override its fields, or compose "
                    "a new config without --config-dir"
                )
            options = loader.get_group_options(override.key_or_group)
            if override.is_delete():
                raise ValueError(
                    f"override {override.input_line!r}: a run needs each group; choose another with "
                    f"{override.key_or_group}=name: {', '.join(options)}"
                )
            # Each value of a sweep is a choice.
            for choice in _values(override):
                check_known(override.key_or_group, choice, options)
            # A group that is not in the defaults list, such as another package's, is added with "+".
            added = "+" if override.is_add() else ""
            # The first choice of a sweep stands for all: their fields are alike.
            choices.append(f"{added}{override.key_or_group}={_values(override)[0]}")
        elif not override.is_hydra_override():
            fields.append(override)
    if not fields:
        return
    sources = tuple(element.path or "" for element in loader.get_search_path().get_path())
    # The primary config of a run that is made again is another one each time.
    tree = (_names.__wrapped__ if name == RUN_AGAIN else _names)(name, tuple(choices), sources)
    check_parsed(
        {**dict.fromkeys(group for group in groups if group not in CHOSEN_BY_TASK), **tree}, fields
    )


@cache
def _names(name: str, choices: tuple[str, ...], sources: tuple[str, ...]) -> Tree:
    """Compose the tree that overrides are checked against: choices of groups from sources that stay in a process."""
    # Without overrides of fields, which are checked against this tree.
    tree = OmegaConf.to_container(hydra.compose(name, overrides=list(choices)))
    assert isinstance(tree, dict)
    return {str(key): value for key, value in tree.items()}


def listed_groups() -> str:
    """Return the groups that a user chooses from, a line each, with their choices."""
    GlobalHydra.instance().clear()
    with hydra.initialize_config_module(MODULE, version_base="1.3"):
        return _listed_groups()


def _listed_groups() -> str:
    loader = GlobalHydra.instance().config_loader()
    names = [group for group in _groups(loader) if group not in CHOSEN_BY_TASK]
    return "\n".join(f"{name}: {', '.join(loader.get_group_options(name))}" for name in names)


# For `--help`, whose own list has groups without a choice.
OmegaConf.register_new_resolver("listed_groups", _listed_groups, replace=True)


def _groups(loader: ConfigLoader) -> list[str]:
    top = [group for group in loader.list_groups("") if group != "hydra"]
    return [*top, *(f"{group}/{child}" for group in top for child in loader.list_groups(group))]


def _jobs(overrides: Sequence[Override]) -> Iterator[list[str]]:
    """Yield the overrides of each job, as Hydra's sweeper would."""
    # One axis for each override; those without a sweep have a single value.
    axes = [
        [f"{override.get_key_element()}={value}" for value in override.sweep_string_iterator()]
        if override.is_discrete_sweep()
        # Sweeps by ranges of a sweeper plug-in are left to it.
        else [override.input_line or ""]
        for override in overrides
    ]
    return (list(job) for job in itertools.product(*axes))


def _values(override: Override) -> list[str]:
    if override.is_discrete_sweep():
        return list(override.sweep_string_iterator())
    return [str(override.value())]
