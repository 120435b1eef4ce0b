"""Graphs lay their temporaries in the same memory, and none disturbs another."""

import pytest
import torch

from ksim_rl.device.capture import Captured

SIZE = 2**24
BYTES = 4 * SIZE


def squares(kept, first):
    """Return a body that adds up in `kept` what it makes of temporaries of 64 MiB each."""

    def body() -> None:
        numbers = torch.arange(SIZE, device="cuda", dtype=torch.float32).remainder_(7.0).add_(first)
        kept.add_((numbers * numbers).mean())

    return body


@pytest.mark.gpu
def test_a_second_graph_takes_no_further_memory_and_both_stay_right():
    kept, reserved = torch.zeros(2, device="cuda"), []
    graphs = [
        Captured(squares(kept[i], float(i)), device="cuda", require_graphs=True) for i in range(2)
    ]
    for graph in graphs:
        for _ in range(3):
            graph()
        torch.cuda.synchronize()
        torch.cuda.empty_cache()
        reserved.append(torch.cuda.memory_reserved())
    assert all(graph.ready for graph in graphs)
    assert reserved[1] - reserved[0] < BYTES
    for _ in range(3):
        for graph in graphs:
            graph()
    expected = [6 * sum((n + i) ** 2 for n in range(7)) / 7 for i in range(2)]
    torch.testing.assert_close(kept.cpu(), torch.tensor(expected), rtol=1e-3, atol=0.0)


@pytest.mark.gpu
def test_what_something_refers_to_is_left_alone():
    made = {}

    def make() -> None:
        made["ones"] = torch.ones(SIZE, device="cuda")

    def overwrite() -> None:
        made["total"] = torch.full((SIZE,), 3.0, device="cuda").sum()

    one, other = (Captured(body, device="cuda", require_graphs=True) for body in (make, overwrite))
    for graph in (one, other):
        for _ in range(3):
            graph()
    one()
    other()
    assert torch.equal(made["ones"], torch.ones(SIZE, device="cuda"))
    assert made["total"].item() == 3.0 * SIZE


@pytest.mark.gpu
def test_a_graph_that_is_gone_leaves_its_memory_to_the_others():
    kept = torch.zeros(2, device="cuda")
    for _ in range(2):
        graphs = [
            Captured(squares(kept[i], 0.0), device="cuda", require_graphs=True) for i in range(2)
        ]
        for graph in graphs:
            for _ in range(4):
                graph()
        del graphs[0], graph
        graphs[0]()
        del graphs
    assert kept.tolist() == pytest.approx([8 * 13.0, 10 * 13.0], rel=1e-3)
