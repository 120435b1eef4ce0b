"""Who may talk to the ports of the viewer: only the pages at the printed addresses.

A port of this machine is open to every page that its user's browser shows. A page of another site may connect to it
(its `Origin` tells), a name of another site may lead to it (the `Host` tells: that is DNS rebinding), and another user
of the machine may connect as well. The last one cannot know the token in the path of the printed addresses.
"""

import dataclasses
import hmac
import ipaddress
import secrets
import socket
import threading
from http import HTTPStatus
from urllib.parse import urlsplit

from websockets.datastructures import Headers, MultipleValuesError
from websockets.http11 import Request, Response

# More pages than anybody looks at; each costs a thread or three tasks, and a queue.
MOST_CLIENTS = 16
# More than a page sends while a user turns the view and drags a slider; beyond that rate it waits.
MESSAGES_PER_S = 240.0
_EVERYWHERE = ("0.0.0.0", "::", "")


class Gate:
    """Stands before the two ports of one viewer that listens on `host`, and counts the messages that it did not let in.

    Attributes:
        token: the first part of each path that is answered.
        ignored: how many messages were none that the pages send, or were more than there was room for.
    """

    def __init__(self, host: str) -> None:
        # New for each viewer: an address that was once seen is of no use later.
        self.token = secrets.token_urlsafe(16)
        self.ignored = 0
        self._host = host
        self._count = threading.Lock()
        # Host names that a browser on this machine, or on the network, may use.
        self._names = {"localhost", host.lower()}
        self._is_local = _is_address(host, local=True) or host == "localhost"
        # A viewer for this machine alone answers to no name of the network.
        if not self._is_local:
            name = socket.gethostname().lower()
            self._names |= {name, f"{name}.local"}

    def address(self, port: int) -> str:
        """Return the address that a browser of this machine opens."""
        if self._host in _EVERYWHERE:
            name = "localhost"
        else:
            name = self._host
        return f"http://{f'[{name}]' if ':' in name else name}:{port}/{self.token}"

    def ignore(self) -> None:
        """Count one message more that was not let in; from any thread."""
        with self._count:
            self.ignored += 1

    def refusal(self, request: Request) -> Response | None:
        """Return the answer to a request that is not let in, or None."""
        # Two Host headers could mean one thing to us and another to the browser.
        try:
            host = request.headers.get("Host", "")
            origin = request.headers.get("Origin")
        except MultipleValuesError:
            return _forbidden("expected one Host and one Origin")
        # Other names are refused: by such a name a page of another site would reach this machine.
        if not self._is_own(host):
            return _forbidden("the address does not name this machine")
        # Browsers send the origin with each WebSocket: pages of other sites are refused.
        if origin is not None and origin != f"http://{host}":
            return _forbidden("only its own page may connect")
        first = request.path.partition("?")[0].split("/")[1:2]
        # In constant time, so that the token cannot be guessed letter by letter.
        if not hmac.compare_digest("".join(first).encode(), self.token.encode()):
            return _forbidden(
                "open the address that the command printed, with all that follows the port"
            )
        return None

    def without_token(self, request: Request) -> Request:
        """Return a request that was let in as one without the token in its path."""
        path = request.path.removeprefix(f"/{self.token}")
        return dataclasses.replace(request, path=path if path.startswith("/") else f"/{path}")

    def _is_own(self, host: str) -> bool:
        """Whether a Host is an address, or a name that no other site can have."""
        try:
            name = urlsplit(f"//{host}").hostname or ""
        except ValueError:
            return False
        return name in self._names or _is_address(name, local=self._is_local)


def check_listens(host: str, port: int) -> None:
    """Refuse a host that is not this machine, and a port that no server can listen on."""
    if not 1 <= port <= 65000:
        raise ValueError(f"port {port}: expected 1 to 65000")
    try:
        # Bound for a moment: only the system knows which addresses are its own.
        kind, _, _, _, place = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(kind, socket.SOCK_STREAM) as tried:
            tried.bind(place)
    except (OSError, UnicodeError) as error:
        raise ValueError(
            f"host {host!r}: no server can listen there: {error}; expected 127.0.0.1, or an address of this machine"
        ) from error


def _is_address(name: str, *, local: bool) -> bool:
    try:
        found = ipaddress.ip_address(name)
    except ValueError:
        return False
    return found.is_loopback or not local


def _forbidden(why: str) -> Response:
    return Response(HTTPStatus.FORBIDDEN, "Forbidden", Headers(), f"{why}\n".encode())
