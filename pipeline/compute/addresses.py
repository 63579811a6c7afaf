"""Read the addresses of dask schedulers, and check within seconds that a scheduler answers."""

from __future__ import annotations

import asyncio
import contextlib
import json
import re
import socket
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.specification.problems import SpecError

ANSWER_S = 5.0
"""Longest time for a scheduler to accept a connection, and again to identify itself [s]."""

OPTION = "--scheduler"
SCHEMES = ("tcp", "tls")
_ADDRESS = re.compile(r"(?:(?P<scheme>[a-z][a-z0-9+.-]*)://)?(?P<host>\[[^\]]+\]|[^:/\s\[\]]+):(?P<port>\d+)/?", re.I)
_TLS_SETTINGS = (
    "DASK_DISTRIBUTED__COMM__TLS__CA_FILE",
    "DASK_DISTRIBUTED__COMM__TLS__CLIENT__CERT",
    "DASK_DISTRIBUTED__COMM__TLS__CLIENT__KEY",
)


class SchedulerError(Exception):
    """Raised if a dask scheduler or worker cannot be used; the message has the reason and the remedy."""


@dataclass(frozen=True)
class Address:
    """Address of a dask scheduler, with the setting from which it was read."""

    scheme: str
    host: str
    port: int
    source: str  # source of the address, for messages: the option, a variable, or a file

    @property
    def url(self) -> str:
        """Address in dask's form, such as ``tcp://host:8786``."""
        return f"{self.scheme}://{self.host}:{self.port}"

    @property
    def named(self) -> str:
        """Address for messages; it names the setting that it comes from, unless that is the option ``--scheduler``."""
        return self.url if self.source == OPTION else f"{self.url} (from {self.source})"


def read_address(text: str, source: str) -> Address:
    """Read the address of a dask scheduler, such as ``tcp://host:8786``, or from the scheduler's JSON file."""
    if text.lower().endswith(".json"):
        return _from_file(Path(text))
    match = _ADDRESS.fullmatch(text.strip())
    scheme = (match["scheme"] or "tcp").lower() if match else ""
    if match is None or not 0 < int(match["port"]) < 65536:
        raise SpecError(
            f"{source}: {text!r} is no address of a scheduler; give tcp://HOST:PORT with a port from 1 to "
            "65535, tls://HOST:PORT, the scheduler's FILE.json, slurm, pbs, torque, sge, lsf, threads, processes or "
            "none."
        )
    if scheme not in SCHEMES:
        hint = " A dashboard's address is another than its scheduler's." if scheme.startswith("http") else ""
        raise SpecError(f"{source}: {text!r}: must begin with tcp:// or tls://.{hint}")
    return Address(scheme, match["host"], int(match["port"]), source)


def _from_file(path: Path) -> Address:
    try:
        content = json.loads(path.read_text("utf-8"))
        address = content["address"]
    except OSError as error:
        raise SpecError(
            f"{path}: cannot be read ({error.strerror or error}); dask scheduler --scheduler-file FILE "
            "writes it when it starts."
        ) from None
    except (ValueError, TypeError, KeyError, RecursionError):
        raise SpecError(
            f"{path}: is no scheduler file, which is JSON with an 'address'; dask scheduler --scheduler-file "
            "FILE writes one."
        ) from None
    if not isinstance(address, str) or address.lower().endswith(".json"):
        raise SpecError(f"{path}: its 'address' must be a text such as tcp://HOST:PORT.")
    return read_address(address, str(path))


def security_of(address: Address) -> Any:
    """Return dask's TLS settings for an encrypted address; None for a plain connection.

    Raise `SchedulerError` if ``tls://`` is asked for and there are no keys, or they cannot be read.
    """
    if address.scheme != "tls":
        return None
    from distributed.security import Security

    security = Security()  # type: ignore[no-untyped-call]
    try:
        found = _keys(security).get("ssl_context")
    except (OSError, ValueError) as error:
        raise SchedulerError(f"{address.named}: the keys for TLS cannot be used ({error}).") from None
    if found is None:
        raise SchedulerError(
            f"{address.named}: TLS needs the scheduler's authority and a key of yours; set "
            f"{_TLS_SETTINGS[0]}, {_TLS_SETTINGS[1]} and {_TLS_SETTINGS[2]} to their files."
        )
    return security


def ask(address: Address) -> None:
    """Raise `SchedulerError`, with what is there instead, unless a scheduler answers within seconds."""
    security = security_of(address)
    _knock(address)
    found: dict[str, Any] = {}
    # use a separate thread, since an event loop may be running in the caller's
    thread = threading.Thread(target=lambda: found.update(_asked(address, security)), daemon=True)
    thread.start()
    thread.join(3 * ANSWER_S)
    kind = found.get("type")
    if kind == "Scheduler":
        return
    if kind is not None:
        raise SchedulerError(f"{address.named}: is the address of a {kind.lower()}; give its scheduler's.")
    if isinstance(found.get("error"), TimeoutError) or not found:
        raise SchedulerError(
            f"{address.named}: something accepts connections there and does not answer as a scheduler within "
            f"{ANSWER_S:.0f} s; it is another kind of server, or a scheduler that hangs."
        )
    other = "tls" if address.scheme == "tcp" else "tcp"
    raise SchedulerError(
        f"{address.named}: what answers there is no dask scheduler, or one for {other}:// "
        f"({type(found['error']).__name__})."
    )


def _knock(address: Address) -> None:
    try:
        socket.create_connection((address.host.strip("[]"), address.port), timeout=ANSWER_S).close()
    except socket.gaierror:
        raise SchedulerError(f"{address.named}: there is no host {address.host!r}; check the name.") from None
    except TimeoutError:
        raise SchedulerError(
            f"{address.named}: no answer within {ANSWER_S:.0f} s; check the host, and whether a firewall lies between."
        ) from None
    except (OSError, UnicodeError) as error:
        why = getattr(error, "strerror", None) or error
        raise SchedulerError(
            f"{address.named}: nothing listens there ({why}); start a scheduler, or correct the address."
        ) from None


def _asked(address: Address, security: Any) -> dict[str, Any]:
    try:
        return asyncio.run(_identity(address, security))
    except (Exception, asyncio.CancelledError) as error:
        return {"error": error}


async def _identity(address: Address, security: Any) -> dict[str, Any]:
    """Connect to a dask server, and return its description of itself."""
    from distributed.comm.core import connect

    keys = _keys(security) if security is not None else {}
    comm = None
    try:
        async with asyncio.timeout(ANSWER_S):
            comm = await connect(address.url, timeout=ANSWER_S, **keys)  # type: ignore[no-untyped-call]
            await comm.write({"op": "identity", "reply": True})
            answer = await comm.read()
        return dict(answer) if isinstance(answer, dict) else {"error": ValueError("its answer is no identity")}
    finally:
        if comm is not None:
            with contextlib.suppress(Exception):
                comm.abort()


def _keys(security: Any) -> dict[str, Any]:
    return dict(security.get_connection_args("client"))
