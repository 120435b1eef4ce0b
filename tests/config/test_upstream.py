"""What configs use of Hydra beyond its documents is still there: stored configs cost nothing until it loads them."""

import copy
from dataclasses import fields
from importlib.metadata import version

from hydra.core.config_store import ConfigNode, ConfigStore

from ksim_rl.config import upstream


def test_hydra_stores_nodes_of_these_fields_in_nested_dicts():
    moved = f"Hydra {version('hydra-core')}: ConfigStore.repo or ConfigNode"
    assert isinstance(ConfigStore.instance().repo, dict), moved
    assert {field.name for field in fields(ConfigNode)} == {
        "name",
        "node",
        "group",
        "package",
        "provider",
    }, moved


def test_a_config_is_made_once_when_it_is_loaded_first(monkeypatch):
    store, made = ConfigStore.instance(), []
    monkeypatch.setattr(store, "repo", {})

    def make():
        made.append(True)
        return {"value": 1}

    upstream.store_config("some/group", "one", make, package="_global_")
    assert copy.deepcopy(store).list("some/group") == ["one.yaml"]
    assert not made

    loaded = store.load("some/group/one.yaml")
    assert (loaded.name, loaded.group, loaded.package) == ("one.yaml", "some/group", "_global_")
    loaded.node.value = 2
    assert store.load("some/group/one.yaml").node == {"value": 1}
    assert len(made) == 1


def test_what_others_stored_is_kept_whole(monkeypatch):
    store = ConfigStore.instance()
    monkeypatch.setattr(store, "repo", {})
    store.store(name="one", group="group", node={"value": 1})
    upstream.quicken()
    assert copy.deepcopy(store).load("group/one.yaml") == store.load("group/one.yaml")
    assert store.load("group/one.yaml").node == {"value": 1}
