"""A stand-in for the Hugging Face hub: what a push and a download use of its HTTP interface."""

import base64
import hashlib
import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Thread
from typing import Any
from urllib.parse import unquote, urlsplit

Files = dict[str, bytes]


class Hub:
    """Repositories with their commits, the newest last."""

    def __init__(self) -> None:
        self.commits: dict[str, dict[str, Files]] = {}
        self.private: set[str] = set()
        self.downloads: list[str] = []
        self.address = ""

    def add(self, repository: str, files: Files, removed: Sequence[str] = ()) -> str:
        """A commit with these files beside those of the last one that are not removed."""
        commits = self.commits.setdefault(repository, {})
        last = next(reversed(commits.values()), {})
        commit = hashlib.sha1(f"{repository}{len(commits)}".encode()).hexdigest()
        commits[commit] = {x: y for x, y in last.items() if x not in removed} | files
        return commit

    def newest(self, repository: str) -> tuple[str, Files]:
        """The last commit and its files."""
        return next(reversed(self.commits[repository].items()))

    def find(self, repository: str, revision: str) -> str | None:
        """The commit that a revision means."""
        commits = self.commits.get(repository, {})
        if revision == "main":
            return next(reversed(commits), None)
        return next((commit for commit in commits if commit == revision), None)


@contextmanager
def serve_hub() -> Iterator[Hub]:
    """The hub at `address`, as long as the block lasts."""
    hub = Hub()

    class Handler(_Handler):
        pass

    Handler.hub = hub
    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    hub.address = f"http://127.0.0.1:{server.server_port}"
    Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield hub
    finally:
        server.shutdown()
        server.server_close()


class _Handler(BaseHTTPRequestHandler):
    hub: Hub
    protocol_version = "HTTP/1.1"

    def log_message(self, *_: Any) -> None:
        pass

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
        words = self._words()
        if words == ["api", "repos", "create"]:
            said = json.loads(body)
            name = f"{said['organization']}/{said['name']}"
            if said.get("private") or said.get("visibility") == "private":
                self.hub.private.add(name)
            if name not in self.hub.commits:
                self.hub.add(name, {".gitattributes": b""})
            self._answer({"url": f"{self.hub.address}/{name}"})
        elif words == ["api", "validate-yaml"]:
            self._answer({"errors": [], "warnings": []})
        elif words[4:5] == ["preupload"]:
            files = json.loads(body)["files"]
            modes = {"uploadMode": "regular", "shouldIgnore": False}
            self._answer({"files": [{"path": file["path"], **modes} for file in files]})
        elif words[4:5] == ["commit"]:
            lines = [json.loads(line) for line in body.splitlines()]
            files = [line["value"] for line in lines if line["key"] == "file"]
            name = "/".join(words[2:4])
            removed = [x["value"]["path"] for x in lines if x["key"] == "deletedFile"]
            added = {x["path"]: base64.b64decode(x["content"]) for x in files}
            commit = self.hub.add(name, added, removed)
            url = f"{self.hub.address}/{name}/commit/{commit}"
            self._answer({"commitUrl": url, "commitOid": commit})
        else:
            self._answer({}, 404)

    def do_GET(self) -> None:
        words = self._words()
        api = words[:2] == ["api", "models"]
        if not api and words[2:3] != ["resolve"]:
            self._answer({}, 404)
            return
        name = "/".join(words[2:4] if api else words[:2])
        revision = (words[5] if len(words) > 5 else "main") if api else words[3]
        commit = self.hub.find(name, revision)
        if commit is None:
            known = name in self.hub.commits
            self._answer({}, 404, {"X-Error-Code": f"{'Revision' if known else 'Repo'}NotFound"})
            return
        files = self.hub.commits[name][commit]
        if not api:
            self._file(name, commit, "/".join(words[4:]), files)
        elif words[4:5] == ["tree"]:
            entry = {"type": "file", "oid": commit}
            self._answer([{**entry, "path": path, "size": len(files[path])} for path in files])
        else:
            self._answer({"id": name, "sha": commit, "siblings": [{"rfilename": x} for x in files]})

    do_HEAD = do_GET

    def _file(self, name: str, commit: str, path: str, files: Files) -> None:
        about = {"X-Repo-Commit": commit}
        if path not in files:
            self._answer({}, 404, {**about, "X-Error-Code": "EntryNotFound"})
            return
        if self.command == "GET":
            self.hub.downloads.append(f"{name}/{path}")
        etag = hashlib.sha1(files[path]).hexdigest()
        self._send(files[path], 200, {**about, "ETag": f'"{etag}"'})

    def _words(self) -> list[str]:
        return [unquote(word) for word in urlsplit(self.path).path.strip("/").split("/")]

    def _answer(
        self, content: Any, status: int = 200, headers: dict[str, str] | None = None
    ) -> None:
        kind = {"Content-Type": "application/json"}
        self._send(json.dumps(content).encode(), status, {**kind, **(headers or {})})

    def _send(self, body: bytes, status: int, headers: dict[str, str]) -> None:
        self.send_response(status)
        for key, value in {**headers, "Content-Length": str(len(body))}.items():
            self.send_header(key, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)
