"""An S3 server on loopback whose answers can be made to fail, be late or get lost."""

from __future__ import annotations

import itertools
import logging
import socket
import threading
import time
import urllib.request
from collections import Counter

BUCKET = "measurements"
KEY_ID, SECRET = "AKIDOFATEST", "the-secret-of-a-test"


class Server:
    """moto's S3 behind a layer that counts requests and does harm.

    `harm` takes method, path and number of a request, and returns None, a code that is answered instead of the
    server's, ``lost`` (done, and the connection is cut) or ``late`` (done, and answered after `late_s`).
    """

    late_s = 1.0

    def __init__(self):
        from moto.moto_api._internal import mock_random  # noqa: F401 (moto is whole only then)
        from moto.server import DomainDispatcherApplication, create_backend_app
        from werkzeug.serving import make_server

        logging.getLogger("werkzeug").setLevel(logging.ERROR)
        self._app = DomainDispatcherApplication(create_backend_app)
        self._server = make_server("127.0.0.1", 0, self, threaded=True)
        self.url = f"http://127.0.0.1:{self._server.server_port}"
        self.reset()
        threading.Thread(target=self._server.serve_forever, daemon=True).start()
        urllib.request.urlopen(urllib.request.Request(f"{self.url}/{BUCKET}", method="PUT")).close()

    def reset(self):
        self.harm = lambda method, path, n: None
        self.requests, self.harmed = [], Counter()
        self._numbers = itertools.count()

    def close(self):
        self._server.shutdown()

    def __call__(self, environ, start_response):
        method, path = environ["REQUEST_METHOD"], environ["PATH_INFO"]
        harm = self.harm(method, path, next(self._numbers))
        self.requests.append((method, path, environ.get("HTTP_AUTHORIZATION", "")))
        self.harmed[harm] += 1
        if harm and harm.isdigit():
            environ["wsgi.input"].read(int(environ.get("CONTENT_LENGTH") or 0))
            start_response(f"{harm} Harm", [("Content-Type", "application/xml")])
            return [f"<Error><Code>Harm</Code><AWSAccessKeyId>{KEY_ID}</AWSAccessKeyId></Error>".encode()]
        answer = self._app(environ, start_response)
        if harm == "late":
            time.sleep(self.late_s)
        if harm == "lost":
            content = b"".join(answer)
            environ["werkzeug.socket"].shutdown(socket.SHUT_RDWR)
            return [content]
        return answer


def in_turn(*kinds):
    """Let each request suffer all of these, one after the other, before it comes through."""
    seen = Counter()

    def harm(method, path, n):
        seen[method, path] += 1
        return kinds[seen[method, path] - 1] if seen[method, path] <= len(kinds) else None

    return harm


def once(part, kind, method="PUT"):
    """Let the first request suffer whose path has a part."""
    left = [kind]
    return lambda m, path, n: left.pop() if left and m == method and part in path else None
