"""An object store on the loopback: moto's S3 server, whose answers can be cut short."""

import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import fsspec
import pytest

SECRET = "n0b0dyKn0ws"


@dataclass
class ObjectStore:
    """A bucket and what was asked of its server."""

    app: Any
    url: str = "s3://bucket"
    fetched: list[str] = field(default_factory=list)
    """Shards whose content was asked for, in their order."""
    cuts: int = 0
    """How many of the next answers with a shard's content break off halfway."""

    def __call__(self, environ: dict[str, Any], start_response: Any) -> Iterable[bytes]:
        content = b"".join(self.app(environ, start_response))
        if environ["REQUEST_METHOD"] == "GET" and "/files/" in environ["PATH_INFO"]:
            self.fetched.append(environ["PATH_INFO"].rsplit("/", 1)[1])
            if self.cuts:
                self.cuts -= 1
                return [content[: len(content) // 2]]
        return [content]


@contextmanager
def serve_objects() -> Iterator[ObjectStore]:
    """Run the server, to which the environment leads while it does; skips where it is missing."""
    pytest.importorskip("s3fs", reason="needs s3fs: the extra `s3`")
    pytest.importorskip("moto.server", reason="needs moto and flask: the extra `dev`")
    from moto.moto_server.werkzeug_app import (
        DomainDispatcherApplication,
        MotoRequestHandler,
        create_backend_app,
    )
    from werkzeug.serving import make_server

    store = ObjectStore(DomainDispatcherApplication(create_backend_app))
    server = make_server("127.0.0.1", 0, store, True, request_handler=MotoRequestHandler)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    settings = {
        "AWS_ENDPOINT_URL": f"http://127.0.0.1:{server.port}",
        "AWS_ACCESS_KEY_ID": "some",
        "AWS_SECRET_ACCESS_KEY": SECRET,
        "AWS_DEFAULT_REGION": "us-east-1",
        "NO_PROXY": "127.0.0.1",
    }
    with pytest.MonkeyPatch.context() as patch:
        for name, value in settings.items():
            patch.setenv(name, value)
        thread.start()
        try:
            bucket = fsspec.filesystem("s3")
            if bucket.exists("bucket"):  # moto keeps it for the next server of the same process
                bucket.rm("bucket", recursive=True)
            bucket.mkdir("bucket")
            yield store
        finally:
            server.shutdown()
            thread.join()
            server.server_close()
            fsspec.filesystem("s3").clear_instance_cache()
