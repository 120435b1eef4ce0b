"""Configs built in Python are checked like a command line: a wrong value is a ValueError that names its field."""

import pytest

from ksim_rl import checked
from tests import wrong_configs


@pytest.mark.full
def test_each_wrong_value_of_each_field_is_refused_by_name():
    figures = wrong_configs.figures()
    assert figures["tries"] > 10_000 and figures["fields"] > 500
    assert figures["other_errors"] == []
    assert figures["unnamed"] == []
    assert figures["taken"] == []


def test_fields_that_once_gave_other_errors_are_refused_by_name():
    names = {"betas", "hidden_dims", "in_keys", "stop_at", "bias"}
    seen = set()
    for kind, name, value, error in wrong_configs.tries(only=names):
        assert error is None or (isinstance(error, ValueError) and name in str(error)), (
            kind,
            name,
            value,
        )
        seen.add(name)
    assert seen == names


def test_the_figures_tell_what_is_not_checked(monkeypatch):
    monkeypatch.setattr(checked, "check_value", lambda *given: None)
    figures = wrong_configs.figures(only={"betas", "in_keys", "require_graphs"})
    assert figures["other_errors"] and figures["taken"]
