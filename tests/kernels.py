"""Finds the kernels of the package, and has for each the test that compares its bits.

Kernels are Triton functions that are launched, Warp's, and what `QuickLaunch`, `launch_of` and `launcher_of` make of
C++, by the function that makes them or the name that they get. Tests compare their bits between equal runs, between
numbers of lanes, or with the value that they must come to; tests in tests/gpu run where there is a GPU.
"""

import ast
from collections.abc import Iterator

from tests.docs.guide import REPOSITORY

MAKERS = ("QuickLaunch", "launch_of", "launcher_of")
EQUAL_WORLDS = "gpu/test_repeatability.py::test_equal_worlds_stay_equal_bit_for_bit"
CAPTURED_STEPS = "gpu/test_fused_ppo.py::test_captured_steps_are_the_eager_ones_bit_for_bit"
LAYERS = "gpu/test_off_policy.py::test_layers_in_half_precision_err_as_torch_does"
SINGLE_MODELS = "gpu/test_repeatability.py::test_kernels_of_single_models_give_the_same_bits_again"

TESTS = {
    "compiled/tape.py": {
        "_compiled": "compiled/test_lanes.py::test_lanes_give_what_one_thread_gives"
    },
    "device/copying.py": {
        "_launcher": "gpu/test_copying.py::test_copies_of_all_types_widths_and_layouts_are_exact"
    },
    "device/native_kernel.py": {"kernel": EQUAL_WORLDS},
    "device/quick_launch.py": {"launch_of": EQUAL_WORLDS},
    "device/random.py": {
        "_launch": "gpu/test_transforms.py::test_draws_are_the_hash_that_they_say_they_are"
    },
    "ranks/running_moments.py": {
        "_quick": (
            "gpu/test_repeatability.py::"
            "test_moments_of_equal_rows_are_equal_and_those_of_two_passes_in_float64"
        )
    },
    "envs/non_finite.py": {"_quick": EQUAL_WORLDS},
    "mdp/randomization/drawing.py": {"_quick": EQUAL_WORLDS},
    "modules/norm_kernels.py": {
        "normalize_rows": LAYERS,
        "normalize_rows_back": LAYERS,
        "sum_parts": LAYERS,
    },
    "objectives/distribution_kernel.py": {
        "compare_rows": (
            "gpu/test_off_policy.py::"
            "test_distributions_are_compared_as_on_the_cpu_with_the_same_bits_each_time"
        )
    },
    "objectives/fused_ppo/dataset_kernels.py": {
        "read_observations": CAPTURED_STEPS,
        "write_records": CAPTURED_STEPS,
    },
    "objectives/fused_ppo/layer_kernels.py": {
        "layer": CAPTURED_STEPS,
        "output_gradients": CAPTURED_STEPS,
    },
    "objectives/fused_ppo/loss_kernels.py": {"estimate_advantages": CAPTURED_STEPS},
    "objectives/fused_ppo/mlp_kernels.py": {
        "lower_gradients": CAPTURED_STEPS,
        "minibatch_gradients": CAPTURED_STEPS,
        "network_outputs": CAPTURED_STEPS,
        "weight_gradients": CAPTURED_STEPS,
    },
    "objectives/fused_ppo/step_kernels.py": {
        "adam_step": CAPTURED_STEPS,
        "mean_steps": CAPTURED_STEPS,
        "sum_gradients": CAPTURED_STEPS,
        "take_means": "ranks/test_fused_ranks.py::test_fused_updates_of_two_ranks_equal_those_of_torch",
    },
    "physics/actuators/adhesion.py": {
        "_gather_moments": SINGLE_MODELS,
        "_hide_rowless": SINGLE_MODELS,
        "_scatter_moments": SINGLE_MODELS,
    },
    "physics/collision/box_distances.py": {
        "forget_touching_boxes": SINGLE_MODELS,
        "measure_boxes": SINGLE_MODELS,
    },
    "physics/collision/collisions.py": {"collisions": EQUAL_WORLDS},
    "physics/constants/constant_kernels.py": {
        "constants_at_qpos0": EQUAL_WORLDS,
        "frames": EQUAL_WORLDS,
        "mend_weights": SINGLE_MODELS,
    },
    "physics/fixed_geoms.py": {"place_fixed_geoms": SINGLE_MODELS},
    "physics/sensors/contact_sensors.py": {"__init__": EQUAL_WORLDS},
    "physics/constants/least_weights.py": {"raise_weights": SINGLE_MODELS},
    "physics/height_field/contacts.py": {
        "height_field_contacts": EQUAL_WORLDS,
        "list_near_pairs": EQUAL_WORLDS,
    },
    "physics/height_field/convex_contacts.py": {"convex_height_field_contacts": SINGLE_MODELS},
    "physics/kernels.py": {
        "align_steep_capsules": SINGLE_MODELS,
        "copy_columns": SINGLE_MODELS,
        "drop_upper_corners": SINGLE_MODELS,
        "gather_controls": SINGLE_MODELS,
        "leave_out_rows": SINGLE_MODELS,
        "loosen_rowless": SINGLE_MODELS,
        "rate_exact_filters": SINGLE_MODELS,
        "shifted_time": SINGLE_MODELS,
        "sparse_velocity": SINGLE_MODELS,
        "spread_columns": SINGLE_MODELS,
        "take_the_law_of_priority": SINGLE_MODELS,
    },
    "physics/nan_guard/guard.py": {"keep_rows": EQUAL_WORLDS, "mark_failed": EQUAL_WORLDS},
    "physics/native.py": {"kernel": EQUAL_WORLDS},
    "physics/newton/kernel.py": {"launcher": EQUAL_WORLDS, "sort_worlds": EQUAL_WORLDS},
    "physics/overflow.py": {"__init__": EQUAL_WORLDS},
    "physics/constants/principal_axes.py": {"_diagonalize": EQUAL_WORLDS},
    "physics/resets.py": {"empty_contacts": EQUAL_WORLDS, "fill_rows": EQUAL_WORLDS},
    "physics/rows/constraint_rows.py": {
        "constraint_rows": (
            "gpu/test_constraint_rows.py::test_all_numbers_of_lanes_and_places_in_the_pool_give_the_same_bits"
        )
    },
    "physics/rows/idle_ties.py": {"still_ties": SINGLE_MODELS},
    "physics/rows/second_limits.py": {"add_second_limits": SINGLE_MODELS},
    "physics/rows/tie_counts.py": {"count_fitting_ties": SINGLE_MODELS},
    "physics/rows/tie_weights.py": {"weigh_ties": SINGLE_MODELS},
    "physics/rows/contact_lists.py": {"__init__": EQUAL_WORLDS},
    "physics/sensors/sensor_mending.py": {
        "_reading_of": SINGLE_MODELS,
        "bound_touch": SINGLE_MODELS,
    },
    "physics/sensors/limit_sensors.py": {
        "_read_forces": SINGLE_MODELS,
        "_read_state": SINGLE_MODELS,
    },
    "physics/smooth/stages.py": {
        "_launcher": (
            "gpu/test_smooth.py::test_all_numbers_of_lanes_give_the_same_bits_which_are_those_of_mujoco_warp"
        )
    },
    "transforms/noise/kernel.py": {"_quick": EQUAL_WORLDS},
    "transforms/ring.py": {
        "_quick": "gpu/test_transforms.py::test_rings_of_any_dtype_and_width_give_back_what_was_pushed"
    },
    "transforms/tally.py": {"_quick_tally": "gpu/test_transforms.py::test_tallies"},
}
"""By file of the package and name of the kernel: the file of the test, and its name."""


def kernels(sources: dict[str, str]) -> set[tuple[str, str]]:
    """Return file and name of each kernel in the sources, by file."""
    trees = {name: ast.parse(source) for name, source in sources.items()}
    launched = {
        name for tree in trees.values() for node in ast.walk(tree) for name in _launched(node)
    }
    return {(file, name) for file, tree in trees.items() for name in _kernels(tree, launched)}


def _launched(node: ast.AST) -> Iterator[str]:
    if isinstance(node, ast.Subscript) and isinstance(node.value, ast.Name):
        yield node.value.id  # kernel[grid](...)
    if isinstance(node, ast.Call) and ast.unparse(node.func) == "launch":
        yield from (own.id for own in node.args[:1] if isinstance(own, ast.Name))


def _kernels(tree: ast.Module, launched: set[str]) -> Iterator[str]:
    def visit(node: ast.AST, keeper: str) -> Iterator[str]:
        if isinstance(node, ast.Assign):
            keeper = keeper or ast.unparse(node.targets[0])
        if isinstance(node, ast.FunctionDef):
            keeper = node.name
            marks = [ast.unparse(mark) for mark in node.decorator_list]
            if any(mark.startswith("wp.kernel") for mark in marks):
                yield node.name
            if any(mark.startswith("triton.jit") for mark in marks) and node.name in launched:
                yield node.name
        if isinstance(node, ast.Call) and ast.unparse(node.func).split(".")[-1] in MAKERS:
            yield keeper
        for child in ast.iter_child_nodes(node):
            yield from visit(child, keeper)

    return visit(tree, "")


def compares_bits(test: str) -> bool:
    """Whether a test exists and says, itself or in what it calls of its file, that something is equal bit for bit."""
    path, _, name = test.partition("::")
    file = REPOSITORY / "tests" / path
    if not file.exists():
        return False
    functions = {
        node.name: node
        for node in ast.parse(file.read_text()).body
        if isinstance(node, ast.FunctionDef)
    }
    if name not in functions:
        return False
    called = {
        own.id for own in ast.walk(functions[name]) if isinstance(own, ast.Name)
    } & functions.keys()
    text = "".join(ast.unparse(functions[own]) for own in {name, *called})
    return any(
        word in text for word in ("equal(", "torch.equal", "== expected", "first_difference(")
    )
