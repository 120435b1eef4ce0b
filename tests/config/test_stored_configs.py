"""Stored configs cost nothing until Hydra loads them."""

import copy

from hydra.core.config_store import ConfigStore

from ksim_rl.config import stored_configs


def test_a_config_is_made_once_when_it_is_loaded_first(monkeypatch):
    store, made = ConfigStore.instance(), []
    monkeypatch.setattr(store, "repo", {})

    def make():
        made.append(True)
        return {"value": 1}

    stored_configs.store("some/group", "one", make, package="_global_")
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
    stored_configs.quicken()
    assert copy.deepcopy(store).load("group/one.yaml") == store.load("group/one.yaml")
    assert store.load("group/one.yaml").node == {"value": 1}
