"""A headless Chromium that looks at a page: its developer protocol over a pipe, without any library."""

import base64
import fcntl
import json
import os
import shutil
import signal
from pathlib import Path
from typing import Any, Self

PROGRAM = shutil.which("chromium") or shutil.which("google-chrome")
FLAGS = (
    "--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--remote-debugging-pipe", "--hide-scrollbars",
    "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist",
)  # fmt: skip


class Browser:
    """Leave it by `with`."""

    def __init__(self, profile: Path, width: int = 1600, height: int = 1000) -> None:
        assert PROGRAM is not None
        theirs_in, self._out = os.pipe()
        self._in, theirs_out = os.pipe()
        # Chromium reads its third and writes its fourth file.
        high = [fcntl.fcntl(fd, fcntl.F_DUPFD_CLOEXEC, 10) for fd in (theirs_in, theirs_out)]
        null = os.open(os.devnull, os.O_RDWR | os.O_CLOEXEC)
        words = [PROGRAM, *FLAGS, f"--user-data-dir={profile}", f"--window-size={width},{height}", "about:blank"]
        files = [(os.POSIX_SPAWN_DUP2, fd, to) for fd, to in ((null, 1), (null, 2), (high[0], 3), (high[1], 4))]
        self._child = os.posix_spawn(PROGRAM, words, os.environ, file_actions=files)
        for fd in (theirs_in, theirs_out, *high, null):
            os.close(fd)
        self._unread, self._number, self._session = b"", 0, None
        target = self._do("Target.createTarget", url="about:blank")["targetId"]
        self._session = self._do("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]

    def open(self, address: str) -> None:
        """Returns when it is loaded."""
        self._do("Page.enable")
        self._do("Page.navigate", url=address)
        while self._heard().get("method") != "Page.loadEventFired":
            pass

    def screenshot(self) -> bytes:
        """What is to be seen now, PNG."""
        return base64.b64decode(self._do("Page.captureScreenshot", format="png")["data"])

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        os.kill(self._child, signal.SIGTERM)
        os.waitpid(self._child, 0)
        os.close(self._in)
        os.close(self._out)

    def _do(self, method: str, **parameters: Any) -> dict[str, Any]:
        self._number += 1
        words = {"id": self._number, "method": method, "params": parameters}
        words |= {"sessionId": self._session} if self._session else {}
        os.write(self._out, json.dumps(words).encode() + b"\0")
        while (answer := self._heard()).get("id") != self._number:
            pass
        assert "error" not in answer, answer["error"]
        return dict(answer["result"])

    def _heard(self) -> dict[str, Any]:
        """Its next answer, or event."""
        while b"\0" not in self._unread:
            read = os.read(self._in, 1 << 20)
            assert read, "the browser has ended"
            self._unread += read
        message, _, self._unread = self._unread.partition(b"\0")
        return dict(json.loads(message))
