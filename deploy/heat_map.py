"""How does the error depend on two numbers? The figure of a study over a two-dimensional grid of numbers."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib import colormaps, rc_context
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from agent.interface.frames import Array
from deploy.report import SMALL

COLOURS = "cividis"  # rises evenly in lightness, also for the colour-blind and in grey
LEAST_RANGE = 1.5  # from the darkest colour to the lightest: small differences are not to look like large ones
UNITS = {
    "_ms": "ms", "_s": "s", "_m": "m", "_rad": "rad", "_deg": "deg", "_hz": "Hz", "_bytes_s": "bytes/s",
    ".loss": "share", ".burst_loss": "share", ".duplicates": "share", ".reorder": "share", ".P_D": "probability",
}  # fmt: skip


class Grid(NamedTuple):
    """Two dimensions of a study, with more than one number each."""

    down: str  # the key whose values are the rows
    across: str
    rows: list[float]
    columns: list[float]


def grid_of(cells: list[dict[str, Any]]) -> Grid | None:
    """The grid of these cells, if it is one of numbers in two dimensions."""
    names = list(cells[0]["grid"])
    if len(names) != 2:
        return None
    values = [sorted({cell["grid"][name] for cell in cells}, key=repr) for name in names]
    if any(isinstance(value, bool) or not isinstance(value, int | float) for each in values for value in each):
        return None
    if any(len(each) < 2 for each in values):
        return None
    return Grid(*names, *(sorted(each) for each in values))


def draw(study: dict[str, Any], grid: Grid, path: Path) -> None:
    """Relative RMSE in each cell, and how many times that of the clairvoyant twin it is."""
    cells = {(cell["grid"][grid.down], cell["grid"][grid.across]): cell for cell in study["cells"]}
    runs = {cell["seeds"] for cell in study["cells"]}
    with rc_context(SMALL | {"axes.grid": False}):
        width = max(8.0, 2.4 + 2 * 1.15 * len(grid.columns))
        figure = Figure(figsize=(min(width, 18), min(2.2 + 0.75 * len(grid.rows), 12)), layout="constrained")
        error, ratio = figure.subplots(1, 2, sharey=True)
        _map(figure, error, grid, cells, "relative_rmse_m", "relative RMSE [m]")
        _map(figure, ratio, grid, cells, "ratio_to_clairvoyant", "times the clairvoyant's RMSE [1]")
        error.set_ylabel(_label(grid.down))
        number = str(runs.pop()) if len(runs) == 1 else f"{min(runs)} to {max(runs)}"
        figure.suptitle(
            f"{study['experiment']}: {study['seeds']}; mean over {number} runs and its 95 % interval;\n"
            "in italics: share of the runs in which all localised all, if not all",
            x=0.01,
            ha="left",
            fontsize=9,
        )
        figure.savefig(path, dpi=150)


def _map(figure: Figure, axis: Axes, grid: Grid, cells: dict[Any, dict[str, Any]], metric: str, label: str) -> None:
    means: Array = np.full((len(grid.rows), len(grid.columns)), np.nan)
    for r, row in enumerate(grid.rows):
        for c, column in enumerate(grid.columns):
            cell = cells.get((row, column))
            if cell is not None and cell[metric]["mean"] is not None:
                means[r, c] = cell[metric]["mean"]
    known = means[np.isfinite(means)]
    low, high = (known.min(), known.max()) if len(known) else (1.0, 1.0)
    norm = LogNorm(low / 1.05, max(high, LEAST_RANGE * low) * 1.05)
    colours = colormaps[COLOURS].with_extremes(bad="0.92")
    image = axis.imshow(np.ma.masked_invalid(means), colours, norm, aspect="auto", origin="lower")
    for r, row in enumerate(grid.rows):
        for c, column in enumerate(grid.columns):
            cell = cells.get((row, column))
            dark = np.isfinite(means[r, c]) and norm(means[r, c]) < 0.55
            _write(axis, c, r, cell, metric, "white" if dark else "black")
    axis.set_xticks(range(len(grid.columns)), [f"{value:g}" for value in grid.columns])
    axis.set_yticks(range(len(grid.rows)), [f"{value:g}" for value in grid.rows])
    axis.set_xlabel(_label(grid.across))
    axis.set_title(label, loc="left")
    axis.tick_params(length=0)
    bar = figure.colorbar(image, ax=axis, label=label)
    ticks = np.geomspace(low, max(high, LEAST_RANGE * low), 4)
    bar.set_ticks(list(ticks), labels=[f"{tick:.3g}" for tick in ticks])
    bar.minorticks_off()


def _write(axis: Axes, x: int, y: int, cell: dict[str, Any] | None, metric: str, colour: str) -> None:
    """The numbers of one cell."""
    if cell is None:
        axis.text(x, y, "no run", ha="center", va="center", fontsize=7, color="0.35")
        return
    mean, high = cell[metric]["mean"], cell[metric]["high"]
    centred: dict[str, Any] = {"ha": "center", "va": "center"}
    if mean is None:
        axis.text(x, y, "nothing to score", fontsize=7, color="0.35", **centred)
        return
    axis.text(x, y + 0.14, f"{mean:.3f}", fontsize=9, color=colour, **centred)
    if high is not None:
        axis.text(x, y - 0.13, f"± {high - mean:.3f}", fontsize=7, color=colour, **centred)
    if cell["all_localised"] < 1:
        share = f"{100 * cell['all_localised']:.0f} %"
        axis.text(x, y - 0.35, share, fontsize=6.5, style="italic", color=colour, **centred)


def _label(key: str) -> str:
    """The key with its unit, as its name says."""
    endings = sorted((ending for ending in UNITS if key.endswith(ending)), key=len)
    return f"{key} [{UNITS[endings[-1]]}]" if endings else key
