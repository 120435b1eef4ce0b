"""Cards: shares of what was earned as trained, the weakest condition, and no condition that is left out."""

import json
import math

import pytest

from ksim_rl.transfer.card import TransferCard
from ksim_rl.transfer.conditions import CONDITIONS
from ksim_rl.transfer.judge import Judged

NAMES = [condition.name for condition in CONDITIONS]


def judged(return_mean=10.0, upright=1.0):
    felt = {"effort": 0.5, "speed": 3.0, "power": 20.0, "jerk": 100.0, "impact": math.nan}
    return Judged(return_mean=return_mean, upright=upright, errors={"velocity_error": 0.1}, **felt)


def card(refused=(), **changed):
    found = {name: judged() for name in NAMES if name not in refused} | changed
    reasons = dict.fromkeys(refused, "its ground is no plane")
    how = {
        "episodes": 4,
        "seconds": 2.0,
        "trained": {"event push": "PushByVelocity()", "event legs": "A(joints='left|right')"},
    }
    return TransferCard(policy="zoo:x", task="a_task", judged=found, refused=reasons, **how)


def test_the_weakest_condition_is_named_with_its_share():
    worse = {"friction 0.3": judged(6.0, 0.9), "pushes of 0.8 m/s": judged(9.5, 0.25)}
    found = card(**worse)
    # Of return and upright episodes the lesser counts.
    assert found.share("friction 0.3") == pytest.approx(0.6)
    assert found.weakest == "pushes of 0.8 m/s" and found.share(found.weakest) == pytest.approx(
        0.25
    )
    assert "weakest under 'pushes of 0.8 m/s', which leaves 0.25" in found.verdict()
    assert f"{len(NAMES) - 2} of {len(NAMES)} conditions" in found.verdict()
    assert card(**{"friction 0.3": judged(-5.0)}).share("friction 0.3") == 0.0
    assert card(**{NAMES[0]: judged(0.0)}).share("friction 0.3") == 1.0


def test_no_condition_may_be_left_out():
    found = {name: judged() for name in NAMES[:-1]}
    with pytest.raises(ValueError, match=f"{NAMES[-1]}.*expected figures, or the reason"):
        TransferCard(
            policy="x", task="y", episodes=1, seconds=1.0, trained={}, judged=found, refused={}
        )


def test_the_page_and_the_numbers_have_every_condition(tmp_path):
    found = card(refused=("a slope of 5 degrees",))
    page = found.page()
    table, _, training = page.partition("What it has met in training:")
    assert "| event push | `PushByVelocity()` |" in training and "of 2 s at most" in table
    rows = [line for line in table.splitlines() if line.startswith("| ")]
    assert [row.split(" | ")[0].removeprefix("| ") for row in rows[1:]] == NAMES
    assert "cannot apply: its ground is no plane" in page and "1 cannot apply to a_task" in page
    assert len({row.count("|") for row in rows}) == 1
    # A bar in a regular expression ends no cell.
    assert r"| event legs | `A(joints='left\|right')` |" in training
    numbers = json.loads(found.numbers())
    assert numbers["judged"][NAMES[0]]["impact"] is None
    assert numbers["weakest"]["share"] == 1.0 and len(numbers["shares"]) == len(NAMES) - 1
    found.draw(tmp_path / "card.png")
    assert (tmp_path / "card.png").stat().st_size > 10_000
