"""What is installed elsewhere is whole: sdist -> wheel -> another folder -> import."""

import os
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.version import Version

import ksim_rl

ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """Build the sdist, and from it the wheel, without network."""
    folder = tmp_path_factory.mktemp("dist")
    command = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(folder), str(ROOT)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    (sdist,), (wheel,) = folder.glob("*.tar.gz"), folder.glob("*.whl")
    return sdist, wheel


def sources(folder, suffixes=(".py", ".yaml", ".xml", ".json", ".onnx", ".safetensors")):
    return {
        path.relative_to(ROOT).as_posix()
        for path in (ROOT / folder).rglob("*")
        if path.suffix in suffixes and path.is_file() and "__pycache__" not in path.parts
    }


def test_the_sdist_has_the_package_the_tests_and_what_builds_them(built):
    with tarfile.open(built[0]) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    assert sources("ksim_rl") <= names
    assert sources("tests", (".py",)) | sources("docs", (".md", ".png")) <= names
    assert {
        "README.md",
        "CHANGELOG.md",
        "CONTRIBUTING.md",
        "LICENSE",
        "Makefile",
        "constraints.txt",
        "constraints-oldest.txt",
        "pyproject.toml",
    } <= names
    assert not [
        name for name in names if name.split("/")[0] in ("envs", "objectives", ".venv", "runs")
    ]


def test_the_wheel_that_is_built_from_the_sdist_has_every_source_and_data_file(built):
    with zipfile.ZipFile(built[1]) as archive:
        names = {name for name in archive.namelist() if ".dist-info/" not in name}
    assert names >= sources("ksim_rl")
    assert {name.split("/")[0] for name in names} == {"ksim_rl"}


IMPORT_ALL = """
import importlib, pathlib, sys
import ksim_rl
here = pathlib.Path(ksim_rl.__file__).parent
assert str(here).startswith(sys.argv[1]), here
for path in sorted(here.rglob("*.py")):
    parts = path.relative_to(here.parent).with_suffix("").parts
    importlib.import_module(".".join(parts[:-1] if parts[-1] == "__init__" else parts))
from ksim_rl import conf, envs
assert len(envs.names()) >= 2
for name in envs.names():
    if not envs.task(name).suite or name.endswith("_cartpole_balance"):
        conf.compose([f"task={name}"])
assert list(here.rglob("*.xml"))
print(ksim_rl.__version__)
"""


@pytest.mark.full
def test_an_installed_wheel_imports_from_elsewhere(built, tmp_path):
    target = tmp_path / "site"
    install = [
        sys.executable,
        "-m",
        "pip",
        "install",
        "--quiet",
        "--no-deps",
        "--no-index",
        "--target",
        str(target),
    ]
    subprocess.run([*install, str(built[1])], check=True)
    environment = {**os.environ, "PYTHONPATH": str(target)}
    command = [sys.executable, "-P", "-c", IMPORT_ALL, str(target)]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == ksim_rl.__version__
    assert built[1].name.startswith(f"ksim_rl-{ksim_rl.__version__}-")
    assert (target / "bin" / "ksim-rl").exists()


def test_the_links_at_the_root_lead_into_the_package():
    for name in ("envs", "objectives"):
        assert (ROOT / name).is_symlink()
        assert (ROOT / name).resolve() == (ROOT / "ksim_rl" / name).resolve()


def test_each_dependency_is_pinned_for_the_tested_environment():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    wanted = [*project["dependencies"], *project["optional-dependencies"]["dev"]]
    names = {entry.split("[")[0].split(">")[0].split("<")[0].strip().lower() for entry in wanted}
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pinned = {line.split("==")[0].lower() for line in lines if "==" in line}
    assert names <= pinned
    assert not [line for line in lines if "/" in line or "@" in line or "+" in line]


def test_the_oldest_versions_that_are_tried_are_the_lower_bounds():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    integrations = {entry for name, entries in extras.items() if name != "dev" for entry in entries}
    wanted = [
        Requirement(entry)
        for entry in {*project["dependencies"], *(integrations & set(extras["dev"]))}
    ]
    lows = {
        each.name: part.version
        for each in wanted
        for part in each.specifier
        if part.operator == ">="
    }
    lines = (ROOT / "constraints-oldest.txt").read_text().splitlines()
    pinned = dict(line.split("==") for line in lines if not line.startswith("#"))
    assert {name: Version(low) for name, low in lows.items()} == {
        name: Version(version) for name, version in pinned.items()
    }


def test_the_citation_is_of_this_version():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["version"] == ksim_rl.__version__
    assert {"cff-version", "title", "message", "authors"} <= citation.keys()


@pytest.mark.skipif(
    shutil.which("hadolint") is None, reason="hadolint has no wheel for this platform"
)
def test_the_image_is_written_as_docker_recommends():
    done = subprocess.run(["hadolint", ROOT / "Dockerfile"], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout
    copied = re.findall(r"^COPY (.*) \S+$", (ROOT / "Dockerfile").read_text(), re.MULTILINE)
    assert all((ROOT / name).exists() for names in copied for name in names.split())


def test_the_changelog_begins_with_this_version():
    versions = re.findall(r"^## (\S+)", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert versions[0] == ksim_rl.__version__ and versions[-1] == "0.1.0"


def test_the_workflow_and_the_hooks_run_what_make_runs():
    """Without these pages' YAML being read by GitHub and pre-commit themselves: their commands are there."""
    jobs = yaml.safe_load((ROOT / ".github" / "workflows" / "ci.yml").read_text())["jobs"]
    commands = [step.get("run", "") for job in jobs.values() for step in job["steps"]]
    assert ".ci/run" in commands and os.access(ROOT / ".ci" / "run", os.X_OK)
    (bounds,) = yaml.safe_load((ROOT / ".github" / "workflows" / "versions.yml").read_text())[
        "jobs"
    ].values()
    tried = {f"test-{each['versions']}" for each in bounds["strategy"]["matrix"]["include"]}
    assert f"{' '.join(sorted(tried, reverse=True))}: test-%:" in (ROOT / "Makefile").read_text()
    assert bounds["steps"][-1]["run"].startswith("make test-${{ matrix.versions }}")
    (local,) = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())["repos"]
    makefile = (ROOT / "Makefile").read_text()
    for hook in local["hooks"]:
        tool = hook["entry"].removeprefix(".venv/bin/").split(" --force")[0]
        assert tool.split()[0] in makefile, hook
