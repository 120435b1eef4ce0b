"""Copies of rows on a GPU: any type, width and layout, in one kernel."""

import pytest
import torch

from ksim_rl.device.copying import copy_rows

E = 37


@pytest.mark.gpu
def test_copies_of_all_types_widths_and_layouts_are_exact():
    wide_EL = torch.randn(E, 70, device="cuda")
    given = [
        *(wide_EL, wide_EL[:, 3:20], wide_EL[:, 5], wide_EL[:, 1:1], wide_EL[:1].expand(E, 70)),
        *(wide_EL > 0, (wide_EL > 0)[:, 7:8], (wide_EL > 0)[:, 2], wide_EL.double()[:, :9]),
        *(torch.arange(E, device="cuda"), wide_EL.T.contiguous().T, wide_EL.bfloat16()[:, :3]),
        torch.randn(E, 4, 5, device="cuda")[:, 1:3],
    ]
    storage = [torch.zeros(3, *new.shape, dtype=new.dtype, device="cuda") for new in given]
    copy_rows([kept[1] for kept in storage], given)
    for kept, new in zip(storage, given, strict=True):
        assert torch.equal(kept[1], new)
        assert not kept[0].any() and not kept[2].any()


@pytest.mark.gpu
def test_it_is_one_kernel():
    given = [torch.randn(E, width, device="cuda") for width in range(1, 9)]
    to = [torch.zeros_like(new) for new in given]
    copy_rows(to, given)
    torch.cuda.synchronize()
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CUDA]) as recorded:
        copy_rows(to, given)
        torch.cuda.synchronize()
    assert (
        sum(event.count for event in recorded.key_averages() if event.self_device_time_total > 0)
        == 1
    )
