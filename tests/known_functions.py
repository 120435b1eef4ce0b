"""Keeps what Warp found out about functions, which it would find out for each kernel that calls them.

Before a kernel is compiled or taken from the cache, Warp generates the code of all that it calls, to learn what its
static expressions are worth. That of the collisions of primitives takes seconds for each set of geoms, and tests have
many sets. Code that is compiled is generated as ever. Replaces `ModuleBuilder.build_function`, checked with Warp 1.19.
"""

import functools

from warp._src.context import Function, ModuleBuilder


def install() -> None:
    """Let the functions that a kernel calls be looked at once."""
    build = ModuleBuilder.build_function

    @functools.wraps(build)
    def build_unless_known(builder: ModuleBuilder, function: Function) -> None:
        # Without a target, nothing is compiled of what is generated.
        if builder.target is None and _is_known(function):
            _register(builder, function)
        else:
            build(builder, function)

    ModuleBuilder.build_function = build_unless_known


def _is_known(function: Function) -> bool:
    is_built = hasattr(function.adj, "called_user_functions")
    gives_a_known_type = function.value_func is not None
    return is_built and gives_a_known_type and not function.adj.has_unresolved_static_expressions


def _register(builder: ModuleBuilder, function: Function) -> None:
    """Note a function after all that it calls, in the order of a build."""
    if function in builder.functions:
        return
    for called in function.adj.called_user_functions:
        _register(builder, called)
    builder.functions[function] = None
