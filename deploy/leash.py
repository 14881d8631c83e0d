"""How does a process make sure not to outlive the one that started it, even if that is killed? (Linux only.)"""

import ctypes
import os
import signal

_PR_SET_PDEATHSIG = 1
_prctl = getattr(ctypes.CDLL(None), "prctl", None)


def die_with(parent: int) -> None:
    """From now on this process is killed when the thread that started it ends; at once if `parent` is gone already."""
    if _prctl is not None:
        _prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:
            os._exit(1)
