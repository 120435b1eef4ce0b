"""`ksim-rl new` writes a package around a robot's model (robot, task, test and README), or a file with a task."""

import importlib.util
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from string import Template

from rich.pretty import pretty_repr

from ksim_rl import envs
from ksim_rl.checks import OneLineParser
from ksim_rl.cli.report import shown, shown_working
from ksim_rl.files.reading import MOST_MODEL_BYTES, read_bytes
from ksim_rl.files.writing import check_place, write_whole
from ksim_rl.physics import load_spec
from ksim_rl.scene.robots import analyse
from ksim_rl.scene.robots.analysis import TRIAL_S
from ksim_rl.scene.robots.strangers_model import robot_name
from ksim_rl.terminal import show

# Stands in the robot's `model` until its repr is replaced by the name MODEL.
MODEL = "@model@"


def new(arguments: list[str]) -> int:
    """Write what `arguments` name: a package around a robot, or a file with a task."""
    kinds: dict[str, Callable[[list[str]], int]] = {"robot": new_robot, "task": new_task}
    parser = OneLineParser(
        prog="ksim-rl new",
        description="Write a package around a robot's model, or a file with a task.",
    )
    parser.add_argument(
        "kind", choices=kinds, help="ksim-rl new robot --help and new task --help tell more"
    )
    # Each kind has its own arguments.
    options = parser.parse_args(arguments[:1])
    return kinds[options.kind](arguments[1:])


def new_task(arguments: list[str]) -> int:
    """Write a task with its robot, a term and its settings into one file."""
    parser = OneLineParser(
        prog="ksim-rl new task", description="Write a task that trains into one file."
    )
    parser.add_argument("name", metavar="NAME", help="of the task, and of the file NAME.py")
    parser.add_argument("--output", type=Path, help="the folder of the file; default: here")
    options = parser.parse_args(arguments)
    _check_name(options.name, options.name, field="NAME")
    check_place("--output", options.output, is_folder=True)
    file = (options.output or Path()) / f"{options.name}.py"
    if file.exists():
        raise ValueError(f"{file}: exists already; choose another name, or a folder with --output")
    file.parent.mkdir(parents=True, exist_ok=True)
    write_whole(file, _text("task.py", {"name": options.name}))
    show(shown(file))
    show(f"next, where the file is: ksim-rl train --plugin {options.name} task={options.name}")
    return 0


def new_robot(arguments: list[str]) -> int:
    """Write the package; the code is 1 for a robot that does not stand."""
    parser = OneLineParser(
        prog="ksim-rl new robot", description="Write a package around a robot's model."
    )
    parser.add_argument(
        "model", metavar="PATH", help="an MJCF or URDF file, or a menagerie name: unitree_a1/a1"
    )
    parser.add_argument(
        "--pose",
        metavar="NAME",
        help='the keyframe to stand in, or "qpos0"; default: the first that stands',
    )
    parser.add_argument(
        "--drop",
        metavar="BODY",
        action="append",
        default=[],
        help="leave a body out, such as a prop; repeatable",
    )
    parser.add_argument("--name", help="of the package; default: the model's name")
    parser.add_argument(
        "--output", type=Path, help="the new folder; default: the package's name, here"
    )
    options = parser.parse_args(arguments)
    check_place("--output", options.output, is_folder=True)
    name = options.name or robot_name(options.model)
    folder = options.output or Path(name)
    task = f"{name}_velocity_flat"
    _check_name(name, task)
    # Before the analysis, which takes longer: never write into a folder that exists.
    if folder.exists():
        raise ValueError(f"{folder}: exists already; choose another folder with --output")
    with shown_working(f"analysing {options.model}"):
        found = analyse(options.model, pose=options.pose, drop=options.drop)
    robot = replace(found.robot, name=name, model=MODEL)
    # Standing through the whole trial; else the package has no test that asks for it.
    stands = found.stands_s >= TRIAL_S
    model = Path(options.model).expanduser()
    is_file = model.exists()
    # The package finds its copy of the model wherever it is installed.
    path = f'str(files("{name}").joinpath("{name}.xml"))'
    words = {
        "name": name,
        "task": task,
        "mass": f"{found.mass:.2f}",
        "height": f"{found.height:.2f}",
        "joints": len(robot.joint_names),
        "feet": ", ".join(found.foot_bodies),
        "model": path if is_file else repr(options.model),
        "robot": pretty_repr(robot, max_width=110).replace(repr(MODEL), "MODEL"),
        "stands": f"With zero actions it stands for {found.stands_s:g} s"
        + (", as long as it was watched." if stands else " only: see to gains and stance first."),
        "and_stands": ", and it stands" if stands else "",
    }
    # Paths of the package, and their texts from templates of `new_robot`.
    texts = {
        "pyproject.toml": _text("pyproject.toml", words),
        "README.md": _text("README.md", words),
        f"{name}/__init__.py": _text("package.py", words),
        f"{name}/robot.py": _text(
            "robot.py", words, "from importlib.resources import files\n" if is_file else ""
        ),
        f"{name}/tasks.py": _text("tasks.py", words),
        # A test of standing is written only for a robot that does.
        f"tests/test_{name}.py": _text("test.py", words, "import torch\n" if stands else "")
        + (_text("test_stands.py", words) if stands else ""),
    }
    for file, text in texts.items():
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        write_whole(folder / file, text)
    if is_file:
        copy_model(model, folder / name / f"{name}.xml")
    for file in sorted(path for path in folder.rglob("*") if path.is_file()):
        show(shown(file))
    show(f"next: cd {shown(folder)}; its README.md has the commands")
    return 0 if stands else 1


def copy_model(source: Path, target: Path) -> None:
    """Write a model as one MJCF file, with the meshes, textures and height fields it names, in `assets`."""
    spec = load_spec(source)
    # Files that the model names, with the folder that they are relative to.
    assets = [
        (spec.meshdir, entry) for entry in (*spec.meshes, *spec.hfields, *spec.skins) if entry.file
    ]
    assets += [(spec.texturedir, entry) for entry in spec.textures if entry.file]
    names: dict[Path, str] = {}
    for folder, entry in assets:
        (target.parent / "assets").mkdir(exist_ok=True)
        asset = source.resolve().parent / folder / entry.file
        if asset not in names:
            # Two folders may have a file of one name each.
            if asset.name not in names.values():
                names[asset] = asset.name
            else:
                names[asset] = f"{len(names)}_{asset.name}"
        entry.file = names[asset]
        shutil.copy(asset, target.parent / "assets" / entry.file)
    # A model without files is copied as it is; written by MuJoCo it would lose its comments.
    if not assets and source.suffix == ".xml" and "<include" not in _read(source):
        shutil.copyfile(source, target)  # with its comments
        return
    # MuJoCo writes only what it has compiled, and checks the copied files by it.
    spec.meshdir = spec.texturedir = "assets"
    spec.modelfiledir = str(target.parent)
    spec.compile()
    write_whole(target, spec.to_xml())


def _read(model: Path) -> str:
    return read_bytes(model, limit=MOST_MODEL_BYTES, follows_links=True).decode(errors="replace")


def _text(name: str, words: dict[str, object], imports: str = "") -> str:
    template = files("ksim_rl.cli").joinpath("new_robot", f"{name}.txt").read_text()
    # A template without imports leaves two blank lines too many.
    return Template(template).substitute(words, imports=imports).replace('"""\n\n\n', '"""\n\n')


def _check_name(name: str, task: str, *, field: str = "--name") -> None:
    if not re.fullmatch(r"[a-z]\w*", name, re.ASCII):
        raise ValueError(
            f"{field} {name}: expected a name for a Python package: small letters, digits and _"
        )
    if task in envs.names():
        raise ValueError(f"{field} {name}: there is a task {task!r} already; choose another name")
    # A name that shadows an installed package would import the wrong one.
    if importlib.util.find_spec(name) is not None:
        raise ValueError(
            f"{field} {name}: a Python package of this name is installed already; choose another name"
        )
