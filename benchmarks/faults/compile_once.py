"""Compiles a function by one compiler, with its cache, and tells an error as the command does.

    python -m benchmarks.faults.compile_once torch
    python -m benchmarks.faults.compile_once triton

Needs no GPU: torch compiles for the CPU, and Triton for a GPU that need not be there.
"""

import importlib.util
import sys

import torch

from ksim_rl.cli.errors import report

WRONG = 4


def by_torch() -> int:
    """Compile a function as the library does on a GPU; return 0 where its values are right."""

    def work(x: torch.Tensor) -> torch.Tensor:
        return torch.tanh(x).sum(-1) * 2.0

    compiled = torch.compile(work, fullgraph=True, dynamic=False, options={"deterministic": True})
    x = torch.linspace(-1.0, 1.0, 32).view(4, 8)
    return 0 if torch.allclose(compiled(x), work(x)) else WRONG


def by_triton() -> int:
    """Compile a kernel for a GPU; return 0 where there is code for it."""
    from triton.backends.compiler import GPUTarget
    from triton.compiler import ASTSource, compile
    from triton.runtime import JITFunction

    from benchmarks.faults.triton_kernel import twice

    # The class, since the decorator gives an interpreter where the environment asks for one.
    source = ASTSource(
        fn=JITFunction(twice), signature={"x": "*fp32", "n": "constexpr"}, constexprs={(1,): 64}
    )
    kernel = compile(source, target=GPUTarget("cuda", 90, 32))
    return 0 if kernel.asm["ptx"] else WRONG


COMPILERS = {"torch": by_torch, "triton": by_triton}


def has_triton() -> bool:
    """Whether Triton is installed: it comes with torch for CUDA."""
    return importlib.util.find_spec("triton") is not None


def main() -> int:
    """Compile, and return the exit code."""
    try:
        return COMPILERS[sys.argv[1]]()
    except Exception as error:
        return report(error)


if __name__ == "__main__":
    sys.exit(main())
