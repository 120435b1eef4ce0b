"""viser's server, behind the gate: it lets clients of any site and with any message in when left alone."""

import asyncio
import contextlib
import io
import threading
from collections.abc import Iterator, Mapping
from typing import Any

import viser
import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from ksim_rl.viewer.client_messages import MOST_BYTES, checked
from ksim_rl.viewer.gate import MESSAGES_PER_S, MOST_CLIENTS, Gate

# Messages of one client that wait for viser, and seconds of messages that may come before their pace counts.
_MOST_WAITING = 16
_BURST_S = 0.5
_serve = websockets.asyncio.server.serve
_one_at_a_time = threading.Lock()


def start(gate: Gate, *, host: str, port: int, label: str) -> viser.ViserServer:
    """Start viser's server on a port, or the next one that is free, with `gate` before it."""
    # viser prints an address without the token.
    with contextlib.redirect_stdout(io.StringIO()), _gated(gate) as made:
        server = viser.ViserServer(host=host, port=port, label=label, verbose=False)
    # Another viser may start its server in another way: then nothing would guard it.
    if not made:
        server.stop()
        raise RuntimeError(
            f"viser {viser.__version__} starts its server otherwise than this library knows, and nothing would "
            "keep strangers out: install viser>=1.1,<1.2"
        )
    # viser keeps its widgets by the identifiers of its messages there, and has no public way to find one.
    made[0].widgets = server.gui._gui_input_handle_from_uuid
    return server


class _Clients:
    """The connections of one server, each of which reads messages for `widgets` that pass `checked`, at a pace."""

    def __init__(self, gate: Gate) -> None:
        self.gate = gate
        self.widgets: Mapping[str, Any] = {}
        self._open = 0

    async def handle(self, handler: Any, connection: ServerConnection) -> None:
        """Let viser serve a connection, unless there are too many."""
        # One page too many gets the reason, which its browser can show.
        if self._open >= MOST_CLIENTS:
            await connection.close(1013, f"{MOST_CLIENTS} pages are open already")
            return
        self._open += 1
        try:
            await handler(connection)
        finally:
            self._open -= 1

    def connection(self) -> type[ServerConnection]:
        """Return the class of its connections."""
        clients = self

        class Connection(ServerConnection):
            _free_at = 0.0

            async def recv(self, decode: bool | None = None) -> bytes:
                while True:
                    # Messages that are refused are counted, and the next one is waited for.
                    raw = await super().recv(decode)
                    await self._keep_pace()
                    message = checked(raw, clients.widgets)
                    if message is not None:
                        return message
                    clients.gate.ignore()

            async def _keep_pace(self) -> None:
                # Unread data stays with the client, whose own queue then fills.
                now = asyncio.get_running_loop().time()
                # A pause earns half a second of messages at most.
                self._free_at = max(self._free_at, now - _BURST_S) + 1.0 / MESSAGES_PER_S
                await asyncio.sleep(max(0.0, self._free_at - now))

        return Connection


@contextlib.contextmanager
def _gated(gate: Gate) -> Iterator[list[_Clients]]:
    """Put the gate before the server of websockets that starts inside, and yield the clients that it will have.

    viser takes no function that sees a request first, so the one that starts its server is replaced meanwhile.
    """
    made: list[_Clients] = []

    # Stands in for the function of websockets while viser starts its server.
    def serve(handler: Any, *where: Any, **options: Any) -> Any:
        clients = _Clients(gate)
        own = options["process_request"]
        made[:] = [clients]

        def answer(connection: ServerConnection, request: Request) -> Response | None:
            response = gate.refusal(request)
            # viser knows no tokens: its own handler sees the path without it.
            if response is None:
                response = own(connection, gate.without_token(request))
            return response

        async def handle(connection: ServerConnection) -> None:
            await clients.handle(handler, connection)

        # Ours come last, so that they replace viser's limits.
        limits = {"max_size": MOST_BYTES, "max_queue": _MOST_WAITING}
        own_way = {"process_request": answer, "create_connection": clients.connection()}
        return _serve(handle, *where, **{**options, **limits, **own_way})

    # One server at a time, since the function of a library is replaced for all threads.
    with _one_at_a_time:
        websockets.asyncio.server.serve = serve  # pyright: ignore[reportAttributeAccessIssue]
        try:
            yield made
        finally:
            websockets.asyncio.server.serve = _serve
