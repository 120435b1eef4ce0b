"""Triton kernels that are compiled ahead: they are not launched, and what goes wrong is raised."""

from concurrent.futures import ThreadPoolExecutor

import pytest

from ksim_rl.objectives.fused_ppo.layout import launch

triton = pytest.importorskip("triton", reason="Triton is not installed")


class Kernel:
    """What `launch` and Triton's own mode use of a kernel."""

    arg_names = ("x",)

    def __init__(self, events, *, fails=False):
        self.events, self.fails = events, fails
        self.src = self.metadata = self

    def __getitem__(self, grid):
        return lambda **given: self.events.append(("launched", grid, given["x"]))

    def warmup(self, *, grid, x, num_warps):
        mode = triton.runtime._async_compile.active_mode.get()
        mode.submit(
            id(self), self.compiled, lambda kernel: self.events.append(("compiled", grid, x))
        )

    def compiled(self):
        if self.fails:
            raise RuntimeError("no registers left")
        return self


@pytest.fixture
def ahead(monkeypatch):
    from ksim_rl.objectives.fused_ppo.ahead import Ahead

    class Driver:
        launchers: list = []
        launcher_cls = staticmethod(lambda src, metadata: Driver.launchers.append(src))

    monkeypatch.setattr(triton.runtime.driver, "_active", Driver())
    return Ahead(ThreadPoolExecutor())


def test_what_is_added_is_compiled_and_not_launched(ahead):
    events = []
    kernel = Kernel(events)
    ahead.add(lambda: launch(kernel, (2,), {"x": 1, "unread": 0}))
    launch(kernel, (3,), {"x": 2})
    ahead.wait()
    assert events == [("launched", (3,), 2), ("compiled", (2,), 1)]
    assert triton.runtime.driver.active.launchers == [kernel]


def test_errors_of_compilers_are_raised(ahead):
    ahead.add(lambda: launch(Kernel([], fails=True), (2,), {"x": 1}))
    for _ in range(2):
        with pytest.raises(RuntimeError, match="no registers left"):
            ahead.wait()
