"""Who reaches the viewer: this machine, and no other web page than its own."""

import socket
import sys
from collections.abc import Iterator

import pytest

from extrap_train.errors import InputError
from extrap_train.reconstruction.viewer import CloudViewer

viser = pytest.importorskip("viser", reason="needs viser: the extra `viewer`")

OTHER_LOOPBACK = "127.0.0.2"
"""Linux answers there whatever listens on all addresses."""


@pytest.fixture(scope="module")
def viewer() -> Iterator[CloudViewer]:
    with CloudViewer(port=8931) as opened:
        yield opened


def _status(viewer: CloudViewer, *headers: str) -> int:
    """Status of the answer to a websocket's opening handshake with these headers."""
    lines = [
        "GET / HTTP/1.1",
        *headers,
        "Connection: Upgrade",
        "Upgrade: websocket",
        "Sec-WebSocket-Version: 13",
        "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==",
        f"Sec-WebSocket-Protocol: viser-v{viser.__version__}",
    ]
    with socket.create_connection(("127.0.0.1", viewer.port), timeout=20) as connection:
        connection.sendall("\r\n".join([*lines, "", ""]).encode())
        return int(connection.recv(100).split()[1])


@pytest.mark.parametrize("name", ["localhost", "127.0.0.1", "[::1]", socket.gethostname()])
def test_its_own_page_is_answered(viewer, name):
    address = f"{name}:{viewer.port}"
    assert _status(viewer, f"Host: {address}", f"Origin: http://{address}") == 101


def test_a_tunnel_to_it_is_answered(viewer):
    assert _status(viewer, "Host: localhost:9000", "Origin: http://localhost:9000") == 101


def test_a_program_that_is_no_browser_is_answered(viewer):
    assert _status(viewer, f"Host: localhost:{viewer.port}") == 101


@pytest.mark.parametrize(
    "origin",
    [
        "http://evil.example",
        "https://evil.example:{port}",
        "http://localhost:1",
        "http://127.0.0.1.evil.example:{port}",
        "http://localhost@evil.example:{port}",
        "null",
        "file://",
        "http://[::1",
        "",
    ],
)
def test_a_foreign_page_is_refused(viewer, origin):
    origin = origin.format(port=viewer.port)
    assert _status(viewer, f"Host: localhost:{viewer.port}", f"Origin: {origin}") == 403


def test_a_foreign_name_that_leads_here_is_refused(viewer):
    for name in (f"evil.example:{viewer.port}", f"localhost.evil.example:{viewer.port}"):
        assert _status(viewer, f"Host: {name}", f"Origin: http://{name}") == 403


def test_two_origins_are_refused(viewer):
    own = f"localhost:{viewer.port}"
    two = (f"Origin: http://{own}", "Origin: http://evil.example")
    assert _status(viewer, f"Host: {own}", *two) == 403


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux has this address without setup")
def test_other_addresses_only_where_asked_for(viewer):
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection((OTHER_LOOPBACK, viewer.port), timeout=5)
    with (
        CloudViewer(port=8941, host="0.0.0.0") as everywhere,
        socket.create_connection((OTHER_LOOPBACK, everywhere.port), timeout=5),
    ):
        own = f"Host: evil.example:{everywhere.port}"
        assert _status(everywhere, own, f"Origin: http://evil.example:{everywhere.port}") == 403


@pytest.mark.parametrize("host", ["192.0.2.1", "no such host", "a" * 300, "::zz"])
def test_an_address_that_is_not_this_machines_is_refused(host):
    with pytest.raises(InputError, match=r"complete\.host"):
        CloudViewer(port=8951, host=host)
