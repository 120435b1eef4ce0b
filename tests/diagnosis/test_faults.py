"""Each check finds the fault that a run was sabotaged with, and only that; healthy runs have none."""

import pytest

from ksim_rl.diagnosis import faults
from ksim_rl.diagnosis.curves import Curves
from ksim_rl.diagnosis.diagnose import findings
from tests.diagnosis.recorded_runs import of_the_gpu, recorded


def names(curves):
    return [finding.name for finding in findings(curves)]


def test_every_check_has_a_run_that_was_sabotaged_for_it():
    assert sorted(recorded("faults")) == sorted(fault.__name__ for fault in faults.FAULTS)


@pytest.mark.parametrize("name", [fault.__name__ for fault in faults.FAULTS])
def test_a_check_finds_its_fault_and_no_other_does(name):
    assert names(recorded("faults")[name]) == [name]


def test_healthy_runs_have_no_fault():
    runs = recorded("healthy") | of_the_gpu()
    assert len(recorded("healthy")) >= 15 and len(runs) >= 25
    assert {name: found for name, run in runs.items() if (found := names(run))} == {}


def test_what_a_run_does_not_log_is_not_judged():
    assert findings(Curves(columns={"env_states": [float(row) for row in range(50)]})) == []


def test_too_few_rows_say_nothing():
    curves = recorded("faults")["std_at_floor"]
    assert (
        names(Curves(columns={name: column[:5] for name, column in curves.columns.items()})) == []
    )


def test_values_that_are_not_finite_do_not_count():
    columns = {
        "policy/std": [1e-4] * 20 + [float("nan")] * 20,
        "update/kl": [None] * 20 + [float("inf")] * 20,
    }
    assert names(Curves(columns=columns)) == ["std_at_floor"]


def test_the_entropy_of_choices_collapses_towards_zero_and_that_of_densities_may_be_anything():
    def with_entropy(last):
        return Curves(columns={"loss/entropy": [1.0] * 10 + [last] * 10})

    assert names(with_entropy(0.02)) == ["entropy_collapsed"]
    assert names(with_entropy(0.5)) == names(with_entropy(-3.0)) == []


def test_the_bound_of_the_std_is_that_of_the_actor():
    columns = {"policy/std": [0.01] * 20}
    squashed = {"modules": {"actor": {"log_std_min": -5.0}}}  # exp(-5) = 0.0067
    assert names(Curves(columns=columns)) == []
    assert names(Curves(columns=columns, config=squashed)) == ["std_at_floor"]


def test_the_desired_kl_is_that_of_the_run():
    columns = {"update/kl": [0.2] * 20}
    assert names(Curves(columns=columns)) == ["kl_far_off"]
    assert names(Curves(columns=columns, config={"objective": {"desired_kl": 0.1}})) == []


def test_a_finding_names_figures_reason_and_change():
    (finding,) = findings(recorded("faults")["episodes_end_at_once"])
    assert "fell_over" in finding.seen and "steps" in finding.seen
    assert finding.reason and finding.change.startswith("Loosen the termination")


def test_every_check_says_what_to_change():
    for fault in faults.FAULTS:
        reason, _, change = (fault.__doc__ or "").partition("\n\n")
        assert reason.strip() and change.strip(), fault.__name__


def test_values_that_few_rows_have_are_early_and_late_by_themselves():
    every_tenth = [float(row) if row % 10 == 0 else None for row in range(100)]
    curves = Curves(
        columns={"evaluation/return": every_tenth, "iteration": [float(row) for row in range(100)]}
    )
    assert (curves.early("evaluation/return"), curves.late("evaluation/return")) == (10.0, 80.0)
    assert (curves.early("iteration"), curves.late("iteration")) == (9.5, 89.5)
