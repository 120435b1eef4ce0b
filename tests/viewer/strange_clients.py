"""Who may not drive a viewer, and what its page never says; `figures` sends all of it to both ports of a viewer."""

import contextlib
import json
import socket
import time
from urllib.parse import urlsplit

import msgspec
import viser
import zstandard
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from ksim_rl.viewer.browser import BrowserViewer
from ksim_rl.viewer.session import MOST_REQUESTS
from tests.viewer.test_session import session_of

PATIENCE_S = 30.0
CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": (1.0, 0.0, 0.0, 0.0),
    "position": (3.0, 3.0, 2.0),
    "fov": 0.9,
    "near": 0.01,
    "far": 100.0,
    "image_height": 800,
    "image_width": 1280,
    "look_at": (0.0, 0.0, 0.5),
    "up_direction": (0.0, 0.0, 1.0),
}
# Host, Origin and path, where TOKEN is the token of the viewer, and HOST its own host and port.
STRANGERS = {
    "another_site": ("HOST", "http://evil.example", "/TOKEN"),
    "a_site_of_this_machine": ("HOST", "http://127.0.0.1:9999", "/TOKEN"),
    "a_file": ("HOST", "null", "/TOKEN"),
    "an_encrypted_page": ("HOST", "https://HOST", "/TOKEN"),
    "rebound_name": ("evil.example:18340", "http://evil.example:18340", "/TOKEN"),
    "rebound_name_without_origin": ("evil.example:18340", None, "/TOKEN"),
    "name_that_ends_as_ours": ("localhost.evil.example", "http://localhost.evil.example", "/TOKEN"),
    "name_behind_ours": ("127.0.0.1@evil.example", "http://127.0.0.1@evil.example", "/TOKEN"),
    "another_machine": ("192.168.1.7:18340", "http://192.168.1.7:18340", "/TOKEN"),
    "no_host": ("", None, "/TOKEN"),
    "no_token": ("HOST", "http://HOST", "/"),
    "another_token": ("HOST", "http://HOST", "/AAAAAAAAAAAAAAAAAAAAAA"),
    "part_of_the_token": ("HOST", "http://HOST", "/TOKE"),
    "token_elsewhere": ("HOST", "http://HOST", "/index.html?token=TOKEN"),
}
# UUID identifies the slider of pushes, and WIDGET the button of pauses.
TO_VISER = {
    "text": "hello",
    "no_message": b"\xc1",
    "nothing": b"",
    "a_list": msgspec.msgpack.encode([1, 2]),
    "nested": b"\x91" * 10_000,
    "no_type": {"uuid": "UUID"},
    "unknown_type": {"type": "Unheard"},
    "type_that_is_no_text": {"type": ["GuiUpdateMessage"]},
    "tunnel": {"type": "ShareUrlRequest"},
    "script": {"type": "RunJavascriptMessage", "source": "window.ran=1"},
    "upload": {
        "type": "FileTransferStartUpload",
        "source_component_uuid": "UUID",
        "transfer_uuid": "x",
    },
    "unknown_widget": {"type": "GuiUpdateMessage", "uuid": "x", "updates": {"value": 1.0}},
    "icon": {
        "type": "GuiUpdateMessage",
        "uuid": "WIDGET",
        "updates": {"_icon_html": "<img src=x>"},
    },
    "callbacks": {"type": "GuiUpdateMessage", "uuid": "UUID", "updates": {"update_cb": []}},
    "two_values": {
        "type": "GuiUpdateMessage",
        "uuid": "UUID",
        "updates": {"value": 1.0, "removed": True},
    },
    "no_number": {"type": "GuiUpdateMessage", "uuid": "UUID", "updates": {"value": "fast"}},
    "nan": {"type": "GuiUpdateMessage", "uuid": "UUID", "updates": {"value": float("nan")}},
    "infinity": {"type": "GuiUpdateMessage", "uuid": "UUID", "updates": {"value": float("inf")}},
    "truth": {"type": "GuiUpdateMessage", "uuid": "UUID", "updates": {"value": True}},
    "number_for_a_button": {"type": "GuiUpdateMessage", "uuid": "WIDGET", "updates": {"value": 2}},
    "camera_at_nan": {**CAMERA, "position": (float("nan"), 0.0, 0.0)},
    "camera_of_many_numbers": {**CAMERA, "wxyz": [0.0] * 1000},
}
TO_PAD = {
    "no_json": "{",
    "a_list": "[1]",
    "nothing": "{}",
    "bytes": b"\xff\xfe",
    "nested": "[" * 1000,
    "unknown_deed": {"do": "explode"},
    "deed_that_is_no_text": {"do": ["push"]},
    "unknown_key": {"quit": 1},
    "nan": '{"axes": {"0": NaN}}',
    "infinity": '{"axes": {"0": 1e999}}',
    "long_number": f'{{"axes": {{"0": 1{"0" * 900}}}}}',
    "text": {"axes": {"0": "fast"}},
    "truth": {"axes": {"0": True}},
    "axis_that_is_none": {"axes": {"12": 1.0}},
    "axis_that_is_no_number": {"axes": {"x": 1.0}},
}


def until(condition):
    """Wait for a condition, and return whether it came."""
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.02)
    return True


def answer(address, *, host, origin, path, websocket):
    """Return the status of a request with these headers, which no ordinary client sends."""
    parts = urlsplit(address)
    token = parts.path.lstrip("/")

    def fill(text):
        whole = text.replace("HOST", parts.netloc).replace("TOKEN", token)
        return whole.replace("TOKE", token[:-1])

    lines = [f"GET {fill(path)} HTTP/1.1", f"Host: {fill(host)}"]
    if origin is not None:
        lines.append(f"Origin: {fill(origin)}")
    if websocket:
        lines += ["Upgrade: websocket", "Connection: Upgrade", "Sec-WebSocket-Version: 13"]
        lines += [
            "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==",
            f"Sec-WebSocket-Protocol: {version()}",
        ]
    with socket.create_connection((parts.hostname, parts.port), timeout=PATIENCE_S) as link:
        link.sendall(("\r\n".join(lines) + "\r\n\r\n").encode())
        return int(link.recv(64).split()[1])


def version():
    """The protocol that viser asks its page for."""
    return f"viser-v{viser.__version__}"


def page_of(address):
    """Connect as the page of viser does."""
    origin = f"http://{urlsplit(address).netloc}"
    return connect(
        address.replace("http", "ws"),
        origin=origin,
        subprotocols=[version()],
        max_size=None,
        compression=None,
    )


def widgets(link):
    """Return the identifiers of the widgets by their labels, as the server sends them when a page connects."""
    found = {}
    while not {"Push (m/s)", "Pause", "Push"} <= found.keys():
        raw = link.recv(timeout=PATIENCE_S)
        size = int.from_bytes(raw[8:16], "little")
        window = msgspec.msgpack.decode(
            zstandard.ZstdDecompressor().decompress(raw[16 : 16 + size])
        )
        for message in window["messages"]:
            label = message.get("props", {}).get("label")
            if label is not None and "uuid" in message:
                found[label] = message["uuid"]
    return found


def filled(message, known):
    """Return the bytes or text of a message, with identifiers in place of their names."""
    if not isinstance(message, dict):
        return message
    names = {"UUID": known["Push (m/s)"], "WIDGET": known["Pause"]}
    message = {
        key: names.get(value, value) if isinstance(value, str) else value
        for key, value in message.items()
    }
    return msgspec.msgpack.encode(message)


@contextlib.contextmanager
def viewed(port):
    """Yield a viewer without an open page, and its session; only `advance` steps it."""
    session = session_of("cartpole_swingup")
    session.play(False)
    viewer = BrowserViewer(port=port)
    viewer.open(session)
    try:
        yield viewer, session
    finally:
        viewer.close()
        session.close()


def let_in(viewer):
    """Return which strangers were answered, by port and kind of request."""
    found = []
    for address in (viewer.address, viewer.pad_address):
        for name, (host, origin, path) in STRANGERS.items():
            for websocket in (False, True):
                how = {"host": host, "origin": origin, "path": path, "websocket": websocket}
                if answer(address, **how) in (101, 200):
                    found.append((name, address, websocket))
    return found


def not_ignored(viewer):
    """Send each message that no page sends; return those that were not counted as ignored."""
    found = []
    with page_of(viewer.address) as link:
        known = widgets(link)
        for name, message in TO_VISER.items():
            before = viewer.ignored
            link.send(filled(message, known))
            if not until(lambda before=before: viewer.ignored == before + 1):
                found.append(name)
    with page_of(viewer.pad_address) as link:
        for name, message in TO_PAD.items():
            before = viewer.ignored
            link.send(json.dumps(message) if isinstance(message, dict) else message)
            if not until(lambda before=before: viewer.ignored == before + 1):
                found.append(name)
    return found


def pushes(viewer, session, values):
    """Set the slider of pushes to each value as a page does, and click Push; return how hard the robot was pushed."""
    taken, own = [], session.push
    session.push = taken.append
    with page_of(viewer.address) as link:
        known = widgets(link)
        # Viser calls back for a page that has said where it looks from.
        link.send(msgspec.msgpack.encode(CAMERA))
        for value in values:
            wanted = len(taken) + 1
            update = {
                "type": "GuiUpdateMessage",
                "uuid": known["Push (m/s)"],
                "updates": {"value": value},
            }
            click = {"type": "GuiUpdateMessage", "uuid": known["Push"], "updates": {"value": True}}
            link.send(msgspec.msgpack.encode(update))
            link.send(msgspec.msgpack.encode(click))
            until(lambda wanted=wanted: session.advance() and len(taken) == wanted)
    session.push = own
    return taken


def waiting_after_a_flood(viewer, session, *, messages):
    """Ask for steps through both doors while requests are not taken; return how many were done at last."""
    done = []
    for _ in range(messages):
        session.ask(lambda: done.append(1))
    with page_of(viewer.pad_address) as link:
        with contextlib.suppress(ConnectionClosed, TimeoutError):
            for _ in range(messages // 100):
                link.send(json.dumps({"do": "step"}))
        until(lambda: session.refused >= messages - MOST_REQUESTS)
    session.advance()
    return len(done) + session.steps


def figures(*, messages):
    """Do all of it to one viewer."""
    with viewed(18340) as (viewer, session):
        strangers = let_in(viewer)
        sent = not_ignored(viewer)
        own = pushes(viewer, session, [1.5])
        beyond = pushes(viewer, session, [1e9, -1e9, 1e308])
        waiting = waiting_after_a_flood(viewer, session, messages=messages)
    return {
        "strangers": 4 * len(STRANGERS),
        "let_in": len(strangers),
        "messages": len(TO_VISER) + len(TO_PAD),
        "not_ignored": len(sent),
        "own_page_drives": float(own == [1.5]),
        "beyond_the_control": sum(not 0.1 <= speed <= 3.0 for speed in beyond),
        "waiting_at_most": waiting,
    }
