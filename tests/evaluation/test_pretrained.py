import hashlib
import http.server
import io
import socket
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st

from nerfro.evaluation.perceptual import pretrained
from nerfro.registry.registration import discover
from tests.conftest import refused

discover()
ALEXNET, load_weights, unreachable = pretrained.ALEXNET, pretrained.load_weights, pretrained.unreachable

WEIGHTS = {"features.0.weight": torch.arange(6.0)}


def weights_file() -> bytes:
    stream = io.BytesIO()
    torch.save(WEIGHTS, stream)
    return stream.getvalue()


class Site(http.server.BaseHTTPRequestHandler):
    """Answers every address with the weights; below /stalling/ only with the first half of them."""

    content = weights_file()
    closing = threading.Event()

    def do_HEAD(self) -> None:
        self.send_response(200)
        self.send_header("Content-Length", str(len(self.content)))
        self.end_headers()

    def do_GET(self) -> None:
        self.do_HEAD()
        if self.path.startswith("/stalling/"):
            self.wfile.write(self.content[: len(self.content) // 2])
            self.closing.wait(timeout=20)
        else:
            self.wfile.write(self.content)

    def log_message(self, format: str, *arguments: object) -> None:
        pass


@pytest.fixture
def site() -> Iterator[str]:
    Site.closing.clear()
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Site) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}"
        Site.closing.set()
        server.shutdown()
        thread.join()


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """An empty cache of torch hub."""
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    unreachable.cache_clear()
    yield tmp_path / "hub" / "checkpoints"
    unreachable.cache_clear()


def cached_alexnet() -> Path:
    folder = Path(torch.hub.get_dir(), "checkpoints")
    folder.mkdir(parents=True, exist_ok=True)
    return folder / ALEXNET.rpartition("/")[2]


def right_name() -> str:
    return f"alexnet-{hashlib.sha256(Site.content).hexdigest()[:8]}.pth"


def assert_same(weights: dict[str, torch.Tensor]) -> None:
    assert weights.keys() == WEIGHTS.keys()
    torch.testing.assert_close(weights["features.0.weight"], WEIGHTS["features.0.weight"])


def test_weights_are_fetched_once_and_then_read_from_the_cache(
    site: str, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    url = f"{site}/{right_name()}"
    assert_same(load_weights(url))
    assert (cache / right_name()).is_file()
    monkeypatch.setattr(pretrained, "unreachable", None)  # not asked again
    assert_same(load_weights(url))


def test_weights_with_another_hash_are_refused_and_not_kept(site: str, cache: Path) -> None:
    refused("hash", load_weights, f"{site}/alexnet-00000000.pth")
    assert list(cache.iterdir()) == []


def test_stalled_download_times_out_and_leaves_no_file(site: str, cache: Path, monkeypatch) -> None:
    monkeypatch.setattr(pretrained, "STALL_SECONDS", 0.3)
    refused("timed out", load_weights, f"{site}/stalling/{right_name()}")
    assert list(cache.iterdir()) == []
    assert socket.getdefaulttimeout() is None


def test_silent_host_times_out() -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:
        url = f"http://127.0.0.1:{silent.getsockname()[1]}/alexnet-00000000.pth"
        assert unreachable(url, seconds=0.3) in ("no answer within 0.3 s", "timed out")


@given(text=st.text(max_size=200))
@example(text="")
@example(text="(lp0\n.")  # pickles, of the first protocol
@example(text="cos\nsystem\n(S'true'\ntR.")
@example(text="\x80\x02]q\x00.")
@example(text="PK\x03\x04")  # the beginning of a zip file
def test_text_file_is_refused_with_advice(text: str) -> None:
    cached = cached_alexnet()
    cached.write_text(text, encoding="latin-1", errors="replace")
    message = refused(rf"AlexNet weights {cached} .*; delete them to fetch them again", load_weights)
    assert "weights_only" not in message
