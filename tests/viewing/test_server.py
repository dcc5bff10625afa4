"""The server of the page answers only requests of the page, and reads no files."""

import http.client
import json
import random
import socket
import threading

import pytest

from nerfro.core.errors import NerfroError
from nerfro.viewing.server import PageServer, _Handler
from tests.conftest import refused


def get(server: PageServer, path: str, **headers: str) -> tuple[int, str]:
    connection = http.client.HTTPConnection("localhost", int(server.url.rpartition(":")[2]), timeout=10)
    connection.request("GET", path, headers=headers)
    answer = connection.getresponse()
    return answer.status, answer.read().decode()


def test_page_and_its_updates_are_served(server: PageServer) -> None:
    assert "being made" in get(server, "/")[1]
    server.open("<p>page")
    assert get(server, "/") == (200, "<p>page")
    assert not server.watched
    assert json.loads(get(server, "/state?after=0")[1]) == {
        "outcome": None, "final": False, "version": 0, "losses": [], "update": None, "picture": None,
    }  # fmt: skip
    assert server.watched
    server.add_losses(3, {"loss": 0.5})
    server.publish({"volume": {"step": 1}}, {"sky": "data:,"})
    state = json.loads(get(server, "/state?after=0")[1])
    assert state["losses"] == [[3, {"loss": 0.5}]]
    assert state["update"] == {"scene": {"volume": {"step": 1}}, "arrays": {"sky": "data:,"}}
    server.show_validation(3, "data:,")
    state = json.loads(get(server, f"/state?after={state['version']}")[1])
    assert (state["update"], state["picture"], state["version"]) == (None, {"step": 3, "uri": "data:,"}, 2)
    assert json.loads(get(server, "/state?after=2")[1])["picture"] is None


def test_end_of_a_training_waits_until_a_browser_knows(server: PageServer) -> None:
    server.complete("unwatched")  # returns at once
    assert not server.outcome_sent.is_set()
    assert json.loads(get(server, "/state")[1])["outcome"] == "unwatched"
    assert server.outcome_sent.wait(10)
    server.complete("PSNR 31.3 dB")
    server.open("<p>final", is_final=True)
    state = json.loads(get(server, "/state")[1])
    assert (state["outcome"], state["final"]) == ("PSNR 31.3 dB", True)


@pytest.mark.parametrize("path", ["/../pyproject.toml", "/etc/passwd", "/%2e%2e/pyproject.toml", "/index.html"])
def test_other_paths_are_not_served(server: PageServer, path: str) -> None:
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


def test_only_requests_of_the_page_are_answered() -> None:
    def answer(value: object) -> object:
        if value == "wrong":
            raise NerfroError("this is wrong")
        server.ends = True
        return [value]

    server = PageServer("localhost", 0, answer)
    address = server.url.removeprefix("http://")

    def post(body: str, path: str = "/answer", **headers: str) -> tuple[int, str]:
        connection = http.client.HTTPConnection(address, timeout=10)
        connection.request("POST", path, body, headers)
        found = connection.getresponse()
        return found.status, found.read().decode()

    for foreign in ({"Origin": "http://evil.example"}, {"Origin": "null"}, {"Host": "evil.example"}):
        assert post("3", **foreign)[0] == 403
    assert post("3", "/state")[0] == 404
    assert post("{")[0] == post("[" * 10**5)[0] == 400
    assert post("3", **{"Content-Length": str(2**30)})[0] == 413
    assert post('"wrong"') == (400, "this is wrong")
    assert not server.ended.is_set()
    assert post("3", Origin=server.url) == (200, "[3]")
    assert server.ended.wait(10)
    server.close()


def test_occupied_port_is_refused(server: PageServer) -> None:
    refused("is not available", PageServer, "localhost", int(server.url.rpartition(":")[2]))


def test_thousand_invalid_requests_do_not_change_the_page(
    server: PageServer, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(_Handler, "timeout", 0.5)
    server.open("<p>page" * 10**5)
    draw, port = random.Random(0), int(server.url.rpartition(":")[2])
    paths = ["/", "/state", "/state?after=" + "9" * 6000, "/../etc/passwd", "//[", "/%00", "/" + "a" * 70_000, "*", ""]
    heads = ["", "Host: evil.example\r\n", f"Host: localhost:{port}\r\nOrigin: null\r\n", f"Host: localhost:{port}\r\n"]
    clients = []
    for _ in range(1000):
        client = socket.create_connection(("localhost", port))
        method, path, head = draw.choice(["GET", "GET", "POST", "\0"]), draw.choice(paths), draw.choice(heads)
        request = f"{method} {path} HTTP/1.1\r\n{head}\r\n".encode()
        client.sendall(request[: draw.choice([len(request), len(request), draw.randrange(len(request))])])
        if draw.random() < 0.9:
            client.close()  # often before the answer
        else:
            clients.append(client)  # silent until the end
        if method == "GET" and draw.random() < 0.1:
            assert get(server, "/") == (200, "<p>page" * 10**5)
    threads = [thread for thread in threading.enumerate() if "process_request" in thread.name]
    for thread in threads:
        thread.join(10)
        assert not thread.is_alive()
    for client in clients:
        client.close()
    assert get(server, "/") == (200, "<p>page" * 10**5)
    assert capsys.readouterr().err == ""
