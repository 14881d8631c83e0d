"""Where do the results go? A folder that belongs to one run or study from the beginning."""

from pathlib import Path

from agent.interface import clock
from agent.interface.tables import BadExperiment

CLAIM = "experiment.toml"  # the file that makes a folder ours; what is flown is written into it


def folder_for(experiment: str, out: Path | None) -> Path:
    """Where the results go: a directory that was not there, or empty. It is made here, before anything is started, and
    claimed: nobody else can have it any more.

    Raises:
        BadExperiment: there is something, or it cannot be made.
    """
    folder = new_folder(experiment) if out is None else out
    try:
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise FileExistsError
        folder.mkdir(parents=True, exist_ok=True)
        (folder / CLAIM).touch(exist_ok=False)
    except FileExistsError:
        raise BadExperiment(f"--out {folder}: expected a directory that does not exist yet or is empty") from None
    except OSError as error:
        raise BadExperiment(f"--out {folder}: cannot be made: {error.strerror}") from None
    return folder


def new_folder(name: str) -> Path:
    """In runs/, named after the time; with a number, too, if there is one of that second.

    Raises:
        BadExperiment: it cannot be made.
    """
    named = f"{name}-{clock.utc_text()}"
    for folder in (Path("runs", named), *(Path("runs", f"{named}-{n}") for n in range(2, 1000))):
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            continue
        except OSError as error:
            raise BadExperiment(f"{folder}: cannot be made: {error.strerror}") from None
        return folder
    raise BadExperiment(f"runs/{named}: there are a thousand of that second")
