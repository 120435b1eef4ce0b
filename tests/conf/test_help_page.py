"""`ksim-rl train --help` says of each field of a run what it means, and completion knows them all."""

import dataclasses
import re

import pytest

from ksim_rl import conf
from ksim_rl.config.field_texts import attribute_texts, first_sentence


@dataclasses.dataclass(frozen=True, kw_only=True)
class Parent:
    """A parent.

    Attributes:
        shared, other: of both; and more.
            A second sentence.
    """

    shared: int = 1
    other: int = 2


@dataclasses.dataclass(frozen=True, kw_only=True)
class Child(Parent):
    """A child.

    Args:
        shared: its own.

    A last paragraph: with a colon.
    """

    shared: int = 3
    commented: float = 1.0  # m, at most
    # Of nothing.
    wrapped: float = 2.0  # of a line that is too long


def test_texts_come_from_docstrings_and_comments_and_children_count_more():
    assert attribute_texts(Child) == {
        "shared": "its own.",
        "other": "of both; and more. A second sentence.",
        "commented": "m, at most",
        "wrapped": "of a line that is too long",
    }
    assert first_sentence("Of both; and more. A second sentence.", 60) == "Of both; and more"
    assert first_sentence("one two three four", 13) == "one two ..."


def unexplained(value, path=""):
    """Yield the fields of a config that neither a docstring nor a comment explains."""
    texts = attribute_texts(type(value))
    for field in dataclasses.fields(value):
        inside = getattr(value, field.name)
        if dataclasses.is_dataclass(inside):
            yield from unexplained(inside, f"{path}{field.name}.")
        elif field.name not in texts:
            yield f"{path}{field.name}"


@pytest.mark.parametrize("objective", ["ppo", "fast_sac"])
def test_every_field_of_a_run_is_explained(objective):
    missing = list(unexplained(conf.compose([f"objective={objective}"])))
    assert not missing, (
        "say in the docstring's Attributes, or in a comment at the end of the line, what they mean"
    )


def test_the_page_has_values_and_texts_of_the_composed_config():
    page = conf.help_page(["task=walker_walk", "num_envs=16"])
    assert "\nnum_envs: 16  # parallel envs\n" in page
    assert re.search(r"\n  gamma: [\d.]+  # discount of a step\n", page)
    assert "\ntask:" in page and "walker" in page
    assert (
        "== Groups" in page
        and "\nobjective: amp, bc, distillation" in page
        and "--multirun" in page
    )
    with pytest.raises(ValueError, match="did you mean 'num_envs'"):
        conf.help_page(["num_env=17"])


def test_completions_have_choices_and_fields():
    words = conf.completions()
    assert {
        "task=go1_velocity_flat",
        "objective=ppo",
        "objective.gamma=",
        "trainer.num_iterations=",
    } <= set(words)
    assert "objective.target_entropy_per_action=" in words, (
        "of an algorithm that is not the default"
    )
    assert not any(" " in word or "_target_" in word for word in words)
