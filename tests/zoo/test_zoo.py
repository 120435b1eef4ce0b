"""Policies of the zoo are whole, small, and read as data; for policies on Weights & Biases a stub is its API."""

import json
import shutil
import sys
import types
from importlib.machinery import ModuleSpec
from pathlib import Path

import pytest

from ksim_rl.cli import export as cli_export
from ksim_rl.cli.main import main
from ksim_rl.trainers import checkpoint
from ksim_rl.trainers.loggers import WandbCfg
from ksim_rl.zoo import cards, locate, read_card, wandb_runs
from ksim_rl.zoo.adding import add
from ksim_rl.zoo.cards import FOLDER, MOST_BYTES, read_transfer

PAGES = Path(__file__).parents[2] / "docs"
NAMES = [card.name for card in cards()]


@pytest.mark.parametrize("name", NAMES)
def test_an_entry_is_small_and_says_where_it_comes_from(name):
    card = read_card(name)
    files = [path for path in (FOLDER / name).rglob("*") if path.is_file()]
    assert {path.name for path in files} == {
        "card.json",
        "policy.onnx",
        "manifest.json",
        "tensors.safetensors",
    }
    assert sum(path.stat().st_size for path in files) <= MOST_BYTES
    assert len(card.commit) == 40 and card.env_states > 0 and len(card.curve) > 5
    assert abs(card.sim2sim["return_ratio"] - 1.0) < 0.03
    saved = checkpoint.load_latest(FOLDER / name)
    assert saved.iteration == card.iteration and saved.config["task_name"] == card.task
    assert set(saved.state) == {"observation_columns", "update"}


@pytest.mark.parametrize("name", NAMES)
def test_the_page_has_the_figures_of_the_card(name):
    page = (PAGES / "zoo.md").read_text()
    (row,) = [line for line in page.splitlines() if line.startswith(f"| `{name}` |")]
    card = read_card(name)
    _, _, task, trained, earned, compared, kept, _ = (cell.strip() for cell in row.split("|"))
    assert task == f"`{card.task}`" and trained.endswith(f", commit {card.commit[:7]}")
    assert float(earned.split()[0]) == pytest.approx(card.return_mean, abs=0.5)
    assert float(compared.split()[1]) == pytest.approx(card.sim2sim["return_ratio"], abs=5e-4)
    assert compared.endswith(f", {card.sim2sim['episodes']:.0f} episodes")
    transfer = read_transfer(name)
    weakest = transfer["weakest"]
    link = f"cards/{name}/card.md"
    assert kept == f"[x {weakest['share']:.2f}, {weakest['condition']}]({link})"
    assert transfer["verdict"] in (PAGES / link).read_text()
    assert (PAGES / "cards" / name / "card.png").stat().st_size > 10_000


def test_one_is_copied_into_a_run_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    said = []
    copy = locate(f"zoo:{NAMES[0]}", note=said.append)
    assert copy == Path("runs/zoo") / NAMES[0]
    assert checkpoint.load_latest(copy).iteration == read_card(NAMES[0]).iteration
    assert "copied to runs/zoo" in said[0]
    assert locate(f"zoo:{NAMES[0]}", note=said.append) == copy
    assert locate("runs/mine") == Path("runs/mine")


@pytest.mark.full
def test_one_is_exported_by_its_name(tmp_path, monkeypatch):
    pytest.importorskip("onnxscript", reason="needs the extra: pip install ksim_rl[export]")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit, match="^0$"):
        main(["export", "zoo:cartpole", "--episodes", "0"])
    meta = json.loads(Path("runs/zoo/cartpole/export/export.json").read_text())
    card = read_card("cartpole")
    assert meta["commit"] == card.commit and meta["iteration"] == card.iteration
    assert meta["task"] == card.task


def test_an_export_finds_its_policy_by_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    asked = []

    def note(run, folder, *, origin, **_):
        asked.append((run, checkpoint.load_latest(run).iteration, origin))
        return Path("export")

    monkeypatch.setattr(cli_export, "export", note)
    for words, code in ((["zoo:cartpole"], 0), (["runs/zoo/cartpole"], 0), (["zoo:cartpol"], 2)):
        with pytest.raises(SystemExit, match=f"^{code}$"):
            main(["export", *words])
    card = read_card("cartpole")
    run = Path("runs/zoo/cartpole")
    assert asked == [(run, card.iteration, {"commit": card.commit}), (run, card.iteration, {})]


@pytest.fixture
def zoo(tmp_path):
    shutil.copytree(FOLDER / NAMES[0], tmp_path / NAMES[0])
    return tmp_path


def test_changed_files_are_refused(zoo):
    read_card(NAMES[0], zoo)
    with open(zoo / NAMES[0] / "policy.onnx", "ab") as file:
        file.write(b"more")
    with pytest.raises(ValueError, match="its files differ from what its card says"):
        read_card(NAMES[0], zoo)


def test_links_and_strangers_cards_are_refused(zoo):
    card = zoo / NAMES[0] / "card.json"
    tree = json.loads(card.read_text())
    card.write_text(json.dumps(tree | {"seed": "one"}))
    with pytest.raises(ValueError, match=r"no card: seed='one'"):
        read_card(NAMES[0], zoo)
    card.write_text(json.dumps(tree | {"more": 1}))
    with pytest.raises(ValueError, match="no card: .*more"):
        read_card(NAMES[0], zoo)
    card.write_text(json.dumps(tree))
    (zoo / NAMES[0] / "policy.onnx").unlink()
    (zoo / NAMES[0] / "policy.onnx").symlink_to("/etc/hostname")
    with pytest.raises(ValueError, match="cannot be read"):
        read_card(NAMES[0], zoo)


COMMIT = "0123456789abcdef" * 2 + "01234567"


@pytest.fixture
def run(tmp_path):
    """Return a function that gives a run folder of the zoo's reacher, and its record the code of its sessions."""
    folder = tmp_path / "run"
    shutil.copytree(FOLDER / "reacher" / "checkpoint", folder / "checkpoint")
    (folder / "config.yaml").write_text("task_name: reacher\n")
    rows = [
        f"{8192 * i},{i},{'' if i % 2 else i / 3}," + ("795.5" if i == 60 else "")
        for i in range(1, 61)
    ]
    (folder / "metrics.csv").write_text(
        "\n".join(["env_states,iteration,episode/return,evaluation/return_mean", *rows, ""])
    )

    def of(*codes):
        sessions = [
            {"began": "today", "command": "train", "code": {"ksim_rl": code}} for code in codes
        ]
        (folder / "run.json").write_text(json.dumps({"sessions": sessions}))
        return folder

    return of


@pytest.mark.parametrize(
    ("codes", "said"),
    [
        (
            [{"commit": COMMIT, "changed": "ksim_rl.diff"}],
            f"made of {COMMIT} with changes: train in a clean",
        ),
        (
            [{"commit": COMMIT}, {"commit": COMMIT, "changed": "x"}],
            f"made of {COMMIT} and {COMMIT} with",
        ),
        (
            [{"commit": COMMIT}, {"commit": COMMIT[::-1]}],
            f"made of {COMMIT} and {COMMIT[::-1]}: train",
        ),
        (
            [{"commit": "HEAD"}],
            "made of HEAD: train in a clean clone of one commit, and add that run",
        ),
        ([{}], "made of no commit: train in a clean clone"),
        ([], "made of no commit: train in a clean clone"),
    ],
    ids=["changed", "changed later", "two commits", "a name", "outside of git", "no record"],
)
def test_a_run_of_code_that_no_commit_has_is_refused_in_one_line(
    run, codes, said, tmp_path, capsys
):
    with pytest.raises(SystemExit) as ended:
        main(["zoo", "add", str(run(*codes)), "mine", "--folder", str(tmp_path / "zoo")])
    assert ended.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line
    assert not (tmp_path / "zoo").exists()


@pytest.mark.full
def test_an_entry_names_the_commit_of_its_run(run, tmp_path):
    pytest.importorskip("onnxruntime")
    card = add(
        run({"commit": COMMIT}, {"commit": COMMIT}), "mine", folder=tmp_path / "zoo", episodes=2
    )
    assert card == read_card("mine", tmp_path / "zoo")
    assert (card.commit, card.task, card.seed) == (COMMIT, "reacher", 1)
    assert (card.env_states, card.return_mean) == (60 * 8192, 795.5)
    assert card.curve[0] == [16384, 0.6667] and len(card.curve) == 30
    assert card.sim2sim["episodes"] == 2.0 and abs(card.sim2sim["return_ratio"] - 1.0) < 0.03
    again = checkpoint.load_latest(tmp_path / "zoo" / "mine")
    assert again.state.keys() == checkpoint.load_latest(FOLDER / "reacher").state.keys()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["play", "zoo:../../secret"], "no such policy"),
        (["play", f"zoo:{NAMES[0]}e"], f"did you mean '{NAMES[0]}'"),
        (["eval", "wandb:../secret"], "expected wandb:ENTITY/PROJECT/RUN"),
        (["zoo", "add", "runs/x"], "expected NAME, or add RUN NAME"),
        (["zoo", "add", "runs/x", "../x"], "lower-case letters"),
    ],
)
def test_wrong_names_are_refused_in_one_line(words, said, capsys):
    with pytest.raises(SystemExit) as ended:
        main(words)
    assert ended.value.code == 2
    assert said in capsys.readouterr().err


def test_the_list_names_all(capsys):
    with pytest.raises(SystemExit) as ended:
        main(["zoo"])
    assert ended.value.code == 0
    listed = capsys.readouterr().out
    assert all(name in listed for name in NAMES)
    weakest = read_transfer(NAMES[0])["weakest"]["share"]
    (row,) = [line for line in listed.splitlines() if line.startswith(NAMES[0])]
    assert f"x {weakest:.2f}" in row
    with pytest.raises(SystemExit):
        main(["zoo", NAMES[0]])
    shown = json.loads(capsys.readouterr().out)["transfer"]
    assert shown["weakest"]["share"] == weakest and "as trained" in shown["shares"]


# -- Weights & Biases --------------------------------------------------------------------------------------------


class Artifact:
    """What `wandb.Artifact` is to us: files by name, which are downloaded into a folder."""

    def __init__(self, name, type):
        self.name, self.type, self.files = name, type, {}

    @property
    def manifest(self):
        return types.SimpleNamespace(
            entries={
                name: types.SimpleNamespace(size=len(content))
                for name, content in self.files.items()
            }
        )

    def add_file(self, path, name):
        self.files[name] = Path(path).read_bytes()

    def download(self, root):
        for name, content in self.files.items():
            (Path(root) / name).parent.mkdir(parents=True, exist_ok=True)
            (Path(root) / name).write_bytes(content)


class Stub(types.ModuleType):
    """A `wandb` that keeps what it is sent."""

    def __init__(self):
        super().__init__("wandb")
        self.__spec__ = ModuleSpec("wandb", None)
        self.kept, self.began, self.logged = [], {}, []
        self.Artifact, self.Video = Artifact, lambda path, format: path

    def init(self, **options):
        self.began = options
        return types.SimpleNamespace(
            log_artifact=self.kept.append, log=self.logged.append, finish=lambda: None
        )

    def Api(self):
        return types.SimpleNamespace(
            run=lambda _: types.SimpleNamespace(logged_artifacts=lambda: self.kept)
        )


@pytest.fixture
def wandb(monkeypatch):
    stub = Stub()
    monkeypatch.setitem(sys.modules, "wandb", stub)
    return stub


def test_a_run_is_sent_to_wandb_and_comes_back(wandb, zoo, tmp_path, monkeypatch):
    run = zoo / NAMES[0]
    (run / "wandb").mkdir()
    (run / "wandb" / "run_id").write_text("abc123")
    (run / "video.mp4").write_bytes(b"frames")
    monkeypatch.setattr(
        wandb_runs, "export", lambda run, folder, **_: (folder / "policy.onnx").write_bytes(b"net")
    )
    said = []
    wandb_runs.upload(WandbCfg(project="robots"), run, note=said.append)
    assert said == [] and wandb.began["id"] == "abc123" and wandb.began["project"] == "robots"
    newest = checkpoint.load_latest(run).path.name
    assert set(wandb.kept[0].files) == {
        "video.mp4",
        "policy.onnx",
        f"checkpoint/{newest}/manifest.json",
        f"checkpoint/{newest}/tensors.safetensors",
    }
    assert "video" in wandb.logged[0]
    fetched = wandb_runs.download("me/robots/abc123", tmp_path / "fetched", note=said.append)
    assert fetched == tmp_path / "fetched" / "me_robots_abc123"
    assert checkpoint.load_latest(fetched).iteration == read_card(NAMES[0]).iteration


def test_a_service_that_fails_costs_no_training(wandb, zoo, monkeypatch):
    monkeypatch.setattr(wandb_runs, "export", lambda *_, **__: None)
    said = []
    wandb_runs.upload(WandbCfg(), zoo / NAMES[0], note=said.append)  # the folder has no id
    assert len(said) == 1 and "nothing was sent to Weights & Biases" in said[0]


@pytest.mark.parametrize(
    "name", ["../../secret", "checkpoint/1/evil.py", "/etc/passwd", "config.yaml/../x"]
)
def test_an_artifact_with_other_files_is_refused(wandb, name, tmp_path):
    artifact = Artifact("run-x", wandb_runs.KIND)
    artifact.files[name] = b"x"
    wandb.kept.append(artifact)
    with pytest.raises(ValueError, match="is no file of a run"):
        wandb_runs.download("me/robots/abc123", tmp_path / "fetched", note=print)
    assert not (tmp_path / "fetched").exists()
