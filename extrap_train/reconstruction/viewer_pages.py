"""Which web pages may talk to the viewer: its own alone."""

import ipaddress
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from http import HTTPStatus
from typing import Any
from unittest.mock import patch
from urllib.parse import urlsplit

from websockets.asyncio import server
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from extrap_train.errors import InputError

LOOPBACK = "127.0.0.1"


def is_own_page(headers: Headers, host: str) -> bool:
    """Whether a request comes from the page of a server that listens on `host`, or from no page.

    Its origin must be the address that it asks, and that a number or a name of this machine: any
    other name may be made to lead here by whoever owns it.
    """
    origins, addresses = headers.get_all("Origin"), headers.get_all("Host")
    if not origins:
        return True
    if len(origins) > 1 or len(addresses) != 1:
        return False
    try:
        origin = urlsplit(origins[0])
        name = origin.hostname or ""
    except ValueError:
        return False
    if origin.scheme not in ("http", "https") or origin.netloc.lower() != addresses[0].lower():
        return False
    return name in {"localhost", host.lower(), socket.gethostname().lower()} or _is_number(name)


@contextmanager
def answer_own_pages_only(host: str) -> Iterator[None]:
    """Make the server that viser starts meanwhile refuse requests that fail `is_own_page`.

    viser has no option for that: what it hands to websockets is changed on the way. Raises
    RuntimeError where it hands over nothing.
    """
    serve, guarded = server.serve, []

    def serve_own_pages(*arguments: Any, process_request: Any, **options: Any) -> server.serve:
        def answer(connection: server.ServerConnection, request: Request) -> Response | None:
            if is_own_page(request.headers, host):
                return process_request(connection, request)
            return connection.respond(HTTPStatus.FORBIDDEN, "for the viewer's own page only\n")

        guarded.append(True)
        return serve(*arguments, process_request=answer, **options)

    with patch.object(server, "serve", serve_own_pages):
        yield
    if not guarded:
        raise RuntimeError("this viser does not start its server through websockets.asyncio.server")


def require_own_address(host: str) -> None:
    """InputError where nothing can listen on `host`: viser would wait for ever."""
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as probe:
            probe.bind(address)
    except (OSError, UnicodeError) as error:
        raise InputError(
            f"complete.host={host}: the viewer cannot listen there ({error}); leave it out for "
            f"{LOOPBACK}, or use 0.0.0.0 for all addresses of this machine"
        ) from None


def _is_number(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True
