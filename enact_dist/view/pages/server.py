"""The server of the pages: one page for each browser."""

from __future__ import annotations

import contextlib
import errno
import io
import secrets
import socket
import threading
import warnings
from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, Final

from enact_dist.access.watch import Closing
from enact_dist.errors import ConfigError
from enact_dist.view.follower import stand_back
from enact_dist.view.pages.page import Page

if TYPE_CHECKING:
    from viser import ClientHandle

    from enact_dist.view.pages.viewer import Viewer


TOKEN_BYTES: Final = 16


def require_viser() -> None:
    """Make sure that pages can be served.

    Raises:
        ConfigError: viser is not installed; the message names the extra that brings it.
    """
    if find_spec("viser") is None:
        raise ConfigError(
            "the view needs viser, which this Python does not have: install the extra 'view'"
            " (pip install -e '.[view]' in the clone of enact-dist)"
        )


def load_viser() -> None:
    """Begin to load viser beside whatever comes next, such as the connection to a cell.

    Raises:
        ConfigError: viser is not installed.
    """
    require_viser()
    threading.Thread(target=import_module, args=("enact_dist.view.pages.door",)).start()


def free_port(host: str, port: int, tries: int = 1) -> int:
    """Return the port, or the first one of so many from it on that nothing listens on; 0 stays 0.

    viser itself would try for ever, in a thread that its constructor waits for.

    Raises:
        ConfigError: There is none, or the host is no address of this machine.
    """
    taken: OSError | None = None
    for tried in range(port, port + tries):
        try:
            _bind(host, tried)
        except OSError as error:
            taken = error
            if error.errno != errno.EADDRINUSE:
                break
        else:
            return tried
    found = f"pages cannot be served at {host} port {port}: {taken}; "
    if taken is not None and taken.errno == errno.EADDRINUSE:
        found += f"ss -ltnp 'sport = :{port}' names the process that listens there; end it, or "
    raise ConfigError(f"{found}choose with --host and --port") from taken


def _bind(host: str, port: int) -> None:
    """Bind a port at each address of a host, as a server does, and leave it again."""
    bound, absent = 0, OSError(errno.EADDRNOTAVAIL, "it has no address")
    for family, kind, protocol, _, address in socket.getaddrinfo(
        host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
    ):
        with socket.socket(family, kind, protocol) as tried:
            tried.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            if family == socket.AF_INET6:
                tried.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
            try:
                tried.bind(address)
                bound += 1
            except OSError as error:
                if error.errno != errno.EADDRNOTAVAIL:
                    raise
                absent = error
    if not bound:
        raise absent


async def _stand_back(_: ClientHandle) -> None:
    """Let the thread in which viser's loop runs stand back, too."""
    stand_back("view server")


class ViewServer(Closing):
    """The server of the pages; also a context manager.

    Args:
        viewer: What they show.
        host: Address to listen on.
        port: Port; 0 for any.
        tries: How many ports from this one on are tried until one is free.
        token: What a browser has to know; None: nothing on the loopback, else a random one.
        resolution: So many pixels are drawn for each of a page, in both directions; None: as many
            as viser decides.

    Attributes:
        port: Port that it listens on.
        url: Where to open it, with the token and the resolution.

    Raises:
        ConfigError: viser is not installed, or no port of the address can be listened on.
    """

    def __init__(
        self,
        viewer: Viewer,
        *,
        host: str = "127.0.0.1",
        port: int = 0,
        tries: int = 1,
        token: str | None = None,
        resolution: float | None = None,
    ) -> None:
        require_viser()
        port = free_port(host, port, tries)
        from enact_dist.view.pages.door import Door, GuardedServer, is_loopback

        if token is None:
            token = "" if is_loopback(host) else secrets.token_urlsafe(TOKEN_BYTES)

        door = Door(host, token, resolution)
        # A browser may go while its page draws: what is on its way then is no loss.
        warnings.filterwarnings("ignore", "Queued a .* on a closed connection", UserWarning)
        with contextlib.redirect_stdout(io.StringIO()):  # its own table of addresses
            self._server = GuardedServer(host, port, door=door, label=viewer.name)
        self._server.gui.configure_theme(
            show_share_button=False, show_logo=False, control_width="large"
        )
        # viser's own light makes colours pale, and its shadows cost a browser without a graphics
        # card most of its time.
        scene = self._server.scene
        scene.configure_default_lights(enabled=False)
        scene.configure_environment_map(None)
        scene.add_light_ambient("/light/around", intensity=2.2)
        scene.add_light_directional(
            "/light/above", intensity=1.5, position=(1.0, -2.0, 3.0), cast_shadow=False
        )
        self._viewer = viewer
        self._pages: dict[int, Page] = {}
        self._guard = threading.Lock()
        self._server.on_client_connect(_stand_back)
        self._server.on_client_connect(self._open)
        self._server.on_client_disconnect(self._close)
        self.port = self._server.get_port()
        name = f"[{host}]" if ":" in host else host
        self.url = f"http://{name}:{self.port}{door.query}"

    def _open(self, client: ClientHandle) -> None:
        page = Page(self._viewer, client)
        with self._guard:
            self._pages[client.client_id] = page
        page.start()

    def _close(self, client: ClientHandle) -> None:
        with self._guard:
            page = self._pages.pop(client.client_id, None)
        if page is not None:
            page.close()

    def close(self) -> None:
        """End it and all pages."""
        with self._guard:
            pages, self._pages = self._pages, {}
        for page in pages.values():
            page.close()
        self._server.stop()
