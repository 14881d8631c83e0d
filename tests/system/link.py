"""A real link between two network namespaces, whose delay and loss can be changed while it is used.

A TUN device in each, and a process that carries packets from one to the other (`python -m tests.system.link`): that
works on kernels without netem, too. Needs root and iproute2.
"""

import contextlib
import ctypes
import fcntl
import heapq
import json
import os
import random
import select
import shutil
import struct
import subprocess
import sys
import time

TUNSETIFF, IFF_TUN, IFF_NO_PI = 0x400454CA, 0x0001, 0x1000
CLONE_NEWNET = 0x40000000
DEVICE = "wire"


def why_not():
    """Why there can be no such link on this machine; "" if there can."""
    if os.geteuid() != 0:
        return "needs root"
    if shutil.which("ip") is None:
        return "needs iproute2"
    if not os.path.exists("/dev/net/tun"):
        return "needs /dev/net/tun"
    tried = subprocess.run(["ip", "netns", "add", f"try-{os.getpid()}"], capture_output=True, text=True, check=False)
    subprocess.run(["ip", "netns", "del", f"try-{os.getpid()}"], capture_output=True, check=False)
    return f"no network namespaces: {tried.stderr.strip()}" if tried.returncode else ""


class Link:
    """Two namespaces and the link between them; leave it by `with`."""

    def __init__(self):
        self.names = [f"{side}-{os.getpid()}" for side in ("left", "right")]
        self.addresses = ["10.77.0.1", "10.77.0.2"]

    def inside(self, side):
        """What a command is run by in namespace 0 or 1."""
        return ("ip", "netns", "exec", self.names[side])

    def change(self, **conditions):
        """Any of delay_ms, loss (share, each way)."""
        self._carrier.stdin.write(json.dumps(conditions) + "\n")
        self._carrier.stdin.flush()

    def __enter__(self):
        with contextlib.ExitStack() as stack:
            for name in self.names:
                _ip("netns", "add", name)
                stack.callback(_ip, "netns", "del", name)
            words = [sys.executable, "-m", "tests.system.link", *self.names]
            self._carrier = stack.enter_context(
                subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
            )  # its exit closes the input, which ends it
            assert self._carrier.stdout.readline() == "ready\n"
            for side, name in enumerate(self.names):
                _ip("-n", name, "link", "set", "dev", "lo", "up")
                own, other = self.addresses[side], self.addresses[1 - side]
                _ip("-n", name, "addr", "add", own, "peer", other, "dev", DEVICE)
                _ip("-n", name, "link", "set", "dev", DEVICE, "up")
            self._undo = stack.pop_all()
        return self

    def __exit__(self, *_):
        self._undo.close()


def _ip(*words):
    subprocess.run(["ip", *words], check=True, capture_output=True)


def _tun(namespace):
    """A TUN device in this namespace."""
    libc = ctypes.CDLL(None, use_errno=True)
    with open(f"/var/run/netns/{namespace}") as file:
        if libc.setns(file.fileno(), CLONE_NEWNET):
            raise OSError(ctypes.get_errno(), f"cannot enter {namespace}")
    device = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
    fcntl.ioctl(device, TUNSETIFF, struct.pack("16sH", DEVICE.encode(), IFF_TUN | IFF_NO_PI))
    return device


def carry(names):
    """Carries packets until standard input ends; its lines are the conditions."""
    devices, rng = [_tun(name) for name in names], random.Random(0)
    print("ready", flush=True)
    conditions = {"delay_ms": 0.0, "loss": 0.0}
    on_their_way = []  # when they arrive, a number, where, and what
    number = 0
    while True:
        wait_s = max(0.0, on_their_way[0][0] - time.monotonic()) if on_their_way else None
        readable, _, _ = select.select([sys.stdin, *devices], [], [], wait_s)
        if sys.stdin in readable:
            line = sys.stdin.readline()
            if not line:
                return
            conditions |= json.loads(line)
        for side, device in enumerate(devices):
            if device in readable:
                packet = os.read(device, 65536)
                if rng.random() >= conditions["loss"]:
                    number += 1
                    due_s = time.monotonic() + conditions["delay_ms"] / 1000
                    heapq.heappush(on_their_way, (due_s, number, devices[1 - side], packet))
        while on_their_way and on_their_way[0][0] <= time.monotonic():
            _, _, device, packet = heapq.heappop(on_their_way)
            try:
                os.write(device, packet)
            except OSError:  # a queue is full, or the device is not up yet: lost, as on any link
                continue


if __name__ == "__main__":
    carry(sys.argv[1:])
