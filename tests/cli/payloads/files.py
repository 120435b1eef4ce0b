"""Payloads in classes, packages, checkpoints and the folders of exports."""

import contextlib
import copy
import hashlib
import io
import json
import os
import textwrap

import safetensors.torch
import torch

from ksim_rl.cli import run_commands
from ksim_rl.config import plugins
from ksim_rl.export import folder as export_folder
from ksim_rl.scene.actuators import nets
from ksim_rl.trainers import checkpoint
from tests.cli.payloads.place import family

# -- classes and packages ---------------------------------------------------------------------------------------------


def a_package(place):
    """Make a package whose import leaves a mark, where Python finds it."""
    (place.run / "stranger.py").write_text(
        textwrap.dedent(f"""
        from dataclasses import dataclass
        {place.code}
        @dataclass
        class Robot:
            pass
        """)
    )


def any_package(monkeypatch):
    monkeypatch.setattr(plugins, "packages", lambda: frozenset({"stranger"}))


def with_target(place, target):
    task = copy.deepcopy(place.tree["task"])
    first = next(iter(task["scene"]["robots"]))
    task["scene"]["robots"][first] = {"_target_": target}
    return task


@family(any_package)
def class_of_a_package_in_config(place):
    a_package(place)
    return place.write_config(task=with_target(place, "stranger.Robot"))


@family(any_package)
def class_of_a_package_in_a_manifest(place):
    a_package(place)
    return place.write_checkpoint(task=with_target(place, "stranger.Robot"))


def load_what_is_remembered(monkeypatch):
    monkeypatch.setattr(plugins, "check_remembered", plugins.load)


@family(load_what_is_remembered)
def plugin_in_config(place):
    a_package(place)
    return place.write_config(plugins=["stranger"])


@family(load_what_is_remembered)
def plugin_in_a_manifest(place):
    a_package(place)
    return place.write_checkpoint(plugins=["stranger"])


# -- checkpoints and data files ---------------------------------------------------------------------------------------


class Bomb:
    """Runs code where it is unpickled."""

    def __init__(self, code):
        self.code = code

    def __reduce__(self):
        return exec, (self.code,)


def with_pickles(monkeypatch):
    def load(data):
        return torch.load(io.BytesIO(data), weights_only=False)

    monkeypatch.setattr(safetensors.torch, "load", load)
    monkeypatch.setattr(nets, "load", load)


@family(with_pickles)
def pickle_for_the_tensors_of_a_checkpoint(place):
    command = place.write_checkpoint()
    saved = checkpoint.saved(place.run / "checkpoint")[-1]
    data = io.BytesIO()
    torch.save({"x": Bomb(place.code)}, data)
    (saved / checkpoint.TENSORS).write_bytes(data.getvalue())
    manifest = json.loads((saved / checkpoint.MANIFEST).read_text())["manifest"]
    digest = hashlib.sha256(data.getvalue()).hexdigest()
    manifest["files"][checkpoint.TENSORS] = {"bytes": len(data.getvalue()), "sha256": digest}
    (saved / checkpoint.MANIFEST).write_bytes(checkpoint._seal(manifest))
    return command


def follow_links(monkeypatch):
    monkeypatch.setattr(os, "O_NOFOLLOW", 0)
    monkeypatch.setattr(run_commands, "check_links", lambda *_, **__: None)


@family(follow_links)
def link_for_the_config_of_a_run_that_goes_on(place):
    place.write_checkpoint()
    (place.run / "config.yaml").symlink_to(place.outside / "written")
    return ["resume", str(place.run)]


@family(follow_links)
def link_for_the_folder_of_checkpoints(place):
    place.write_checkpoint()
    (place.run / "checkpoint").rename(place.outside.parent / "other")
    (place.outside.parent / "outside" / "checkpoint").symlink_to(place.outside.parent / "other")
    (place.run / "checkpoint").symlink_to(place.outside / "checkpoint")
    (place.run / "config.yaml").symlink_to(place.outside / "written")
    return ["resume", str(place.run)]


# -- exports ----------------------------------------------------------------------------------------------------------


def written_where_it_is(monkeypatch):
    @contextlib.contextmanager
    def as_it_is(path, below):
        path.mkdir(exist_ok=True)
        yield path

    def fill(trained, path, **_):
        for name in ("README.md", "written"):
            (path / name).write_text("x")

    for name in ("check_folder", "check_own"):
        monkeypatch.setattr(export_folder, name, lambda *_, **__: None)
    monkeypatch.setattr(export_folder, "whole_folder", as_it_is)
    monkeypatch.setattr(export_folder, "policy_of", lambda *_, **__: None)
    monkeypatch.setattr(export_folder, "_fill", fill)


@family(written_where_it_is)
def link_for_the_folder_of_an_export(place):
    place.write_checkpoint()
    (place.run / "export").symlink_to(place.outside)
    return ["export", str(place.run)]


@family(written_where_it_is)
def link_for_a_file_of_an_export(place):
    place.write_checkpoint()
    (place.run / "export").mkdir()
    (place.run / "export" / "README.md").symlink_to(place.outside / "written")
    return ["export", str(place.run)]
