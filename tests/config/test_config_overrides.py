"""Every field of every task's config is in reach of a Hydra override."""

from collections.abc import Mapping

import pytest
from hydra import compose, initialize
from omegaconf import OmegaConf

from ksim_rl import envs
from ksim_rl.config.overrides import check_overrides
from ksim_rl.config.trees import Tree
from ksim_rl.envs import ManagerBasedRlEnvCfg, from_tree, registry, to_tree

# What Hydra's grammar wants escaped in a key of a mapping.
ESCAPED = "\\()[]{}:=, \t"


def leaves(tree, path):
    """Yield the dotted path and the value of each leaf; a mapping with other keys than names (patterns) is one."""
    if (
        isinstance(tree, Mapping)
        and tree
        and all(str(key).isidentifier() or str(key).isdigit() for key in tree)
    ):
        for key, value in tree.items():
            yield from leaves(value, f"{path}.{key}")
    else:
        yield path, tree


def changed(value):
    """Another value of the same kind."""
    if isinstance(value, bool):
        return not value
    if isinstance(value, (int, float)):
        return value + 1
    if isinstance(value, str):
        return f"{value}_changed"
    if isinstance(value, list):
        return [changed(entry) for entry in value] or [1.5]
    if isinstance(value, Mapping):
        return {key: changed(entry) for key, entry in value.items()} or {"added": 1}
    return 7


def written(value):
    """The value in Hydra's grammar."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return "'" + value.replace("\\", "\\\\").replace("'", "\\'") + "'" if value else "''"
    if isinstance(value, list):
        return "[" + ", ".join(written(entry) for entry in value) + "]"
    if isinstance(value, Mapping):
        return (
            "{"
            + ", ".join(f"{_escaped(str(key))}: {written(entry)}" for key, entry in value.items())
            + "}"
        )
    return repr(value)


def _escaped(key):
    return "".join(f"\\{letter}" if letter in ESCAPED else letter for letter in key)


def composed(name, overrides):
    registry.register_configs()
    with initialize(version_base="1.3", config_path=None):
        return OmegaConf.to_container(
            compose(config_name="ksim_rl_env", overrides=[f"task={name}", *overrides]).task
        )


def tree_of(name):
    return to_tree(envs.task(name).cfg(), ManagerBasedRlEnvCfg)


# One task of each kind in every run, the others in full ones: Hydra's parser takes its time.
QUICK = ("arm_push", "cartpole_balance", "go1_velocity_rough", "walker_track")
NAMES = [
    name if name in QUICK else pytest.param(name, marks=pytest.mark.full) for name in envs.names()
]


@pytest.mark.parametrize("name", NAMES)
def test_every_leaf_can_be_changed_and_given_as_it_is(name):
    tree = tree_of(name)
    before = dict(leaves(tree, "task"))
    assert len(before) > 40
    same = composed(name, [f"{path}={written(value)}" for path, value in before.items()])
    assert from_tree(ManagerBasedRlEnvCfg, same, "task") == envs.task(name).cfg()

    wanted = {path: changed(value) for path, value in before.items()}
    after = composed(
        name, [f"{'++' if _grows(before[p]) else ''}{p}={written(v)}" for p, v in wanted.items()]
    )
    for path, value in wanted.items():
        got = after
        for key in path.split(".")[1:]:
            got = got[key]
        if isinstance(value, dict):  # Hydra merges mappings
            assert value.items() <= got.items(), path
        else:
            assert got == value, path


def _grows(value):
    return isinstance(value, Mapping) and not value


def test_every_field_of_the_config_is_a_key_of_the_tree():
    assert tree_of("cartpole_balance").keys() == set(ManagerBasedRlEnvCfg.__dataclass_fields__)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["task.rewards=[]"], r"override task\.rewards=\[\]"),
        (["task.decimation=0"], r"task\.decimation=0: expected a whole number"),
        (
            ["task.actions.force.joints='slide_.*'"],
            r"actions\.force: no joint matches 'slide_\.\*'.*'slider'",
        ),
        (["task.events.reset.mode=interval"], r"task\.events\.reset\.interval_range_s=None"),
        (["task.viewer.body=nope"], r"viewer\.body='nope': valid: cart, pole"),
    ],
)
def test_what_is_wrong_is_named_with_its_place(overrides, message):
    with pytest.raises(ValueError, match=message):
        envs.make("cartpole_balance", num_envs=2, overrides=overrides, render_mode="rgb_array")


def test_mappings_add_their_entries_and_an_empty_one_is_refused():
    tree: Tree = {"task": {"events": {"reset": {"mode": "reset", "range": [0, 1]}}, "rewards": {}}}
    inside = ["task.events={reset: {range: [0, 2]}}", "task.events.reset.mode=startup"]
    check_overrides(tree, [*inside, "task.rewards={}", "+task.new={}", "task.events=null"])
    for nothing in (
        "task.events={}",
        "++task.events={}",
        "task={events: {}}",
        "task.events={},null",
    ):
        with pytest.raises(ValueError, match=r"^task\.events=\{\}: .* changes nothing: .*reset.*"):
            check_overrides(tree, [nothing])
