"""The page of keys and gamepads is served, and what it sends arrives; who may not send is in test_gate.py."""

import json
import time
import urllib.request
from types import SimpleNamespace

import pytest

pytest.importorskip("viser", reason="viser is not installed (the extra `viewer`)")
from ksim_rl.viewer.gate import Gate
from ksim_rl.viewer.pad import Pad
from tests.viewer.strange_clients import page_of


@pytest.fixture
def served():
    said = []
    session = SimpleNamespace(ask=lambda request: said.append(request), playing=True)
    session.play = lambda playing: said.append(("play", playing))
    session.step_once = session.reset = lambda: said.append("other")
    session.push = lambda speed: said.append(("push", speed))
    panel = SimpleNamespace(
        drive=lambda shares: said.append(shares), push_speed=SimpleNamespace(value=1.5)
    )
    pad = Pad(panel, session, Gate("127.0.0.1"), host="127.0.0.1", port=18301, viewer_port=18300)
    yield pad, said
    pad.close()


def send(pad, said, *messages):
    """Send messages, and wait until they have arrived."""
    wanted = len(said) + len(messages)
    with page_of(pad.address) as socket:
        for message in messages:
            socket.send(json.dumps(message))
        deadline = time.monotonic() + 30
        while len(said) < wanted and time.monotonic() < deadline:
            time.sleep(0.02)


def test_the_page_embeds_the_viewer(served):
    pad, _ = served
    with urllib.request.urlopen(pad.address) as answer:
        page = answer.read().decode()
    assert ":18300" in page and "VIEWER_PORT" not in page
    assert "getGamepads" in page


def test_keys_and_axes_reach_the_session(served):
    pad, said = served
    send(pad, said, {"axes": {"0": 2.0, "2": -0.5}}, {"do": "pause"}, {"do": "push"})
    requests, said[:] = list(said), []
    assert len(requests) == 3
    for request in requests:
        request()
    assert said == [{0: 1.0, 2: -0.5}, ("play", False), ("push", 1.5)]
