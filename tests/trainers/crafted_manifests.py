"""Manifests that have a right hash and hold another state than a run has: parts are gone, or of another kind."""

import contextlib
import copy
import io
import shutil

from ksim_rl.cli import main
from ksim_rl.trainers import checkpoint
from tests.cli.payloads import SMALL

WORDS = (
    "task=cartpole_balance",
    *SMALL,
    "trainer.num_iterations=1",
    "trainer.eval_episodes=0",
    "device=cpu",
)


def called(*words):
    """Run a command; return its exit code, and what it printed."""
    said = io.StringIO()
    with contextlib.redirect_stderr(said), contextlib.redirect_stdout(said):
        try:
            main.main(list(words))
        except SystemExit as ended:
            return ended.code, said.getvalue()
    return 0, said.getvalue()


def a_run(folder):
    """Make the run folder of one iteration."""
    code, said = called("train", *WORDS, "trainer.video=false", f"hydra.run.dir={folder}")
    assert code in (0, 1), said
    return folder


def changes(manifest):
    """Yield changes of a manifest by name, as functions that make them."""

    def without(name):
        return lambda crafted: crafted["values"].pop(name)

    def with_value(name, value):
        return lambda crafted: crafted["values"].update({name: value})

    yield "no values", lambda crafted: crafted.update(values={})
    for name in manifest["values"]:
        yield f"without {name}", without(name)
        yield f"text for {name}", with_value(name, "text")
        yield f"list for {name}", with_value(name, [1])


def figures(place, *, manifests):
    """Craft manifests of a run, and resume each; count those that end otherwise than well, or in one line."""
    run = a_run(place / "run")
    path = checkpoint.saved(run / "checkpoint")[-1]
    manifest = checkpoint._read_manifest(path)
    every = list(changes(manifest))
    found = {"manifests": 0, "not_refused_in_one_line": 0, "resumed": 0}
    for name, change in every[:: max(1, len(every) // manifests)]:
        crafted = copy.deepcopy(manifest)
        change(crafted)
        (path / checkpoint.MANIFEST).write_bytes(checkpoint._seal(crafted))
        again = place / "again"
        shutil.copytree(run, again)
        code, said = called("resume", str(again), "--num-iterations", "2", "trainer.video=false")
        shutil.rmtree(again)
        errors = [line for line in said.splitlines() if line.startswith("ksim-rl: error: ")]
        refused = code == 2 and len(errors) == 1 and "Traceback" not in said
        found["manifests"] += 1
        found["resumed"] += code in (0, 1)  # what is not needed may be anything
        found["not_refused_in_one_line"] += code not in (0, 1) and not refused
        if code not in (0, 1) and not refused:
            print(f"{name}: exit code {code}: {said[-300:]}", flush=True)
    return found
