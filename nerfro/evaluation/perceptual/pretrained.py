"""ImageNet weights of AlexNet, from the cache of torch hub or a download."""

from __future__ import annotations

import functools
import http.client
import pickle
import socket
import threading
import urllib.request
from pathlib import Path

import torch
from torch import Tensor

from nerfro.core.errors import NerfroError

CONNECT_SECONDS = 5.0
STALL_SECONDS = 30.0
# 233 MB. The file name ends in the first digits of the SHA-256 hash, which is verified.
ALEXNET = "https://download.pytorch.org/models/alexnet-owt-7be5be79.pth"


def load_weights(url: str = ALEXNET) -> dict[str, Tensor]:
    """Load a state dict on the CPU, without executing pickled code.

    A missing file is downloaded into the cache, `torch.hub.get_dir()/checkpoints`, which respects TORCH_HOME. If the
    server does not answer within five seconds, no further attempt is made in this process.

    Args:
        url: address of the weights.

    Raises:
        NerfroError: the file cannot be read, or the weights are not cached and cannot be downloaded.
    """
    cached = Path(torch.hub.get_dir()) / "checkpoints" / url.rsplit("/", 1)[-1]
    if cached.is_file():
        return _read(cached)
    by_hand = f"download {url} to {cached}"
    reason = unreachable(url)
    if reason:
        raise NerfroError(
            f"no weights; AlexNet is not in the cache of torch, and there is no network ({reason}): {by_hand}"
        )
    before = socket.getdefaulttimeout()
    # torch hub opens the address without a timeout and could wait for ever.
    socket.setdefaulttimeout(STALL_SECONDS)
    try:
        return torch.hub.load_state_dict_from_url(url, map_location="cpu", check_hash=True, weights_only=True)
    except (OSError, http.client.HTTPException, RuntimeError) as error:  # RuntimeError: torch hub on a wrong hash
        raise NerfroError(f"the download of AlexNet weights failed ({error}); {by_hand}") from error
    finally:
        socket.setdefaulttimeout(before)


@functools.lru_cache
def unreachable(url: str, seconds: float = CONNECT_SECONDS) -> str:
    """Return the reason why an address does not answer, or an empty string if it answers.

    The timeout of a socket limits neither name resolution nor the number of addresses that are tried. Therefore the
    attempt runs in a thread, which is abandoned after the time limit.
    """
    reasons = [f"no answer within {seconds:g} s"]

    def connect() -> None:
        try:
            urllib.request.urlopen(urllib.request.Request(url, method="HEAD"), timeout=seconds).close()
            reasons.append("")
        except (OSError, http.client.HTTPException) as error:  # URLError, HTTPError and timeouts are OSErrors
            cause = getattr(error, "reason", error)
            reasons.append(getattr(cause, "strerror", None) or str(cause))

    thread = threading.Thread(target=connect, daemon=True)
    thread.start()
    thread.join(seconds)
    return reasons[-1]


def _read(path: Path) -> dict[str, Tensor]:
    advice = "delete them to fetch them again"
    try:
        weights = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch.load raises almost any exception on a foreign file
        reason = type(error).__name__ if isinstance(error, pickle.UnpicklingError) else str(error).partition("\n")[0]
        raise NerfroError(f"AlexNet weights {path} cannot be read ({reason}); {advice}") from error
    if not isinstance(weights, dict) or not all(isinstance(value, Tensor) for value in weights.values()):
        raise NerfroError(f"AlexNet weights {path} are not a state dict; {advice}")
    return weights
