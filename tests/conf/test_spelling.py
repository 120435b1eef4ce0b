"""Flags and words of other programs' spelling."""

import pytest

from ksim_rl.conf import spelling


@pytest.mark.parametrize(
    ("flag", "arguments", "answer"),
    [
        ("--seed=3", (), "seed=3"),
        ("--seed", ("--seed", "3"), "seed=3"),
        ("--seed", ("--seed", "device=cpu"), "seed=VALUE"),
        ("-device", ("-device",), "device=VALUE"),
        ("--video_s=1", (), "trainer.video_s=1"),
    ],
)
def test_a_flag_is_answered_with_the_override(flag, arguments, answer):
    assert str(spelling.of_flag(flag, arguments)).endswith(
        f"fields are set without dashes: {answer}"
    )


def test_words_that_name_nothing_are_left_to_the_parser():
    assert spelling.of_word("zzz") is None
