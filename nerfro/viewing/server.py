"""A page on one port of this machine, and what has changed since it was opened; no file is read for an answer."""

from __future__ import annotations

import ipaddress
import json
import socket
import threading
import time
from collections.abc import Sequence
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qs, urlsplit

from nerfro.errors import NerfroError

_WATCHED = 10.0  # seconds for which a browser that has asked is thought to look
_LOSSES = 500  # points of the curve, at most; twice as many are thinned out
# What a browser sees that comes before the page is made; it asks again by itself.
_SOON = b'<!DOCTYPE html><meta http-equiv="refresh" content="2"><title>nerfro</title><p>The page is being made.'


class PageServer:
    """Serves a page at `/` and its news at `/state`, in a thread of its own.

    A browser's requests are answered if they come from the page itself: by an address or a name of this machine
    (`Host`), and from no page of another origin (`Origin`).

    Args:
        host: address to listen at; `localhost` for this machine alone.
        port: to listen at; 0 for any that is free.

    Raises:
        NerfroError: nobody can listen there.
    """

    def __init__(self, host: str, port: int) -> None:
        try:
            self._server = ThreadingHTTPServer((host, port), _Handler)
        except (OSError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or error
            raise NerfroError(f"{host}:{port} cannot be served on ({reason}); give another port, or port 0") from error
        self._server.daemon_threads = True
        self._server.page = self  # type: ignore[attr-defined]
        self.url = f"http://{host}:{self._server.server_address[1]}"
        self._lock = threading.Lock()
        self._page, self._news, self._version = _SOON, b"null", 0
        self._losses: list[tuple[int, float]] = []
        self._asked = -_WATCHED
        threading.Thread(target=self._server.serve_forever, daemon=True, name="page server").start()

    @property
    def watched(self) -> bool:
        """Whether a browser has asked within the last seconds."""
        return time.monotonic() - self._asked < _WATCHED

    def open(self, page: str) -> None:
        """Show a page to browsers that come."""
        with self._lock:
            self._page = page.encode()

    def publish(self, scene: dict[str, Any], arrays: dict[str, str]) -> None:
        """Tell the browsers that are there: facts and arrays of the page that are others now."""
        with self._lock:
            self._version += 1
            self._news = json.dumps({"scene": {**scene, "version": self._version}, "arrays": arrays}).encode()

    def add_loss(self, step: int, loss: float) -> None:
        """One more point of the curve."""
        with self._lock:
            self._losses.append((step, loss))
            if len(self._losses) > 2 * _LOSSES:
                self._losses = self._losses[::2]

    def show_losses(self, losses: Sequence[tuple[int, float]]) -> None:
        """The curve so far: optimisation steps and losses."""
        every = -(-len(losses) // _LOSSES) or 1
        with self._lock:
            # Counted from the end, which is told in words.
            self._losses = list(losses)[::-every][::-1]

    def page(self) -> bytes:
        return self._page

    def state(self, after: int) -> bytes:
        """What a page of version `after` does not know, as JSON."""
        self._asked = time.monotonic()
        with self._lock:
            losses = json.dumps(self._losses).encode()
            news = self._news if self._version > after else b"null"
        return b'{"losses": ' + losses + b', "news": ' + news + b"}"

    def close(self) -> None:
        """Answer nobody any more."""
        self._server.shutdown()
        self._server.server_close()


class _Handler(BaseHTTPRequestHandler):
    server_version, sys_version = "nerfro", ""

    def do_GET(self) -> None:
        shown: PageServer = self.server.page  # type: ignore[attr-defined]
        address = urlsplit(self.path)
        if not self._of_this_page():
            self._answer(HTTPStatus.FORBIDDEN, b"this page is for browsers that were given its address", "text/plain")
        elif address.path == "/":
            self._answer(HTTPStatus.OK, shown.page(), "text/html; charset=utf-8")
        elif address.path == "/state":
            after = parse_qs(address.query).get("after", ["0"])[0]
            known = int(after) if after.isascii() and after.isdigit() else 0
            self._answer(HTTPStatus.OK, shown.state(known), "application/json")
        else:
            self._answer(HTTPStatus.NOT_FOUND, b"there is nothing here but the page", "text/plain")

    def _of_this_page(self) -> bool:
        """A name that leads here from elsewhere (DNS rebinding) and pages of other origins are refused."""
        host, origin = self.headers.get("Host", ""), self.headers.get("Origin")
        try:
            name = urlsplit(f"//{host}").hostname
        except ValueError:  # no address at all
            return False
        return _names_this_machine(name) and origin in (None, f"http://{host}")

    def _answer(self, status: HTTPStatus, body: bytes, kind: str) -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Cache-Control", "no-store")
        self.send_header("Cross-Origin-Resource-Policy", "same-origin")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *arguments: object) -> None:
        """Say nothing: the terminal belongs to the training."""


def _names_this_machine(name: str | None) -> bool:
    if name in ("localhost", socket.gethostname().lower()):
        return True
    try:
        ipaddress.ip_address(name or "")
    except ValueError:
        return False
    return True
