"""HTTP server for an interactive page, its updates and its requests; the server reads no files."""

from __future__ import annotations

import ipaddress
import json
import os
import re
import socket
import sys
import threading
import time
import webbrowser
from collections.abc import Callable
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qs, urlsplit

from nerfro.core.errors import NerfroError

_WATCHED_SECONDS = 10.0  # a page counts as watched for so long after a request
# Placeholder until the page is complete; browsers reload the placeholder every two seconds.
_PLACEHOLDER = (
    b'<!DOCTYPE html><html lang="en"><meta charset="utf-8"><meta http-equiv="refresh" content="2"><title>nerfro</title>'
    b'<body style="background:#111;color:#eef1f5;font:1.1rem system-ui,sans-serif;padding:2rem"><h1>nerfro</h1>'
    b"<p>The page is being made, and appears here in a moment."
)

_FOREIGN, _NOT_FOUND = b"open the page by the address that nerfro has printed", b"this server has only the page at /"


def open_page(url: str) -> None:
    """Open a page in a graphical browser, or print how to reach the page from another machine over SSH."""
    if "SSH_CONNECTION" in os.environ:
        port = urlsplit(url).port
        print(f"nerfro: on your own machine, run ssh -L {port}:localhost:{port} HOST, and open {url}", flush=True)
    elif sys.platform != "linux" or {"DISPLAY", "WAYLAND_DISPLAY"} & os.environ.keys():
        webbrowser.open(url)


class PageServer:
    """Serves a page at `/`, its updates at `/state` and answers to its requests at `/answer`, in a background thread.

    The server answers requests of the page only: the header `Host` must name this machine, and the header `Origin` must
    be absent or name the page.

    Args:
        host: address of the server; `localhost` accepts connections from this machine only.
        port: port of the server; 0 for any free port.
        answer: converts the JSON value of a request (POST) to that of the answer. A `NerfroError` is sent as text.

    Attributes:
        ends: whether the answer to the present request is the last one.
        ended: set after the browser has received the last answer.
        outcome: sentence about the end of the training; None before.
        outcome_sent: set after a browser has received the outcome.

    Raises:
        NerfroError: the address is not available.
    """

    def __init__(self, host: str, port: int, answer: Callable[[Any], Any] | None = None) -> None:
        try:
            self._server = _QuietServer((host, port), self)
        except (OSError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or error
            raise NerfroError(f"{host}:{port} is not available ({reason}); give another port, or port 0") from error
        self.url = f"http://{host}:{self._server.server_address[1]}"
        self._lock, self._requests = threading.Lock(), threading.Lock()
        self._to_answer, self.ends, self.ended = answer, False, threading.Event()
        self.outcome: str | None = None
        self.outcome_sent = threading.Event()
        self._page, self._version, self._is_final = _PLACEHOLDER, 0, False
        # Versions and contents, as JSON.
        self._update, self._picture = (0, b"null"), (0, b"null")
        self._losses: list[tuple[int, dict[str, float]]] = []
        self._last_request = -_WATCHED_SECONDS
        threading.Thread(target=self._server.serve_forever, daemon=True, name="page server").start()

    @property
    def watched(self) -> bool:
        """Whether a browser has sent a request recently."""
        return time.monotonic() - self._last_request < _WATCHED_SECONDS

    def open(self, page: str, is_final: bool = False) -> None:
        """Replace the placeholder by the page; browsers with a live page offer to open a final one."""
        with self._lock:
            self._page, self._is_final = page.encode(), is_final

    def finish(self) -> None:
        """Make the answer to the present request the last one."""
        self.ends = True

    def publish(self, scene: dict[str, Any], arrays: dict[str, str]) -> None:
        """Send changed numbers and arrays to the browsers that show the page."""
        with self._lock:
            self._version += 1
            self._update = self._version, json.dumps({"scene": scene, "arrays": arrays}).encode()

    def add_losses(self, step: int, losses: dict[str, float]) -> None:
        """Append a point to the training curves, which have names."""
        with self._lock:
            self._losses.append((step, losses))

    def show_validation(self, step: int, uri: str) -> None:
        """Show a picture of a validation view."""
        with self._lock:
            self._version += 1
            self._picture = self._version, json.dumps({"step": step, "uri": uri}).encode()

    def complete(self, outcome: str) -> None:
        """Tell the browsers that the training has ended, and wait a few seconds until one that watches knows."""
        with self._lock:
            self.outcome = outcome
        if self.watched:
            self.outcome_sent.wait(5.0)  # a browser asks for the state every two seconds

    def page(self) -> bytes:
        return self._page

    def state(self, after: int) -> bytes:
        """Return training curves, outcome, and the changes for a page of version `after`, as JSON."""
        self._last_request = time.monotonic()
        with self._lock:
            # The curve has at most 500 points.
            every = -(-len(self._losses) // 500) or 1
            # Counted from the end, because the page states the last loss.
            losses = json.dumps(self._losses[::-every][::-1]).encode()
            update, picture = (content if at > after else b"null" for at, content in (self._update, self._picture))
            end = json.dumps({"outcome": self.outcome, "final": self._is_final, "version": self._version}).encode()
        return end[:-1] + b', "losses": ' + losses + b', "update": ' + update + b', "picture": ' + picture + b"}"

    def answer(self, request: bytes) -> tuple[HTTPStatus, bytes]:
        """Answer a request of the page; requests are answered one after the other."""
        if self._to_answer is None:
            return HTTPStatus.NOT_FOUND, _NOT_FOUND
        with self._requests:
            try:
                return HTTPStatus.OK, json.dumps(self._to_answer(json.loads(request))).encode()
            except (NerfroError, ValueError, RecursionError) as error:  # the last two of requests that are not JSON
                return HTTPStatus.BAD_REQUEST, str(error).encode()

    def close(self) -> None:
        """Stop the server."""
        self._server.shutdown()
        self._server.server_close()


class _QuietServer(ThreadingHTTPServer):
    """A server that tolerates slow clients and lost connections."""

    request_queue_size = 128  # connections that wait; beyond, the system delays clients by a second or more

    def __init__(self, address: tuple[str, int], page: PageServer) -> None:
        super().__init__(address, _Handler)
        self.page = page

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Print no traceback of a connection that ends early, because the terminal shows the training."""
        if not isinstance(sys.exc_info()[1], OSError):
            super().handle_error(request, client_address)


class _Handler(BaseHTTPRequestHandler):
    server_version, sys_version = "nerfro", ""
    timeout = 10.0  # seconds after which the connection of a silent client is closed

    def do_GET(self) -> None:
        page: PageServer = self.server.page  # type: ignore[attr-defined]
        try:
            address = urlsplit(self.path)
        except ValueError:  # brackets that are not an IPv6 address
            address = urlsplit("invalid")
        if not self._is_same_origin():
            self._answer(HTTPStatus.FORBIDDEN, _FOREIGN, "text/plain")
        elif address.path == "/":
            self._answer(HTTPStatus.OK, page.page(), "text/html; charset=utf-8")
        elif address.path == "/state":
            after = parse_qs(address.query).get("after", ["0"])[0]
            version = int(after) if re.fullmatch(r"[0-9]{1,18}", after) else 0
            is_complete = page.outcome is not None
            self._answer(HTTPStatus.OK, page.state(version), "application/json")
            if is_complete:
                page.outcome_sent.set()
        else:
            self._answer(HTTPStatus.NOT_FOUND, _NOT_FOUND, "text/plain")

    def do_POST(self) -> None:
        page: PageServer = self.server.page  # type: ignore[attr-defined]
        length = self.headers.get("Content-Length", "")
        if not self._is_same_origin():
            self._answer(HTTPStatus.FORBIDDEN, _FOREIGN, "text/plain")
        elif self.path != "/answer":
            self._answer(HTTPStatus.NOT_FOUND, _NOT_FOUND, "text/plain")
        elif not re.fullmatch(r"[0-9]{1,9}", length) or int(length) > 2**22:
            self._answer(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, b"the request is too large", "text/plain")
        else:
            status, body = page.answer(self.rfile.read(int(length)))
            self._answer(status, body, "application/json" if status == HTTPStatus.OK else "text/plain; charset=utf-8")
            if page.ends:
                page.ended.set()

    def _is_same_origin(self) -> bool:
        """Check the headers of the request, to refuse pages of other origins and DNS rebinding."""
        host, origin = self.headers.get("Host", ""), self.headers.get("Origin")
        try:
            name = urlsplit(f"//{host}").hostname or ""
            if name not in ("localhost", socket.gethostname().lower()):
                ipaddress.ip_address(name)
        except ValueError:  # neither a name of this machine nor an address
            return False
        return origin in (None, f"http://{host}")

    def _answer(self, status: HTTPStatus, body: bytes, content_type: str) -> None:
        self.send_response(status)
        self.send_header("Content-Type", content_type)
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Cache-Control", "no-store")
        self.send_header("Cross-Origin-Resource-Policy", "same-origin")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *arguments: object) -> None:
        """Suppress the log, because the terminal shows the progress of the training."""
