"""Where does one look? The rerun program, in a window of its own or for a browser; on this host's loopback only."""

import contextlib
import importlib.util
import os
import socket
import subprocess
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Self
from urllib.parse import quote

from agent.interface import clock
from agent.interface.tables import BadExperiment
from deploy.leash import die_with

HOST = "127.0.0.1"
START_S = 30.0
MEMORY = "2GB"  # beyond it the oldest of a long live run is forgotten
LOG = Path("logs", "window.txt")  # of the program, in a run folder
POLITE = 10  # niceness: what is flown goes first


class NoWindow(Exception):
    """The rerun program did not come up, or ended: what it said."""


def program() -> Path:
    """Where the rerun program is.

    Raises:
        BadExperiment: the extra is not installed.
    """
    found = importlib.util.find_spec("rerun_cli")
    path = None if found is None or found.origin is None else Path(found.origin).parent / "rerun"
    if path is None or not path.is_file() or importlib.util.find_spec("rerun") is None:
        raise BadExperiment("the viewer is not installed: `make viz`, or pip install 'swarm-cpdaf[viz]'")
    return path


class Window:
    """Leave it by `with`: it closes on every way out.

    Args:
        web: no window, but a page for browsers.
        log: where the program's words go.
    """

    def __init__(self, web: bool, log: Path) -> None:
        self._log = log
        port, page_port = free_ports(2)
        self.url = f"rerun+http://{HOST}:{port}/proxy"
        self.page = f"http://{HOST}:{page_port}/?url={quote(self.url, safe='')}" if web else None
        words = [str(program()), "--bind", HOST, "--port", str(port), "--memory-limit", MEMORY, "--expect-data-soon"]
        if web:
            words += ["--serve-web", "--web-viewer-port", str(page_port), "--server-memory-limit", MEMORY]
        log.parent.mkdir(parents=True, exist_ok=True)
        with log.open("wb") as file:
            self._child = subprocess.Popen(
                words, stdin=subprocess.DEVNULL, stdout=file, stderr=file, start_new_session=True,
                preexec_fn=partial(_begin, os.getpid()),
            )  # fmt: skip
        try:
            self._await(port)
        except BaseException:
            self.close()
            raise

    def wait(self) -> None:
        """Returns when the window has been closed; a page stays for ever."""
        self._child.wait()

    def close(self) -> None:
        self._child.terminate()
        try:
            self._child.wait(timeout=3)
        except subprocess.TimeoutExpired:
            self._child.kill()
            self._child.wait()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _await(self, port: int) -> None:
        deadline_s = clock.now_s() + START_S
        while True:
            with contextlib.suppress(OSError), socket.create_connection((HOST, port), timeout=1):
                return
            if self._child.poll() is not None or clock.now_s() > deadline_s:
                said = [line for line in self._log.read_text(errors="replace").splitlines() if line.strip()]
                last = said[-1] if said else "it said nothing"
                raise NoWindow(f"the viewer did not start: {last} (log: {self._log})")
            clock.sleep_until(clock.now_s() + 0.05)


def _begin(parent: int) -> None:
    die_with(parent)
    os.nice(POLITE)


def free_ports(count: int) -> list[int]:
    """Ports that nobody on this host listens at."""
    with contextlib.ExitStack() as stack:
        sockets = [stack.enter_context(socket.create_server((HOST, 0))) for _ in range(count)]
        return [each.getsockname()[1] for each in sockets]
