"""What befalls which process, and when? The schedule's kills, stops and restarts, on real processes.

In lockstep the world holds before each tick at which something happens and says so, and goes on when it is told who
takes part; in real time nothing holds, and what is due happens as soon as the recorder's reports say that it is.
"""

import asyncio
from typing import Any, Protocol

import msgspec

from agent.interface.fleet import Fleet
from agent.interface.process import READY
from deploy.faults import Faults, ProcessFault

WORLD, RECORDER = "world", "recorder"


class Crew(Protocol):
    """The processes of a run, by name."""

    async def start(self, name: str, *more: str) -> None:
        """Starts it, with these words more on its command line; returns when it is ready."""

    async def kill(self, name: str) -> None: ...
    def stop(self, name: str) -> None: ...
    def go_on(self, name: str) -> None: ...
    def tell(self, name: str, line: bytes) -> None:
        """Writes a line to its standard input."""

    async def all_ready(self) -> None: ...


class Director:
    """Carries out one experiment's process faults."""

    def __init__(self, faults: Faults, fleet: Fleet) -> None:
        self._faults, self._fleet = faults, fleet
        self.late = {f"mav_{mav}" for mav in faults.late}  # processes that are not started with the others
        self._incarnations = dict.fromkeys(fleet.ids, 0)
        self._roll = {mav: 0 for mav in fleet.ids if mav not in faults.late}
        self._absent = set(faults.late)  # MAVs without a process
        self._held: asyncio.Queue[int] = asyncio.Queue()
        self._reported = asyncio.Event()
        self._zero_s = 0.0  # real time: when simulated time began, by the loop's clock

    def heard(self, name: str, line: bytes) -> bool:
        """Takes in what a process says; whether that was for the director alone."""
        if name == WORLD and b'"held"' in line:
            self._held.put_nowait(msgspec.json.decode(line)["held"])
            return True
        if name == RECORDER and line.strip() != READY:
            sim_s = msgspec.json.decode(line).get("sim_s", 0.0)
            if sim_s > 0:
                self._zero_s = asyncio.get_running_loop().time() - sim_s
                self._reported.set()
        return False

    async def direct(self, crew: Crew) -> None:
        """Returns when nothing more will happen to anybody."""
        await crew.all_ready()
        ticks = sorted({fault.tick(self._fleet) for fault in self._faults.processes} | {0})
        for tick, following in zip(ticks, [*ticks[1:], None], strict=True):
            if self._fleet.realtime:
                await self._await_time(tick)
            elif tick:
                while await self._held.get() != tick:
                    pass
            for fault in self._faults.due(tick, self._fleet):
                await self._carry_out(fault, tick, crew)
            self._call_roll(crew, following)

    async def _await_time(self, tick: int) -> None:
        at_s, loop = tick / self._fleet.rate_hz, asyncio.get_running_loop()
        while at_s > 0:
            await self._reported.wait()
            remaining_s = self._zero_s + at_s - loop.time()
            if remaining_s <= 0:
                return
            self._reported.clear()
            try:  # a report may say that simulated time has stood still
                await asyncio.wait_for(self._reported.wait(), remaining_s)
            except TimeoutError:
                return

    async def _carry_out(self, fault: ProcessFault, tick: int, crew: Crew) -> None:
        mav, name = fault.mav, f"mav_{fault.mav}"
        entry = {"mav": mav, "do": fault.do, "stamp_ns": self._fleet.stamp_ns(tick)}
        crew.tell(RECORDER, msgspec.json.encode(entry))
        if fault.do in ("kill", "stop"):
            self._roll.pop(mav, None)
            if self._fleet.realtime:  # before it is missed
                self._call_roll(crew, None)
        match fault.do:
            case "kill":
                await crew.kill(name)
                self._absent.add(mav)
            case "stop":
                crew.stop(name)
            case "continue":
                crew.go_on(name)
                self._roll[mav] = self._incarnations[mav]
            case "restart" | "join":
                self._incarnations[mav] += fault.do == "restart"
                there = ",".join([RECORDER, WORLD, *(f"mav_{other}" for other in self._roll)])
                await crew.start(name, "--incarnation", str(self._incarnations[mav]), "--meet", there)
                self._absent.remove(mav)
                self._roll[mav] = self._incarnations[mav]

    def _call_roll(self, crew: Crew, until: int | None) -> None:
        """Tells the world who takes part, and until which tick that holds (None: until it hears of another)."""
        line: dict[str, Any] = {"roll": sorted(self._roll.items()), "until": until, "absent": sorted(self._absent)}
        crew.tell(WORLD, msgspec.json.encode(line))
