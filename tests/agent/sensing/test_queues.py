"""Several inboxes as one."""

import pytest

from agent.interface import clock
from agent.interface.bus import MemoryBus, Packet
from agent.sensing.queues import SeveralInboxes


def test_what_is_in_any_of_them_comes_at_once():
    speaker = MemoryBus()
    listener = speaker.another()
    several = SeveralInboxes([listener.subscribe(f"air/{mav}/*") for mav in (1, 2)])
    for key in ("air/2/x", "air/1/x", "air/3/x"):
        speaker.publish(key, b"")
    assert several.wait(None) == [Packet("air/1/x", b""), Packet("air/2/x", b"")]
    assert several.drain() == []


def test_it_waits_so_long_and_no_longer(monkeypatch: pytest.MonkeyPatch):
    now_s = [100.0]
    monkeypatch.setattr(clock, "now_s", lambda: now_s[0])
    monkeypatch.setattr(clock, "sleep_until", lambda until_s: now_s.__setitem__(0, until_s))
    assert SeveralInboxes([MemoryBus().subscribe("**")], poll_s=0.25).wait(1.0) == []
    assert now_s[0] == 101.0
