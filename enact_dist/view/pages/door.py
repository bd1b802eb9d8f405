"""Who may open the page: the door in front of viser's server.

Any web page that a browser shows can send requests to a port of this host.  Two headers that
scripts cannot set show a foreign page: the origin of a WebSocket, and the host that the browser
believes to talk to, in case an attacker lets a name of his own lead to the loopback.  Beyond the
loopback a page opens with a token only.
"""

from __future__ import annotations

import hmac
import http
import ipaddress
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from http.cookies import CookieError, SimpleCookie
from typing import Any, Final
from urllib.parse import parse_qs, urlencode, urlsplit

import viser
import websockets.asyncio.server as websocket_server
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

COOKIE: Final = "enact_view"
QUERY: Final = "token"
RESOLUTION: Final = "fixedDpr"
"""By this part of its address viser's page draws so many pixels for each of its own."""
LOOPBACK: Final = frozenset({"localhost", "127.0.0.1", "::1"})
_ASK: Final = """<!doctype html><meta charset="utf-8"><title>enact view</title>
<form style="font: 16px sans-serif; margin: 4em"><p>This page needs the token that `enact view` has
printed.</p><input name="token" type="password" autofocus> <button>Open</button></form>"""
_making = threading.Lock()


def is_loopback(host: str) -> bool:
    """Return whether an address to listen on is that of this host alone."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


class Door:
    """Decides about each request before viser sees it.

    Args:
        host: Address that the server listens on.
        token: What a browser has to know; "" lets in all that asks this host for it.
        resolution: With what resolution pages draw; None: as viser decides.

    Attributes:
        query: What an address with all that a browser has to say ends with.
    """

    def __init__(self, host: str, token: str, resolution: float | None = None) -> None:
        self._token = token
        self._resolution = "" if resolution is None else f"{RESOLUTION}={resolution:g}"
        asked = "&".join(filter(None, (token and f"{QUERY}={token}", self._resolution)))
        self.query = asked and f"/?{asked}"
        self._names = LOOPBACK | {host} if is_loopback(host) else None

    def answer(self, request: Request) -> Response | None:
        """Return what to answer instead of the page; None lets the request pass."""
        host = request.headers.get("Host", "")
        if self._names is not None and _name_of(host) not in self._names:
            return _refused(f"This is a page of this host alone, and no page of {host!r}.")
        origin = request.headers.get("Origin")
        if origin is not None and urlsplit(origin).netloc != host:
            return _refused(f"A page of {origin!r} may not read this one.")
        path, query = urlsplit(request.path).path, parse_qs(urlsplit(request.path).query)
        if not self._token or self._knows(_cookie_of(request)):
            is_page = path == "/" and "Upgrade" not in request.headers
            if self._resolution and is_page and RESOLUTION not in query:
                return _response(http.HTTPStatus.SEE_OTHER, "", Location=self._page(query))
            return None
        given = query.get(QUERY, [""])[0]
        if self._knows(given):
            cookie = f"{COOKIE}={given}; HttpOnly; SameSite=Strict; Path=/"
            place = self._page(query)
            return _response(http.HTTPStatus.SEE_OTHER, "", Location=place, Set_Cookie=cookie)
        return _response(http.HTTPStatus.UNAUTHORIZED, _ASK, Content_Type="text/html")

    def _page(self, query: dict[str, list[str]]) -> str:
        """Return where the page is: with the resolution that was asked for, and without a token."""
        rest = {name: values for name, values in query.items() if name != QUERY}
        asked = urlencode(rest, doseq=True)
        if RESOLUTION not in query:
            asked = "&".join(filter(None, (asked, self._resolution)))
        return f"/?{asked}" if asked else "/"

    def _knows(self, given: str) -> bool:
        return hmac.compare_digest(given.encode(), self._token.encode())


def _name_of(host: str) -> str | None:
    try:
        return urlsplit(f"//{host}").hostname
    except ValueError:
        return None


def _cookie_of(request: Request) -> str:
    try:
        found = SimpleCookie(request.headers.get("Cookie", "")).get(COOKIE)
    except CookieError:
        return ""
    return found.value if found is not None else ""


def _refused(text: str) -> Response:
    return _response(http.HTTPStatus.FORBIDDEN, text)


def _response(status: http.HTTPStatus, text: str, **headers: str) -> Response:
    body = text.encode()
    sent = Headers({name.replace("_", "-"): value for name, value in headers.items()})
    sent["Content-Length"] = str(len(body))
    sent["Cache-Control"] = "no-store"
    sent["Connection"] = "close"
    return Response(status.value, status.phrase, sent, body)


class GuardedServer(viser.ViserServer):
    """viser's server behind a door, and without its way to the outside.

    Args:
        host: Address to listen on.
        port: Port to listen on.
        door: Decides who may open it.
        label: Title of the page.
    """

    def __init__(self, host: str, port: int, *, door: Door, label: str) -> None:
        with _guarded(door):
            super().__init__(host, port, label=label, verbose=False)

    def request_share_url(self, verbose: bool = True) -> str | None:
        """Refuse: the data of a cell stay on its network."""
        return None


@contextmanager
def _guarded(door: Door) -> Iterator[None]:
    """Put a door in front of the server that viser starts meanwhile; it offers no place for one."""
    with _making:
        real = websocket_server.serve
        websocket_server.serve = partial(_serve, real, door)  # type: ignore[assignment,misc]
        try:
            yield
        finally:
            websocket_server.serve = real  # type: ignore[misc]


def _serve(real: Callable[..., Any], door: Door, *words: Any, **options: Any) -> Any:
    inner: Callable[[Any, Request], Response | None] = options.pop("process_request")

    def process_request(connection: Any, request: Request) -> Response | None:
        return door.answer(request) or inner(connection, request)

    return real(*words, process_request=process_request, **options)
