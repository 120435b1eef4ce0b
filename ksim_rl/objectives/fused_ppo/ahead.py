"""This module compiles Triton kernels side by side before they are launched; one after another they take ten seconds.

Threads only compile: loading a kernel would break a CUDA graph that is being captured meanwhile.
"""

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextvars import copy_context
from typing import Any

import triton

from ksim_rl.objectives.fused_ppo.layout import only_compiles


class Ahead(ThreadPoolExecutor):
    """Threads that compile what `launch` is given in some work, of which it launches nothing."""

    def __init__(self) -> None:
        super().__init__()
        self._mode = triton.AsyncCompileMode(self)

    def add(self, work: Callable[[], object]) -> None:
        """Do `work`, and begin to compile what it would launch."""
        context = copy_context()
        context.run(only_compiles.set, True)
        context.run(self._mode.__enter__)  # whose exit waits
        context.run(work)

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Compile a kernel, and into Triton's cache the function in C that launches it."""
        driver: Any = triton.runtime.driver.active

        def compiled() -> Any:
            kernel = fn(*args, **kwargs)
            driver.launcher_cls(kernel.src, kernel.metadata)
            return kernel

        return super().submit(compiled)

    def wait(self) -> None:
        """Wait for all that was added, and raise what went wrong."""
        self._mode.__exit__(None, None, None)
        self.shutdown()
