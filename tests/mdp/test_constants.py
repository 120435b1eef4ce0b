import pytest
import torch

from ksim_rl.mdp.constants import constant, values_by_name

CPU = torch.device("cpu")


def test_equal_values_share_one_tensor():
    assert constant((1.0, 2.0), CPU) is constant([1.0, 2.0], CPU)
    assert constant((1.0, 2.0), CPU).tolist() == [1.0, 2.0]


def test_a_constant_made_in_inference_mode_is_a_plain_tensor():
    with torch.inference_mode():
        value = constant((0.125, 3.5), CPU)
    assert not value.is_inference()


def test_values_follow_the_names():
    table = {".*_hip": 1.0, "knee": 2.0}
    assert values_by_name("std", table, ["knee", "left_hip", "right_hip"]) == (2.0, 1.0, 1.0)


@pytest.mark.parametrize(
    "table", [{"hip": 1.0}, {".*": 1.0, "hip": 2.0}, {".*": 1.0, "ankle": 2.0}]
)
def test_each_name_needs_exactly_one_value(table):
    with pytest.raises(ValueError, match="std"):
        values_by_name("std", table, ["hip", "knee"])
