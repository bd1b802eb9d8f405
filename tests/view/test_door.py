"""Who may open the page: foreign pages may not, and beyond the loopback a token is needed."""

import http.client

import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect as open_websocket

from enact_dist.view.pages.server import ViewServer
from enact_dist.view.pages.viewer import Viewer, ViewSettings

PROTOCOLS = ["viser-v0"]


@pytest.fixture
def serve(cell):
    """Return a function that serves the pages of a cell; they end with the test."""
    opened = []

    def start(**options):
        viewer = Viewer(cell, ViewSettings())
        server = ViewServer(viewer, port=0, **options)
        opened.extend((viewer, server))
        return server

    yield start
    for one in reversed(opened):
        one.close()


def get(server, path="/", **headers):
    """Return status, headers and text of a page; `Host` is that of this host unless given."""
    line = http.client.HTTPConnection("127.0.0.1", server.port, timeout=10)
    try:
        line.putrequest("GET", path, skip_host=True)
        for name, value in {"Host": f"127.0.0.1:{server.port}", **headers}.items():
            line.putheader(name, value)
        line.endheaders()
        answer = line.getresponse()
        return answer.status, answer.headers, answer.read().decode("utf-8", "replace")
    finally:
        line.close()


def websocket(server, *, origin=None, **headers):
    """Open the WebSocket of the page; return the status with which it is refused, else 101."""
    try:
        open_websocket(
            f"ws://127.0.0.1:{server.port}",
            origin=origin,
            additional_headers=headers,
            subprotocols=PROTOCOLS,
        ).close()
    except InvalidStatus as error:
        return error.response.status_code
    return 101


def test_other_pages_of_the_browser_are_kept_out(serve):
    """A script can set neither its origin nor the host that the browser believes to talk to."""
    server = serve()
    assert server.url == f"http://127.0.0.1:{server.port}"
    for host in (f"127.0.0.1:{server.port}", f"localhost:{server.port}", "[::1]:8080", "localhost"):
        assert get(server, Host=host)[0] == 200
    for host in ("evil.example", f"evil.example:{server.port}", "127.0.0.1.evil.example", "", "["):
        status, _, text = get(server, Host=host)
        assert (status, "page of this host alone" in text) == (403, True)
    here = f"http://127.0.0.1:{server.port}"
    assert websocket(server) == 101
    assert websocket(server, origin=here) == 101
    for origin in ("http://evil.example", "null", f"{here}0", "file://"):
        assert websocket(server, origin=origin) == 403


def test_beyond_the_loopback_a_page_needs_the_token(serve):
    """The page asks for it; the browser keeps it as a cookie that no script reads."""
    server = serve(host="0.0.0.0")
    address, _, token = server.url.partition("/?token=")
    assert address == f"http://0.0.0.0:{server.port}"
    assert len(token) >= 20
    status, _, text = get(server, Host="robot-pc")
    assert status == 401
    assert 'name="token"' in text
    assert get(server, "/?token=guess")[0] == 401
    assert get(server, Cookie="enact_view=guess")[0] == 401
    assert websocket(server) == 401

    status, headers, _ = get(server, f"/?token={token}")
    assert (status, headers["Location"]) == (303, "/")
    assert "HttpOnly; SameSite=Strict" in headers["Set-Cookie"]
    cookie = headers["Set-Cookie"].partition(";")[0]
    assert get(server, Cookie=cookie)[0] == 200
    assert websocket(server, Cookie=cookie) == 101
    assert websocket(server, origin="http://evil.example", Cookie=cookie) == 403


def test_token_can_be_chosen(serve):
    """Also where other users of a host could reach its loopback."""
    server = serve(token="of the day")
    assert server.url.endswith("/?token=of the day")
    assert get(server)[0] == 401
    assert get(server, "/?token=of%20the%20day")[0] == 303


def test_a_page_is_sent_to_its_resolution(serve):
    """Its files and its WebSocket are not, nor a page that asks for one of its own."""
    server = serve(resolution=0.5)
    assert server.url == f"http://127.0.0.1:{server.port}/?fixedDpr=0.5"
    for path, place in (
        ("/", "/?fixedDpr=0.5"),
        ("/?showStats=1&x=a%26b%0d", "/?showStats=1&x=a%26b%0D&fixedDpr=0.5"),
    ):
        status, headers, _ = get(server, path)
        assert (status, headers["Location"], headers["Cache-Control"]) == (303, place, "no-store")
    assert get(server, "/?fixedDpr=0.5")[0] == get(server, "/?fixedDpr=1")[0] == 200
    assert get(server, "/robots.txt")[0] in (200, 404)
    assert websocket(server) == 101
    assert get(server, Host="evil.example")[0] == 403


def test_a_page_with_a_token_keeps_its_resolution(serve):
    """The token leaves the address; what else is in it stays."""
    server = serve(token="secret", resolution=0.25)
    assert server.url.endswith("/?token=secret&fixedDpr=0.25")
    assert get(server)[0] == get(server, "/?fixedDpr=0.25")[0] == 401
    for path, place in (
        ("/?token=secret", "/?fixedDpr=0.25"),
        ("/?token=secret&fixedDpr=0.75", "/?fixedDpr=0.75"),
    ):
        status, headers, _ = get(server, path)
        assert (status, headers["Location"]) == (303, place)
    cookie = headers["Set-Cookie"].partition(";")[0]
    assert get(server, Cookie=cookie)[1]["Location"] == "/?fixedDpr=0.25"
    assert get(server, "/?fixedDpr=0.25", Cookie=cookie)[0] == 200
    assert websocket(server, Cookie=cookie) == 101
