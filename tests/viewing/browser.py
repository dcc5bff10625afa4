"""Headless Chromium with software WebGL2, driven with real pointers, touches, keys and dropped files.

Commands use the DevTools protocol through a pair of pipes (https://chromedevtools.github.io/devtools-protocol).
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import time
from pathlib import Path
from types import TracebackType
from typing import Any

import pytest

needs_chromium = pytest.mark.skipif(shutil.which("chromium") is None, reason="Chromium is not installed")
_OPTIONS = ("--headless=new", "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader",
            "--enable-unsafe-swiftshader", "--hide-scrollbars", "--touch-events=enabled",
            "--remote-debugging-pipe")  # fmt: skip
# `encode` writes an array of numbers as text, and `shot` the picture of the canvas after one ray a pixel of camera
# `number`, bottom row first.
SHOT = """
const encode = (numbers) => {
  const bytes = new Uint8Array(numbers.buffer);
  let text = "";
  for (let i = 0; i < bytes.length; i += 8192) text += String.fromCharCode(...bytes.subarray(i, i + 8192));
  return btoa(text);
};
const shot = (number, size) => {
  const { gl, canvas } = page.tracer;
  canvas.width = canvas.height = size;
  page.camera = number;
  page.drawOnce();
  const pixels = new Uint8Array(4 * size * size);
  gl.readPixels(0, 0, size, size, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
  return encode(pixels);
};
"""


class Browser:
    """One page in a browser of its own. At the end, the page must not have written to the console.

    Args:
        page: address or content of the page.
        folder: folder for temporary files.
        options: further options of the command line.
        size: size of the window in pixels.

    Attributes:
        pid: number of the process of the browser.
    """

    def __init__(self, page: str, folder: Path, *options: str, size: tuple[int, int] = (900, 600)) -> None:
        if not page.startswith(("http:", "file:")):
            (folder / "page.html").write_text(page, encoding="utf-8")
            page = (folder / "page.html").as_uri()
        to_browser, self._write = os.pipe()
        self._read, from_browser = os.pipe()
        shell = f'exec chromium "$@" 3<&{to_browser} 4>&{from_browser}'
        folders = f"--user-data-dir={folder / 'profile'}", f"--window-size={size[0]},{size[1]}"
        self._browser = subprocess.Popen(
            ["bash", "-c", shell, "chromium", *_OPTIONS, *folders, *options, "about:blank"],
            pass_fds=(to_browser, from_browser),
            stderr=subprocess.DEVNULL,
        )
        self.pid = self._browser.pid
        os.close(to_browser)
        os.close(from_browser)
        self._number, self._left = 0, b""
        self._session: str | None = None
        self._console: list[str] = []
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        self.call("Runtime.enable")
        self.call("Page.enable")
        self.call("Page.navigate", url=page)
        while self._receive().get("method") != "Page.loadEventFired":
            pass
        self.wait_for("!document.body?.hasAttribute('data-loading')")

    def __enter__(self) -> Browser:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._browser.terminate()
        self._browser.wait(30)
        os.close(self._write)
        os.close(self._read)
        assert error is not None or self._console == []

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Send a command of the protocol and return the answer."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": parameters}
        if self._session is not None:
            message["sessionId"] = self._session
        os.write(self._write, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._receive()
            if answer.get("id") == self._number:
                assert "error" not in answer, answer
                return answer["result"]

    def evaluate(self, expression: str) -> Any:
        """Evaluate an expression in the page."""
        found = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in found, found
        return found["result"].get("value")

    def wait_for(self, condition: str, seconds: float = 60) -> None:
        """Wait until an expression is true."""
        deadline = time.monotonic() + seconds
        while not self.evaluate(condition):
            assert time.monotonic() < deadline, condition
            time.sleep(0.05)

    def findings(self) -> list[str]:
        """Return the problems of accessibility that axe-core finds, each as one line; the worst ones are `critical`.

        Source:
            https://github.com/dequelabs/axe-core
        """
        folders = map(Path, os.environ.get("NODE_PATH", "").split(os.pathsep))
        axe = next(
            (file for file in (folder / "axe-core" / "axe.min.js" for folder in folders) if file.is_file()), None
        )
        if axe is None:
            pytest.skip("axe-core is not installed: npm install axe-core, and set NODE_PATH")
        self.evaluate(axe.read_text(encoding="utf-8") + "\n0")
        return self.evaluate("""axe.run().then(({ violations }) => violations.flatMap(({ id, impact, nodes }) =>
          nodes.map(({ target, any }) => `${impact} ${id}: ${target} ${any[0]?.message ?? ""}`)))""")

    def drag(self, start: tuple[float, float], end: tuple[float, float], button: str = "left") -> None:
        """Press a button, move, and release the button."""
        buttons = {"left": 1, "right": 2}[button]
        named = {"button": button, "buttons": buttons, "clickCount": 1}
        self.call("Input.dispatchMouseEvent", type="mousePressed", x=start[0], y=start[1], **named)
        for share in (0.5, 1.0):
            x, y = (a + share * (b - a) for a, b in zip(start, end, strict=True))
            self.call("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y, **named)
        named["buttons"] = 0
        self.call("Input.dispatchMouseEvent", type="mouseReleased", x=end[0], y=end[1], **named)

    def wheel(self, at: tuple[float, float], down: float) -> None:
        self.call("Input.dispatchMouseEvent", type="mouseWheel", x=at[0], y=at[1], deltaX=0, deltaY=down)

    def touch(self, *places: list[tuple[float, float]]) -> None:
        """Put fingers down at the first places, move them to the others one after another, and lift them."""
        for kind, fingers in zip(["touchStart", *["touchMove"] * (len(places) - 1)], places, strict=True):
            points = [{"x": x, "y": y, "id": number} for number, (x, y) in enumerate(fingers)]
            self.call("Input.dispatchTouchEvent", type=kind, touchPoints=points)
        self.call("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])

    def press(self, key: str) -> None:
        """Press a key, given as a character or by name."""
        named: dict[str, Any] = {"key": key, "windowsVirtualKeyCode": 32} if key == " " else {"key": key}
        text = {"text": key} if len(key) == 1 else {}
        self.call("Input.dispatchKeyEvent", type="keyDown", **named, **text)
        self.call("Input.dispatchKeyEvent", type="keyUp", **named)

    def drop(self, file: Path, at: tuple[float, float]) -> None:
        """Drag a file into the page and drop it."""
        data = {"items": [], "files": [str(file)], "dragOperationsMask": 1}
        for kind in ("dragEnter", "dragOver", "drop"):
            self.call("Input.dispatchDragEvent", type=kind, x=at[0], y=at[1], data=data)

    def _receive(self) -> dict[str, Any]:
        while b"\0" not in self._left:
            some = os.read(self._read, 1 << 16)
            assert some, "the browser has ended"
            self._left += some
        text, _, self._left = self._left.partition(b"\0")
        message = json.loads(text)
        if message.get("method") in ("Runtime.consoleAPICalled", "Runtime.exceptionThrown"):
            self._console.append(json.dumps(message["params"]))
        return message
