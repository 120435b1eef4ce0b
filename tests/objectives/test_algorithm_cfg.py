import pytest

from ksim_rl.objectives import PPOCfg


def test_defaults_are_valid_and_frozen():
    cfg = PPOCfg()
    with pytest.raises(AttributeError):
        cfg.gamma = 0.5  # type: ignore[misc]


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("num_epochs", 0),
        ("num_epochs", 2.5),
        ("max_skipped_steps", 0),
        ("advantage", "td"),
        ("rho_thresh", 0.0),
        ("c_thresh", -1.0),
        ("symmetry", "mirror"),
        ("symmetry_coeff", -0.5),
        ("gamma", 1.1),
        ("lmbda", -0.1),
        ("value_lmbda", 1.1),
        ("clip_epsilon", 0.0),
        ("clip_epsilon", 1.5),
        ("clip_value", -0.2),
        ("entropy_coeff", -1.0),
        ("critic_coeff", float("nan")),
        ("normalize_advantage", "data_set"),
        ("min_advantage_std", 0.0),
        ("learning_rate", 0.0),
        ("learning_rate", 1e-6),
        ("learning_rate", 0.02),
        ("schedule", "linear"),
        ("desired_kl", 0.0),
        ("max_grad_norm", 0.0),
        ("betas", (0.9, 1.0)),
        ("betas", (0.9,)),
        ("adam_eps", 0.0),
        ("weight_decay", -1.0),
        ("learning_rate_min", 1.0),
    ],
)
def test_refusals_name_the_field_and_the_value(field, value):
    with pytest.raises(ValueError, match=field) as error:
        PPOCfg(**{field: value})
    shown = value[-1] if isinstance(value, tuple) and len(value) == 2 else value
    assert str(shown) in str(error.value)


def test_a_bound_of_advantages_that_are_not_scaled_is_refused():
    with pytest.raises(
        ValueError, match=r"min_advantage_std=0\.02 does nothing with normalize_advantage='none'"
    ):
        PPOCfg(min_advantage_std=0.02, normalize_advantage="none")


def test_a_fixed_learning_rate_has_no_bounds():
    assert PPOCfg(learning_rate=0.5, schedule="fixed").learning_rate == 0.5


def test_vtrace_has_no_targets_of_another_lambda():
    assert PPOCfg(value_lmbda=1.0).value_lmbda == 1.0
    with pytest.raises(
        ValueError, match=r"value_lmbda=1\.0 with advantage='vtrace'.*use advantage='gae'"
    ):
        PPOCfg(value_lmbda=1.0, advantage="vtrace")
