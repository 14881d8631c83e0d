"""What time is it? The only module that asks the machine."""

import time


def now_s() -> float:
    """Monotonic wall time, s: for pacing real time and for deadlines."""
    return time.monotonic()


def now_us() -> int:
    """Monotonic wall time, us: for measuring what a step costs."""
    return time.perf_counter_ns() // 1000


def utc_text() -> str:
    """Date and time for names of run folders: 20260131-235959."""
    return time.strftime("%Y%m%d-%H%M%S", time.gmtime())


def sleep_until(deadline_s: float) -> None:
    """Wait until the monotonic time; returns at once if it has passed."""
    remaining = deadline_s - time.monotonic()
    if remaining > 0:
        time.sleep(remaining)
