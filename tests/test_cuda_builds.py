"""Kernels compile for a GPU where there is none, as a GPU would get them: with its lanes, blocks and registers."""

import re

import pytest

from ksim_rl.device.quick_launch import ADDRESS, QuickLaunch, arguments_of
from tests import cuda_builds
from tests.absent_models import skipped_without_models

FEW = ("cartpole",)


@pytest.mark.parametrize(
    "name",
    [
        name if name in FEW else pytest.param(name, marks=pytest.mark.full)
        for name in cuda_builds.EVERYTHING
    ],
)
def test_all_kernels_compile_for_a_gpu(name):
    with skipped_without_models():
        builds = cuda_builds.builds_of(name)
    texts = [cuda_builds.ptx(build) for build in builds]
    assert all(".entry" in text for text in texts)
    if name != "rows":
        # Only on a GPU the lanes of a world wait for each other.
        assert any("bar.warp.sync" in text for text in texts)
    # Only on a GPU blocks say how many registers, in kernels that not every generated model takes.
    if name != "rows" and not name.startswith("generated"):
        assert any(".maxnreg" in text for text in texts)


def test_kernels_of_an_earlier_run_do_not_stay(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(cuda_builds, "builds_of", lambda name: ["one"])
    monkeypatch.setattr(cuda_builds, "ptx", lambda build: f"{build}\n")
    folder = tmp_path / "go1_of_many"
    folder.mkdir()
    (folder / "07.ptx").write_text("old\n")
    cuda_builds.main(["--out", str(tmp_path), "--of", "go1:many"])
    assert [path.name for path in folder.iterdir()] == ["00.ptx"]
    assert capsys.readouterr().out == "go1:many 0: 1 lines\n"


def test_equal_kernels_have_equal_text_whatever_their_names():
    fields = arguments_of((int, "slope"), (ADDRESS, "out"))

    def text_of(source: str) -> str:
        module, block_dim = QuickLaunch(fields, source, ("i", "lane")).loadable
        (kernel,) = module.kernels.values()
        argument = cuda_builds.argument_of(kernel)
        build = cuda_builds.Build(module=module, block_dim=block_dim, argument=argument)
        return cuda_builds.ptx(build)

    first = text_of("float* out = (float*)a.out; out[i] = out[i] * a.slope;")
    again = text_of("float* results = (float*)a.out; results[i] = results[i] * a.slope;")
    other = text_of("float* out = (float*)a.out; out[i] = out[i] + a.slope;")
    assert first == again != other
    assert re.search(r"ld.param.*slope", first) and re.search(r"ld.param.*out", first)
