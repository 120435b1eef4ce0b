"""A small page of ours reads keyboard and gamepad, which viser does not, and sends their requests."""

import json
import threading
import time
from collections.abc import Callable, Mapping
from functools import partial
from http import HTTPStatus
from pathlib import Path
from typing import Any, NoReturn

from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response
from websockets.sync.server import Server, ServerConnection, serve

from ksim_rl.viewer.client_messages import clamped, is_number
from ksim_rl.viewer.gate import MESSAGES_PER_S, MOST_CLIENTS, Gate
from ksim_rl.viewer.panel import Panel
from ksim_rl.viewer.session import Session

PAGE = Path(__file__).with_name("pad.html")
# Bytes of a message; a page sends a few dozen.
MOST_BYTES = 1024
# Axes by number, as the page sends them; the panel knows which field each drives.
AXES = ("0", "1", "2", "3")
DOES = ("pause", "step", "reset", "push")


class Pad:
    """Serves the page on `host`:`port`, or the next free port, and obeys its messages.

    A message is JSON: `{"axes": {"0": 0.5}}` drives (see `Panel.drive`), `{"do": "pause" | "step" | "reset" | "push"}`.
    All others are ignored and counted by the gate, which also refuses pages of other sites.
    """

    def __init__(
        self, panel: Panel, session: Session, gate: Gate, *, host: str, port: int, viewer_port: int
    ) -> None:
        self._panel = panel
        self._session = session
        self._gate = gate
        # Few at a time: each open page has a thread.
        self._places = threading.BoundedSemaphore(MOST_CLIENTS)
        self._page = PAGE.read_text().replace("VIEWER_PORT", str(viewer_port)).encode()
        self._server = self._bind(host, port)
        self.port = int(self._server.socket.getsockname()[1])
        self.address = gate.address(self.port)
        # A daemon: it must not keep the program from ending.
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def close(self) -> None:
        """Stop serving."""
        self._server.shutdown()

    def _bind(self, host: str, port: int) -> Server:
        # The next free port, as viser does.
        for candidate in range(port, port + 100):
            try:
                return serve(
                    self._listen, host, candidate, process_request=self._answer, max_size=MOST_BYTES
                )
            except OSError:
                continue
        raise OSError(
            f"ports {port} to {port + 99} of {host} are all taken: choose another with --port"
        )

    def _answer(self, _: ServerConnection, request: Request) -> Response | None:
        # The same check for the page and for its connection.
        refusal = self._gate.refusal(request)
        if refusal is not None:
            return refusal
        # None lets the library go on with the handshake.
        if request.headers.get("Upgrade", "").lower() == "websocket":
            return None
        headers = Headers(
            {"Content-Type": "text/html; charset=utf-8", "Content-Length": str(len(self._page))}
        )
        return Response(HTTPStatus.OK, "OK", headers, self._page)

    def _listen(self, connection: ServerConnection) -> None:
        # Refused immediately, not kept waiting.
        if not self._places.acquire(blocking=False):
            connection.close(1013, f"{MOST_CLIENTS} pages are open already")
            return
        try:
            for message in connection:
                asked = parsed(message)
                if asked is None:
                    self._gate.ignore()
                else:
                    # Requests run in the thread of the session, as all that touches the env does.
                    self._session.ask(partial(self._obey, asked))
                # Unread data stays with the client, whose own queue then fills.
                time.sleep(1.0 / MESSAGES_PER_S)
        except ConnectionClosed:
            return
        finally:
            self._places.release()

    def _obey(self, asked: Mapping[str, Any]) -> None:
        session = self._session
        if "axes" in asked:
            self._panel.drive(asked["axes"])
        does: dict[str, Callable[[], None]] = {
            "pause": lambda: session.play(not session.playing),
            "step": session.step_once,
            "reset": session.reset,
            "push": lambda: session.push(float(self._panel.push_speed.value)),
        }
        if "do" in asked:
            does[asked["do"]]()


def parsed(message: str | bytes) -> dict[str, Any] | None:
    """Return the request in a message of the page, shares by axis clamped to [-1, 1], or None for any other message."""
    try:
        # NaN and infinity are no JSON, but Python's parser takes them.
        asked = json.loads(message, parse_constant=_refuse)
    except (ValueError, RecursionError):
        return None
    # Unknown fields are refused: the page sends none.
    if not isinstance(asked, dict) or not asked or not asked.keys() <= {"axes", "do"}:
        return None
    found: dict[str, Any] = {}
    if "axes" in asked:
        axes = asked["axes"]
        if (
            not isinstance(axes, dict)
            or not axes.keys() <= set(AXES)
            or not all(map(is_number, axes.values()))
        ):
            return None
        # Shares beyond the range would drive beyond the command's range.
        found["axes"] = {
            int(number): clamped(float(share), -1.0, 1.0) for number, share in axes.items()
        }
    if "do" in asked:
        if asked["do"] not in DOES:
            return None
        found["do"] = asked["do"]
    return found


def _refuse(number: str) -> NoReturn:
    raise ValueError(number)
