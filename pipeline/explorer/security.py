"""Decide which requests the explorer answers: those from its own page, with the secret token.

A server on loopback can be reached by every process of the machine and, through a browser, by every page
that is open in it. So there is a random token in the address that is printed, and every request but those
for the page's own script and style must bring it (compared in constant time): the page sends it as a header,
which no other page can make a browser do without being asked first, and that is refused. There is no cookie:
browsers give those of one port to every other port. Requests must name this server as their host, which a
name that an attacker lets point to 127.0.0.1 (DNS rebinding) does not, and come from this origin.
"""

from __future__ import annotations

import hmac
import secrets
import time
from collections.abc import Mapping
from dataclasses import dataclass, field

TOKEN_HEADERS = ("Authorization", "X-Magpend-Token")
_SCHEME = "token "

FROM_HERE = ("same-origin", "none")
"""Values of ``Sec-Fetch-Site`` of requests that this page makes, or a person by an address."""


def new_token() -> str:
    """Return a new random token that gives access to the page."""
    n_bytes = 32
    return secrets.token_urlsafe(n_bytes)


@dataclass(frozen=True)
class Guard:
    """Checks where a request comes from, and whether it has the secret token."""

    token: str = field(repr=False)
    port: int

    @property
    def hosts(self) -> tuple[str, ...]:
        """Names, with the port, by which requests may address this server."""
        return f"127.0.0.1:{self.port}", f"localhost:{self.port}"

    def foreign(self, headers: Mapping[str, str]) -> str | None:
        """Return the reason to reject a request from another page or for another host; None if there is none."""
        if headers.get("Host", "").lower() not in self.hosts:
            return "this server answers to its own address alone; use the one that it printed"
        origin = headers.get("Origin")
        if origin is not None and origin.lower() not in [f"http://{host}" for host in self.hosts]:
            return "the request comes from another page"
        if headers.get("Sec-Fetch-Site", "none") not in FROM_HERE:
            return "the request comes from another page"
        return None

    def knows(self, given: str) -> bool:
        """Return whether a text is the secret token, in constant time."""
        return hmac.compare_digest(given.encode("utf-8", "replace"), self.token.encode())

    def authorised(self, headers: Mapping[str, str], argument: str = "") -> bool:
        """Return whether a request has the secret token, in a header or as an argument."""
        given = [headers.get(name, "") for name in TOKEN_HEADERS]
        bare = [g[len(_SCHEME) :] if g.lower().startswith(_SCHEME) else g for g in given]
        found = [self.knows(one) for one in (*bare, argument)]
        return any(found)


def content_policy(port: int) -> str:
    """Return the content security policy of the page: it may use only its own script, style, images and connections."""
    sockets = f"ws://127.0.0.1:{port} ws://localhost:{port}"  # some browsers do not take 'self' for these
    return (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; "
        f"connect-src 'self' {sockets}; worker-src blob:; frame-ancestors 'none'; base-uri 'none'; "
        "form-action 'none'"
    )


def headers_of(port: int) -> dict[str, str]:
    """Return the HTTP headers of every answer."""
    return {
        "Content-Security-Policy": content_policy(port),
        "X-Content-Type-Options": "nosniff",
        "Referrer-Policy": "no-referrer",
        "X-Frame-Options": "DENY",
        "Cross-Origin-Opener-Policy": "same-origin",
        "Cross-Origin-Resource-Policy": "same-origin",
        "Cache-Control": "no-store",
        "Server": "magpend",
    }


class Rate:
    """Limit on the rate of requests: a mean rate [1/s], and a larger number at once."""

    def __init__(self, per_second: float, burst: int) -> None:
        self._per_second, self._burst = per_second, float(burst)
        self._left, self._then = float(burst), time.monotonic()

    def allows(self) -> bool:
        """Return whether one more request is allowed now; if so, count it."""
        now = time.monotonic()
        self._left = min(self._burst, self._left + (now - self._then) * self._per_second)
        self._then = now
        if self._left < 1.0:
            return False
        self._left -= 1.0
        return True
