"""Keeps the code that Warp generated of functions, which it would generate again for each kernel that calls them.

Warp does so twice for a kernel with static expressions: to learn what these are worth, before it looks into its cache,
and to compile it. For the collisions of primitives it takes seconds each time, and tests have many sets of geoms. What
is compiled is the same text. Replaces `ModuleBuilder.build_function`, checked with Warp 1.19.
"""

import functools
from collections.abc import Mapping
from typing import Any

from warp._src.codegen import Adjoint, Struct, strip_reference
from warp._src.context import Function, ModuleBuilder
from warp._src.types import is_tile, is_tile_stack

# Of all options, these say nothing about the code of functions without tiles.
_OF_NO_MATTER = ("block_dim", "output_arch")


def install() -> None:
    """Let the code of functions be generated once for the same options."""
    build = ModuleBuilder.build_function
    options_of: dict[Adjoint, Mapping[str, Any]] = {}

    @functools.wraps(build)
    def build_unless_known(builder: ModuleBuilder, function: Function) -> None:
        options = {
            name: value for name, value in builder.options.items() if name not in _OF_NO_MATTER
        }
        if options_of.get(function.adj) == options and _is_plain(function):
            _register(builder, function)
            return
        build(builder, function)
        options_of[function.adj] = options

    ModuleBuilder.build_function = build_unless_known


def _is_plain(function: Function) -> bool:
    """Whether all that a module needs for a function is what `_register` gives it, for those that it calls, too."""
    adjoint = function.adj
    has_own_gradient = function.custom_grad_func or function.custom_replay_func
    if has_own_gradient or adjoint.has_unresolved_static_expressions:
        return False
    kinds = [strip_reference(variable.type) for variable in (*adjoint.variables, *adjoint.args)]
    if any(is_tile(kind) or is_tile_stack(kind) for kind in kinds):
        return False
    return all(_is_plain(called) for called in adjoint.called_user_functions)


def _register(builder: ModuleBuilder, function: Function) -> None:
    """Note a function after all that it calls, and its structs, as a build does."""
    if function in builder.functions:
        return
    adjoint = function.adj
    for called in adjoint.called_user_functions:
        _register(builder, called)
    for variable in (*adjoint.variables, *adjoint.args):
        kind = strip_reference(variable.type)
        # Arrays are of structs, too.
        for struct in (kind, getattr(kind, "dtype", None)):
            if isinstance(struct, Struct):
                builder.build_struct_recursive(struct)
        builder._collect_native_types(variable.type)
    builder.functions[function] = None
