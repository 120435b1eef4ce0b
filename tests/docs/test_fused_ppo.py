"""The derivation in docs/fused_ppo.md holds."""

import re
from pathlib import Path

import pytest

PAGE = (Path(__file__).parents[2] / "docs" / "fused_ppo.md").read_text()
(CHECK,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)


def run(code: str) -> None:
    exec(compile(code, "docs/fused_ppo.md", "exec"), {})  # noqa: S102


def test_the_closed_forms_are_the_gradients():
    run(CHECK)


@pytest.mark.parametrize(
    ("right", "wrong"),
    [
        ("error_BA**2 - 1", "error_BA**2 + 1"),
        ("inside_B | smaller_B", "inside_B"),
        ("near_B | larger_B", "near_B"),
        ("- entropy_coeff * mask_B[:, None]", "- 0.0 * mask_B[:, None]"),
    ],
)
def test_a_wrong_formula_is_found(right, wrong):
    assert CHECK.count(right) == 1
    with pytest.raises(AssertionError):
        run(CHECK.replace(right, wrong))
