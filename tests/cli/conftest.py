import logging
import sys

import pytest

from ksim_rl import conf
from ksim_rl.cli import run_commands, train
from ksim_rl.config import plugins
from ksim_rl.trainers import sources
from tests.cli.payloads import SECRET, SMALL, Place, as_a_run_would


@pytest.fixture(scope="module")
def tree():
    return conf.compose(SMALL).to_tree()


@pytest.fixture
def place(tree, tmp_path, monkeypatch):
    for name in ("run", "outside", "work"):
        (tmp_path / name).mkdir()
    monkeypatch.chdir(tmp_path / "work")
    monkeypatch.syspath_prepend(str(tmp_path / "run"))
    monkeypatch.setenv("KSIM_RL_SECRET", SECRET)
    monkeypatch.delenv("KSIM_RL_MARK", raising=False)
    monkeypatch.setenv(plugins.VARIABLE, "")
    monkeypatch.setattr(plugins, "_named", [])
    for module in (train, run_commands):
        monkeypatch.setattr(module, "run_and_report", as_a_run_would)
    # Whether a logger's package is there is another question.
    monkeypatch.setattr(sources, "check_installed", lambda cfg: None)
    handlers = list(logging.root.handlers)
    yield Place(run=tmp_path / "run", outside=tmp_path / "outside", tree=tree)
    logging.root.handlers[:] = handlers
    sys.modules.pop("stranger", None)
