"""What is compiled, and that the compiler leaves out what changes bits."""

import pytest
import torch

from ksim_rl.device.compiling import compiled


def _work(value):
    return value + 1.0


@pytest.mark.parametrize(("device", "wanted"), [("cpu", True), ("cuda", False)])
def test_work_is_itself_on_the_cpu_and_where_it_is_not_wanted(device, wanted):
    assert compiled(_work, device=torch.device(device), wanted=wanted) is _work


def test_the_compiler_knows_the_option_that_it_is_given(monkeypatch):
    given = {}
    monkeypatch.setattr(torch, "compile", lambda work, **options: given.update(options) or work)
    assert compiled(_work, device=torch.device("cuda")) is _work
    assert (
        given["fullgraph"]
        and given["dynamic"] is False
        and given["options"]["deterministic"] is True
    )
    assert set(given["options"]) <= set(torch._inductor.list_options())
