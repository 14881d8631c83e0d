"""How is a run seen while it is flown? By a further subscriber that nobody waits for.

Started like every process of a run: `python -m deploy.view.live RUN/experiment.toml --network FILE --epoch E --to URL`.
"""

import argparse
import logging
import os
import signal
from dataclasses import replace
from pathlib import Path

from agent.interface import clock
from agent.interface.bus import BusError, Inbox
from agent.interface.process import READY, arguments, join, on_the_bus, stop_on_signals
from deploy.experiment import from_text
from deploy.recorder import Stopping
from deploy.view.scene import Stage, stage_of
from deploy.view.viewer import Viewer
from deploy.view.window import POLITE

DRAW_S = 0.09  # between scenes that are drawn: in lockstep there are more
PAUSE_S = 0.02

log = logging.getLogger("viewer")


def main() -> int:
    os.nice(POLITE)
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--to", required=True)
    own, words = parser.parse_known_args()
    start = arguments("python -m deploy.view.live", words)
    experiment = from_text(Path(words[0]).read_text())
    stop_on_signals()  # nothing to finish yet
    viewer = Viewer(f"{experiment.name}, seed {start.fleet.seed}", start.fleet.mavs)
    viewer.connect(own.to)
    try:
        # Not lossless: if this one is slow, it loses what is old, and nobody waits for it.
        with on_the_bus(start._replace(network=replace(start.network, lossless=False))) as bus:
            inbox = bus.subscribe("**")
            print(READY.decode(), flush=True)  # the others may start now
            join(start, bus)
            stopping = Stopping()
            signal.signal(signal.SIGTERM, stopping)
            show(inbox, stage_of(experiment, start.epoch), viewer, stopping)
    except BusError as error:
        log.error("%s", error)
        return 1
    viewer.close()
    return 0


def show(inbox: Inbox, stage: Stage, viewer: Viewer, stopping: Stopping) -> None:
    """Draws a scene now and then, until it is told to stop."""
    drawn_s = clock.now_s()
    while stopping.since_s is None:
        for packet in inbox.drain():
            for scene in stage.see(packet, show=clock.now_s() - drawn_s >= DRAW_S):
                drawn_s = clock.now_s()
                viewer.draw(scene)
        clock.sleep_until(clock.now_s() + PAUSE_S)
    for scene in stage.rest():
        viewer.draw(scene)


if __name__ == "__main__":
    raise SystemExit(main())
