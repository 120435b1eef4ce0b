"""Compiles Triton kernels in threads before they are needed."""

from collections.abc import Callable
from contextvars import copy_context
from typing import Any

import triton

from ksim_rl.objectives.fused_ppo.layout import only_compiles


class Ahead(triton.AsyncCompileMode):
    """Threads compile the kernels that some work launches; loading them, too, would break the capture of a graph."""

    def add(self, work: Callable[[], object]) -> None:
        """Do `work`, and begin to compile the kernels that it would launch."""
        context = copy_context()
        context.run(only_compiles.set, True)
        context.run(self.__enter__)  # whose exit waits
        context.run(work)

    def submit(
        self, key: str, compile_fn: Callable[[], Any], finalize_fn: Callable[[Any], None]
    ) -> Any:
        """Compile a kernel and its launcher, for which some versions of Triton start gcc."""
        driver: Any = triton.runtime.driver.active

        def compiled() -> Any:
            kernel = compile_fn()
            driver.launcher_cls(kernel.src, kernel.metadata)
            return kernel

        return super().submit(key, compiled, finalize_fn)

    def wait(self) -> None:
        """Wait for all that was added, and raise its errors."""
        self.__exit__(None, None, None)
