"""What the viewer's server answers, and to whom: its own web pages alone."""

import ipaddress
import socket
from collections.abc import Awaitable, Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from http import HTTPStatus
from typing import Any
from unittest.mock import patch
from urllib.parse import urlsplit

import viser
from viser import _messages
from websockets.asyncio import server
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from extrap_train.errors import InputError

LOOPBACK = "127.0.0.1"
_UNWANTED = (
    _messages.FileTransferStartUpload,  # viser keeps whatever is sent, of any size, in memory
    _messages.ShareUrlRequest,  # it would open a tunnel to a public server
)


@dataclass(frozen=True)
class Routes:
    """What a server answers besides viser's own page, by the path of the request."""

    pages: Mapping[str, bytes] = field(default_factory=dict)
    """HTML."""
    sockets: Mapping[str, Callable[[server.ServerConnection], Awaitable[None]]] = field(
        default_factory=dict
    )
    """What serves a websocket until it is closed, in the server's event loop."""


def open_server(option: str, host: str, port: int, routes: Routes) -> viser.ViserServer:
    """A server on `port`, or the next free one, that answers its own pages only.

    Visitors can neither upload through viser nor make it open a tunnel. Raises InputError, which
    names the `option`, where nothing can listen on `host`.
    """
    require_own_address(option, host)
    with _answer_own_pages_only(host, routes):
        opened = viser.ViserServer(host=host, port=port, verbose=False)
    for message in _UNWANTED:
        opened._websock_server.unregister_handler(message)
    return opened


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
def _answer_own_pages_only(host: str, routes: Routes) -> Iterator[None]:
    """Make the server that viser starts meanwhile refuse requests that fail `is_own_page`, and
    answer `routes`.

    viser has no option for that: what it hands to websockets is changed on the way. Raises
    RuntimeError where it hands over nothing.
    """
    serve, guarded = server.serve, []

    def serve_own_pages(
        handle: Any, *arguments: Any, process_request: Any, **options: Any
    ) -> server.serve:
        def answer(connection: server.ServerConnection, request: Request) -> Response | None:
            if not is_own_page(request.headers, host):
                return connection.respond(HTTPStatus.FORBIDDEN, "for the viewer's own page only\n")
            if (content := routes.pages.get(request.path)) is not None:
                kind = Headers({"Content-Type": "text/html; charset=utf-8"})
                return Response(HTTPStatus.OK, "OK", kind, content)
            return process_request(connection, request)

        async def talk(connection: server.ServerConnection) -> None:
            assert connection.request is not None
            await routes.sockets.get(connection.request.path, handle)(connection)

        guarded.append(True)
        return serve(talk, *arguments, process_request=answer, **options)

    with patch.object(server, "serve", serve_own_pages):
        yield
    if not guarded:
        raise RuntimeError("this viser does not start its server through websockets.asyncio.server")


def require_own_address(option: str, host: str) -> None:
    """InputError where nothing can listen on `host`: viser would wait for ever."""
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as probe:
            probe.bind(address)
    except (OSError, UnicodeError) as error:
        raise InputError(
            f"{option}={host}: the page cannot be served there ({error}); leave it out for "
            f"{LOOPBACK}, or use 0.0.0.0 for all addresses of this machine"
        ) from None


def _is_number(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True
