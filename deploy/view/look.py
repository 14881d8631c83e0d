"""How is a recorded run looked at? All of it is drawn, in a window or for a browser, and stays until that is left."""

import contextlib
import tempfile
from collections.abc import Callable
from pathlib import Path

from deploy.experiment import from_text
from deploy.log import read_log
from deploy.view.scene import scenes
from deploy.view.window import Window, program


def look(folder: Path, web: bool, say: Callable[[str], None]) -> None:
    """Returns when the window has been closed, or after Ctrl-C.

    Raises:
        BadExperiment: the viewer is not installed.
        BadLog: there is no log of a run in the folder.
        NoWindow: the viewer does not start.
    """
    program()
    from deploy.view.viewer import Viewer  # slow to import, and there only if it is installed

    experiment = from_text(read_log(folder / "log.mcap").origin.experiment)
    with tempfile.TemporaryDirectory(prefix="swarm-") as logs, Window(web, Path(logs) / "viewer.txt") as window:
        say(f"loading {folder} ..." + (f" (it is seen at {window.page})" if window.page else ""))
        viewer = Viewer(f"{experiment.name}, seed {experiment.fleet.seed}", experiment.fleet.mavs)
        viewer.connect(window.url)
        for scene in scenes(folder):
            viewer.draw(scene)
        viewer.close()
        stay(window, say)


def stay(window: Window, say: Callable[[str], None]) -> None:
    """Until the window is closed, or Ctrl-C: here that is the way to leave it."""
    say(f"{window.page}: until Ctrl-C" if window.page else "all is drawn; close the window to end, or Ctrl-C")
    with contextlib.suppress(KeyboardInterrupt):
        window.wait()
