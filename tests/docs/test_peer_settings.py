"""The table of settings has medians of seeds, of the last run on a GPU."""

import pytest

from benchmarks.pages.peer_settings import UNKNOWN, text


def run(*, env_states_to_levels=None, seconds_to_levels=None, linear=1.6, angular=1.3):
    means = {"reward/track_linear_velocity": linear, "reward/track_angular_velocity": angular}
    levels = {"env_states_to_levels": env_states_to_levels, "seconds_to_levels": seconds_to_levels}
    return {"env_states": 4.0e7, "means": means, **levels}


@pytest.mark.parametrize("at_once", [1, 5])
def test_a_table_has_medians_and_says_where_a_level_was_not_reached(at_once):
    reached = [
        run(env_states_to_levels=states, seconds_to_levels=states / 1e6)
        for states in (3e7, 1e7, 2e7)
    ]
    never = [reached[0], run(linear=1.2, angular=0.9), run(linear=1.0, angular=0.8)]
    prefix, made = (
        "h200/go1_velocity_flat/4096",
        {"device": "NVIDIA H200", "command": "python -m it"},
    )
    saved = {
        "runs": {
            f"{prefix}/ours": {**made, "commit": "abcdef012", "date": "2"},
            f"{prefix}/all": {**made, "commit": "abcdef012", "date": "2"},
            "h100/go1_velocity_flat/4096/ours": {
                **made,
                "commit": "1",
                "date": "1",
                "device": "older",
            },
            "cpu/go1_velocity_flat/16/ours": {
                **made,
                "commit": "2",
                "date": "3",
                "device": "a CPU",
            },
        },
        "seeds": {
            f"{prefix}/{name}": {"at_once": at_once, "runs": dict(zip("123", found, strict=True))}
            for name, found in (("ours", reached), ("all", never))
        },
    }
    said = text(saved)
    for line in (
        "| ours | 3 of 3 | 20.0 million | 20.0 | 1.60 and 1.30 after 40 million |",
        "| all three, no TF32 | 1 of 3 |  |  | 1.20 and 0.90 after 40 million |",
        "| mjlab | one curve | 29.5 million | 192 | 1.39 and 1.20 after 29.5 million |",
    ):
        assert line in said.splitlines(), said
    assert "NVIDIA H200, commit abcdef0" in said and "older" not in said and "a CPU" not in said
    assert ("5 runs at a time" in said) == (at_once == 5)
    assert text({}) == text({"runs": {"cpu/go1_velocity_flat/16/ours": made}}) == UNKNOWN
