"""Which experiments come with the program? Quick to import, for `swarm list`."""

from pathlib import Path

FOLDER = Path(__file__).parent / "experiments"


def bundled() -> dict[str, str]:
    """Name and one-line description of each: the comment in its file's first line."""
    return {path.stem: _first_comment(path) for path in sorted(FOLDER.glob("*.toml"))}


def _first_comment(path: Path) -> str:
    with path.open() as file:
        return file.readline().lstrip("#").strip()
