"""Sends the files of a run to Weights & Biases, and fetches them from there."""

import re
import tempfile
from collections.abc import Callable
from pathlib import Path

from ksim_rl.export import export
from ksim_rl.files.writing import check_links, make_folder
from ksim_rl.trainers import checkpoint
from ksim_rl.trainers.loggers import LoggerCfg, WandbCfg, check_installed, kept_id

KIND = "ksim_rl_run"
ADDRESS = re.compile(r"[\w.-]+/[\w.-]+/[\w-]+", re.ASCII)
# The files of an artifact of ours; any other name is refused before a download.
FILES = re.compile(
    r"(config\.yaml|video\.mp4|policy\.onnx|checkpoint/\d+/[a-z]+\.(json|safetensors))"
)


def upload(cfg: WandbCfg, run: Path, *, note: Callable[[str], None]) -> None:
    """Add a run's newest checkpoint, config, video and ONNX file to its run on Weights & Biases, as one artifact.

    A file that cannot be sent is named in a line: the training stands without it.
    """
    # Whatever goes wrong here, the training is done and stays.
    try:
        import wandb  # pyright: ignore[reportMissingImports]

        files = {
            name: run / name for name in ("config.yaml", "video.mp4") if (run / name).is_file()
        }
        newest = checkpoint.load_latest(run, note=note).path
        files |= {f"checkpoint/{newest.name}/{path.name}": path for path in newest.iterdir()}
        mode = "offline" if cfg.offline else None
        with tempfile.TemporaryDirectory() as temporary:
            # A policy may have no form in ONNX; the checkpoint is sent all the same.
            try:
                export(run, Path(temporary), episodes=0, note=lambda _: None)
                files["policy.onnx"] = Path(temporary) / "policy.onnx"
            except ValueError as error:
                note(f"no policy.onnx for Weights & Biases: {error}")
            # The run that the logger has opened on the service.
            own = kept_id(run)
            account = {"project": cfg.project, "entity": cfg.entity, "id": own, "resume": "allow"}
            session = wandb.init(dir=str(run), mode=mode, **account)
            artifact = wandb.Artifact(f"run-{own}", type=KIND)
            for name, path in files.items():
                artifact.add_file(str(path), name=name)
            session.log_artifact(artifact)
            if "video.mp4" in files:
                session.log({"video": wandb.Video(str(files["video.mp4"]), format="mp4")})
            session.finish()
    except Exception as error:  # a service has errors of its own
        note(f"warning: nothing was sent to Weights & Biases: {type(error).__name__}: {error}")


def download(address: str, folder: Path, *, note: Callable[[str], None]) -> Path:
    """Fetch the newest artifact of a run `ENTITY/PROJECT/RUN` into a run folder in `folder`, and return it.

    Raises ValueError for another address, a run without one, and files that no run of ours has.
    """
    if not ADDRESS.fullmatch(address):
        raise ValueError(f"wandb:{address}: expected wandb:ENTITY/PROJECT/RUN, RUN is the run's id")
    check_installed(LoggerCfg(wandb=WandbCfg()))
    try:
        import wandb  # pyright: ignore[reportMissingImports]

        # Newest last.
        found = [
            entry for entry in wandb.Api().run(address).logged_artifacts() if entry.type == KIND
        ]
    except Exception as error:
        raise ValueError(f"wandb:{address}: {type(error).__name__}: {error}") from error
    if not found:
        raise ValueError(f"wandb:{address}: no checkpoint was uploaded: train with logger=wandb")
    # Before the download: names could lead out of the folder.
    for name in found[-1].manifest.entries:
        if not FILES.fullmatch(name):
            raise ValueError(f"wandb:{address}: {name!r} is no file of a run")
    # An address has slashes, a folder must not.
    target = folder / address.replace("/", "_")
    make_folder(target, below=folder)
    # Before, so that nothing is written through a link, and after, for links that came along.
    check_links(target, below=("checkpoint",))
    found[-1].download(root=str(target))
    check_links(target, below=("checkpoint",))
    note(f"wandb:{address}: copied to {target}")
    return target
