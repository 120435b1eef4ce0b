"""A small page of ours reads keyboard and gamepad, which viser does not, and sends what they ask for."""

import json
import threading
from functools import partial
from http import HTTPStatus
from pathlib import Path
from urllib.parse import urlsplit

from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response
from websockets.sync.server import Server, ServerConnection, serve

from ksim_rl.viewer.panel import Panel
from ksim_rl.viewer.session import Session

PAGE = Path(__file__).with_name("pad.html")
# Bytes of a message; a page sends a few dozen.
MOST_BYTES = 4096


class Pad:
    """Serves the page on `host`:`port`, or the next port that is free, and does what it says.

    A message is JSON: `{"axes": {"0": 0.5}}` drives (see `Panel.drive`), `{"do": "pause" | "step" | "reset" | "push"}`.
    Pages of other sites are refused.
    """

    def __init__(self, panel: Panel, session: Session, *, host: str, port: int, viewer_port: int) -> None:
        self._panel, self._session = panel, session
        self._page = PAGE.read_text().replace("VIEWER_PORT", str(viewer_port)).encode()
        self._server = self._bind(host, port)
        self.port = int(self._server.socket.getsockname()[1])
        self.address = f"http://{'localhost' if host == '0.0.0.0' else host}:{self.port}"
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def close(self) -> None:
        """Stop serving."""
        self._server.shutdown()

    def _bind(self, host: str, port: int) -> Server:
        for candidate in range(port, port + 100):
            try:
                return serve(self._listen, host, candidate, process_request=self._answer, max_size=MOST_BYTES)
            except OSError:
                continue
        raise OSError(f"ports {port} to {port + 99} of {host} are all taken: choose another with --port")

    def _answer(self, _: ServerConnection, request: Request) -> Response | None:
        origin = request.headers.get("Origin")
        if origin is not None and urlsplit(origin).netloc != request.headers.get("Host"):
            return Response(HTTPStatus.FORBIDDEN, "Forbidden", Headers(), b"only its own page may drive\n")
        if request.headers.get("Upgrade", "").lower() == "websocket":
            return None
        headers = Headers(
            {"Content-Type": "text/html; charset=utf-8", "Content-Length": str(len(self._page))}
        )
        return Response(HTTPStatus.OK, "OK", headers, self._page)

    def _listen(self, connection: ServerConnection) -> None:
        try:
            for message in connection:
                self._session.ask(partial(self._obey, message))
        except ConnectionClosed:
            return

    def _obey(self, message: str | bytes) -> None:
        asked = json.loads(message)
        if axes := asked.get("axes"):
            self._panel.drive(
                {int(number): max(-1.0, min(1.0, float(share))) for number, share in axes.items()}
            )
        session = self._session
        does = {"pause": lambda: session.play(not session.playing), "step": session.step_once}
        does |= {"reset": session.reset, "push": lambda: session.push(float(self._panel.push_speed.value))}
        if "do" in asked:
            does[asked["do"]]()
