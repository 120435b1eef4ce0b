"""Strangers are not let in by the ports of the viewer, and what no page says is ignored and counted."""

import pytest

pytest.importorskip("viser", reason="viser is not installed (the extra `viewer`)")
import websockets.asyncio.server

from ksim_rl.viewer import guarded_server
from ksim_rl.viewer.gate import MOST_CLIENTS, Gate, check_listens
from ksim_rl.viewer.session import MOST_REQUESTS
from tests.viewer.strange_clients import (
    answer,
    let_in,
    not_ignored,
    page_of,
    pushes,
    until,
    viewed,
    waiting_after_a_flood,
    widgets,
)


@pytest.fixture(scope="module")
def served():
    with viewed(18350) as found:
        yield found


def test_strangers_are_not_let_in(served):
    assert let_in(served[0]) == []


def test_the_pages_of_the_printed_addresses_are(served):
    viewer, _ = served
    for address in (viewer.address, viewer.pad_address):
        for origin in (None, "http://HOST"):
            for websocket, status in ((False, 200), (True, 101)):
                found = answer(
                    address, host="HOST", origin=origin, path="/TOKEN", websocket=websocket
                )
                assert found == status


def test_what_no_page_sends_is_ignored_and_counted(served):
    assert not_ignored(served[0]) == []


def test_numbers_are_clamped_to_what_the_control_allows(served):
    viewer, session = served
    assert pushes(viewer, session, [1.5, 1e9, -1e9, 2]) == [1.5, 3.0, 0.1, 2.0]


def test_requests_that_nobody_takes_are_few(served):
    viewer, session = served
    assert waiting_after_a_flood(viewer, session, messages=5000) <= MOST_REQUESTS


def test_more_pages_than_anybody_looks_at_are_closed(served):
    viewer, _ = served
    for address in (viewer.address, viewer.pad_address):
        links = [page_of(address) for _ in range(MOST_CLIENTS + 1)]
        assert until(lambda links=links: any(link.close_code == 1013 for link in links))
        for link in links:
            link.close()
    assert until(lambda: can_look(viewer))


def can_look(viewer):
    """Whether there is room for a page."""
    with page_of(viewer.address) as link:
        return bool(widgets(link))


def test_a_server_that_would_stand_open_is_not_started(monkeypatch):
    monkeypatch.setattr(
        guarded_server, "_gated", lambda gate: guarded_server.contextlib.nullcontext([])
    )
    with pytest.raises(RuntimeError, match="nothing would keep strangers out"):
        guarded_server.start(Gate("127.0.0.1"), host="127.0.0.1", port=18360, label="")
    assert websockets.asyncio.server.serve is guarded_server._serve


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "127.0.0.1", "localhost", "::1"])
def test_an_address_is_one_that_a_browser_opens(host):
    gate = Gate(host)
    name = {"0.0.0.0": "localhost", "::": "localhost", "::1": "[::1]"}.get(host, host)
    assert gate.address(8080) == f"http://{name}:8080/{gate.token}"
    assert len(gate.token) >= 20 and Gate(host).token != gate.token


@pytest.mark.parametrize(
    ("host", "port", "said"),
    [
        ("nowhere.invalid", 8080, "'nowhere.invalid': no server can listen there"),
        ("203.0.113.7", 8080, "'203.0.113.7': no server can listen there"),
        ("127.0.0.1", 0, "port 0: expected 1 to 65000"),
        ("127.0.0.1", 70000, "port 70000: expected 1 to 65000"),
    ],
)
def test_a_host_or_port_that_cannot_be_is_refused(host, port, said):
    with pytest.raises(ValueError, match=said):
        check_listens(host, port)
