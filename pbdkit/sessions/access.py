"""Who may see a session, and lead it: whoever knows its address, and no other page.

A browser sends requests to this machine for any page that asks it to. Such a page knows no token;
the browser says whose it is (Origin), and under which name it found the server (Host).
"""

from __future__ import annotations

import secrets
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from urllib.parse import parse_qs, urlsplit

HOST = "127.0.0.1"
NAMES = (HOST, "localhost")
Headers = Callable[[str], Sequence[str]]
"""All values of the header of a name."""


def new_token() -> str:
    """Nobody guesses it."""
    return secrets.token_urlsafe(32)


@dataclass(frozen=True)
class Access:
    """To the server at a port."""

    port: int
    token: str = field(default_factory=new_token, repr=False)

    @property
    def address(self) -> str:
        """What to open."""
        return f"http://{HOST}:{self.port}/?token={self.token}"

    def refusal(self, target: str, headers: Headers, *, is_socket: bool) -> str:
        """Why a request is refused; empty where it is not. A socket says which page opens it; who
        types an address comes from none."""
        hosts, origins = headers("Host"), headers("Origin")
        if len(hosts) != 1 or hosts[0] not in self._hosts:
            return "the server is asked under another name than its own"
        if len(origins) > 1 or any(origin != f"http://{hosts[0]}" for origin in origins):
            return "the page is of another server"
        if is_socket and not origins:
            return "it is not said which page asks"
        given = parse_qs(urlsplit(target).query).get("token", [])
        right = self.token.encode()
        if len(given) != 1 or not secrets.compare_digest(given[0].encode(), right):
            return "the token is missing or wrong; open the address that pbdkit has printed"
        return ""

    @property
    def _hosts(self) -> list[str]:
        return [f"{name}:{self.port}" for name in NAMES]
