"""A Hugging Face hub on loopback: the few routes that pushing and pulling need, files in memory."""

from __future__ import annotations

import base64
import hashlib
import json
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

TOKEN = "hf_" + "fake" * 8
COMMIT = "c" * 40


class FakeHub(ThreadingHTTPServer):
    """Serve repositories of models; `repos` holds each one's files, `private` those nobody may see."""

    daemon_threads = True

    def __init__(self):
        super().__init__(("127.0.0.1", 0), Handler)
        self.repos: dict[str, dict[str, bytes]] = {}
        self.made: list[dict] = []
        self.commits: list[str] = []
        self.large: dict[str, bytes] = {}
        self.read_only: set[str] = set()
        threading.Thread(target=self.serve_forever, daemon=True).start()

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_port}"


class Handler(BaseHTTPRequestHandler):
    server: FakeHub
    protocol_version = "HTTP/1.1"

    def log_message(self, *args):
        pass

    def do_POST(self):
        body = self._body()
        path = self.path.split("?")[0]
        if not path.endswith(".git/info/lfs/objects/batch") and not self._is_known():
            return self._answer(401, {"error": "Invalid user token."})

        if path == "/api/repos/create":
            return self._create(json.loads(body))
        if path.endswith("/batch"):
            return self._batch(json.loads(body))
        if path == "/api/validate-yaml":
            errors = [{"message": '"license" must be one of [mit]'}] if b"license: foo" in body else []
            return self._answer(400 if errors else 200, {"errors": errors, "warnings": []})

        repo = "/".join(path.split("/")[3:5])
        if repo not in self.server.repos:
            return self._answer(404, {"error": "not found"}, {"X-Error-Code": "RepoNotFound"})
        if "/preupload/" in path:
            files = [
                {"path": file["path"], "shouldIgnore": False, "uploadMode": _mode(file["path"])}
                for file in json.loads(body)["files"]
            ]
            return self._answer(200, {"files": files})
        return self._commit(repo, body)

    def do_PUT(self):
        oid, body = self.path.rsplit("/", 1)[1], self._body()
        assert hashlib.sha256(body).hexdigest() == oid
        self.server.large[oid] = body
        self._answer(200, {})

    def do_GET(self):
        parts = self.path.split("?")[0].strip("/").split("/")
        is_api = parts[0] == "api"
        repo = "/".join(parts[2:4] if is_api else parts[:2])
        files = self.server.repos.get(repo)
        if files is None:
            return self._answer(404, {"error": "not found"}, {"X-Error-Code": "RepoNotFound"})

        revision = parts[5] if is_api and len(parts) > 5 else "main" if is_api else parts[3]
        if revision not in ("main", COMMIT):
            return self._answer(404, {"error": "no"}, {"X-Error-Code": "RevisionNotFound"})
        if is_api:
            siblings = [{"rfilename": name} for name in files]
            return self._answer(200, {"id": repo, "sha": COMMIT, "siblings": siblings})

        name = "/".join(parts[4:])
        tag = hashlib.sha256(files[name]).hexdigest()
        self._send(200, files[name], {"X-Repo-Commit": COMMIT, "ETag": f'"{tag}"'})

    do_HEAD = do_GET

    def _create(self, wanted):
        repo = f"{wanted['organization']}/{wanted['name']}"
        if wanted["organization"] in self.server.read_only:
            return self._answer(403, {"error": "You don't have the rights"})
        url = {"url": f"{self.server.url}/{repo}"}
        if repo in self.server.repos:
            return self._answer(409, {"error": "exists"} | url)
        self.server.made.append(wanted)
        self.server.repos[repo] = {}
        self._answer(200, url)

    def _batch(self, wanted):
        objects = [
            {**item, "actions": {"upload": {"href": f"{self.server.url}/lfs/{item['oid']}"}}}
            for item in wanted["objects"]
        ]
        self._answer(200, {"transfer": "basic", "objects": objects})

    def _commit(self, repo, body):
        for line in body.decode().splitlines():
            entry = json.loads(line)
            value = entry["value"]
            if entry["key"] == "header":
                self.server.commits.append(value["summary"])
            elif entry["key"] == "file":
                self.server.repos[repo][value["path"]] = base64.b64decode(value["content"])
            else:
                self.server.repos[repo][value["path"]] = self.server.large[value["oid"]]
        url = f"{self.server.url}/{repo}/commit/{COMMIT}"
        self._answer(200, {"commitUrl": url, "commitOid": COMMIT})

    def _is_known(self):
        return self.headers.get("Authorization") == f"Bearer {TOKEN}"

    def _body(self):
        if self.headers.get("Transfer-Encoding") != "chunked":
            return self.rfile.read(int(self.headers.get("Content-Length", 0)))
        body = b""
        while size := int(self.rfile.readline(), 16):
            body += self.rfile.read(size)
            self.rfile.readline()
        self.rfile.readline()
        return body

    def _answer(self, status, content, headers=None):
        headers = {"Content-Type": "application/json", **(headers or {})}
        self._send(status, json.dumps(content).encode(), headers)

    def _send(self, status, data, headers):
        self.send_response(status)
        for name, value in {**headers, "Content-Length": str(len(data))}.items():
            self.send_header(name, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(data)


def _mode(path: str) -> str:
    return "regular" if path.endswith(".md") else "lfs"
