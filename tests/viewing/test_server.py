"""The page's server answers the page's own browser alone, and reads no files."""

from __future__ import annotations

import http.client
import json
from collections.abc import Iterator

import pytest

from nerfro.viewing.server import PageServer


@pytest.fixture
def server() -> Iterator[PageServer]:
    server = PageServer("localhost", 0)
    yield server
    server.close()


def get(server: PageServer, path: str, **headers: str) -> tuple[int, str]:
    connection = http.client.HTTPConnection("localhost", int(server.url.rpartition(":")[2]), timeout=10)
    connection.request("GET", path, headers=headers)
    answer = connection.getresponse()
    return answer.status, answer.read().decode()


def test_page_and_its_news(server: PageServer) -> None:
    assert "being made" in get(server, "/")[1]
    server.open("<p>page")
    assert get(server, "/") == (200, "<p>page")
    assert not server.watched
    assert json.loads(get(server, "/state?after=0")[1]) == {"losses": [], "news": None}
    assert server.watched
    server.add_loss(3, 0.5)
    server.publish({"volume": {"step": 1}}, {"sky": "data:,"})
    state = json.loads(get(server, "/state?after=0")[1])
    assert state["losses"] == [[3, 0.5]]
    assert state["news"] == {"scene": {"volume": {"step": 1}, "version": 1}, "arrays": {"sky": "data:,"}}
    assert json.loads(get(server, "/state?after=1")[1])["news"] is None


def test_a_long_curve_is_thinned_and_keeps_its_end(server: PageServer) -> None:
    server.set_losses([(step, 1 / (step + 1)) for step in range(0, 12340, 10)])
    server.add_loss(12340, 0.5)
    losses = json.loads(server.state(0))["losses"]
    assert 300 < len(losses) <= 500
    assert losses[-1] == [12340, 0.5]
    assert [step for step, _ in losses] == sorted(step for step, _ in losses)
    server.set_losses([])
    assert json.loads(server.state(0))["losses"] == []


@pytest.mark.parametrize("path", ["/../pyproject.toml", "/etc/passwd", "/%2e%2e/pyproject.toml", "/index.html"])
def test_nothing_else_is_served(server: PageServer, path: str) -> None:
    assert get(server, path)[0] == 404


def test_other_origins_are_refused(server: PageServer) -> None:
    port = server.url.rpartition(":")[2]
    for host in ("evil.example", f"evil.example:{port}", "localhost.evil.example", "[", ""):
        assert get(server, "/", Host=host)[0] == 403
        assert get(server, "/state", Host=host)[0] == 403
    for origin in ("http://evil.example", "null", f"http://localhost:{int(port) + 1}", f"https://localhost:{port}"):
        assert get(server, "/state", Origin=origin)[0] == 403
    assert get(server, "/state", Origin=f"http://localhost:{port}")[0] == 200
    assert get(server, "/", Host=f"127.0.0.1:{port}")[0] == 200
    assert get(server, "/", Host=f"[::1]:{port}")[0] == 200
