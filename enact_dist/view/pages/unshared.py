"""viser's server without its way to the outside."""

from __future__ import annotations

import viser


class UnsharedServer(viser.ViserServer):
    """A server whose scene no relay gets, whatever a browser asks for."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        """Refuse: the data of a cell stay on its network."""
        return None
