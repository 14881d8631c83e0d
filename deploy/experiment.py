"""Which experiment is this? A bundled name or a TOML file, with the changes asked for, as every program reads it."""

import platform
import re
import tomllib
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from agent.interface.fleet import Fleet
from agent.interface.sensors import Detector, Odometry
from agent.interface.tables import BadExperiment, parse_table
from deploy import faults
from deploy.bundled import FOLDER, bundled
from deploy.faults import Faults

TABLES = ("world", "agent", "fleet", "faults")
RECORD = "record"  # in a resolved file: what it was made from and with; ignored by every program
INHERITED = {"detector": Detector, "odometry": Odometry}  # an agent knows its sensors unless it is told otherwise
# Not TOML, not UTF-8, a number of thousands of digits; arrays in arrays in arrays ...
UNREADABLE = (ValueError, RecursionError)
VERSIONS = ("swarm-cpdaf", "numpy", "scipy", "mujoco", "msgspec", "eclipse-zenoh")


class Experiment(NamedTuple):
    name: str
    world: dict[str, Any]
    agent: dict[str, Any]
    fleet: Fleet
    faults: Faults

    def toml(self) -> str:
        """The resolved file: accepted as an experiment again, and then gives the same estimates."""
        import tomli_w

        record = {
            "experiment": self.name,
            "seed": self.fleet.seed,
            "versions": {"python": platform.python_version()} | {name: version(name) for name in VERSIONS},
        }
        tables = {"fleet": msgspec.to_builtins(self.fleet), "agent": self.agent, "world": self.world}
        if disturbed := msgspec.to_builtins(self.faults):
            tables["faults"] = disturbed
        tables[RECORD] = record
        return f"# {self.name}, as resolved for a run\n{tomli_w.dumps(tables)}"


def load(
    source: str, changes: list[str] | tuple[str, ...] = (), seed: int | None = None, realtime: bool = False
) -> Experiment:
    """The experiment with `PATH=VALUE` changes applied; not yet checked by the programs that read its tables.

    Raises:
        BadExperiment: no such experiment, not TOML, unknown table, an impossible change, a bad [fleet] or [faults].
    """
    name, tables = _read(source)
    for change in changes:
        _apply(tables, change)
    fleet = tables.setdefault("fleet", {})
    if seed is not None:
        fleet["seed"] = seed
    if realtime:
        fleet["realtime"] = True
    return _resolve(name, tables)


def from_text(resolved: str) -> Experiment:
    """The experiment that `Experiment.toml` wrote.

    Raises:
        BadExperiment: it did not.
    """
    try:
        return _resolve(*_tables(resolved, "unnamed"))
    except UNREADABLE as error:
        raise BadExperiment(f"cannot be read as TOML: {error}") from None


def _resolve(name: str, tables: dict[str, Any]) -> Experiment:
    world, agent = tables.get("world", {}), tables.get("agent", {})
    fleet = parse_table(Fleet, tables.get("fleet", {}), "fleet")
    return Experiment(name, world, _inherit(world, agent), fleet, faults.parse(tables.get("faults", {}), fleet))


def _read(source: str) -> tuple[str, dict[str, Any]]:
    path = FOLDER / f"{source}.toml" if re.fullmatch(r"\w+", source) else Path(source)
    if not path.is_file():
        raise BadExperiment(
            f"{source}: no such experiment; bundled are {', '.join(bundled())}; or give the path of a TOML file"
        )
    try:
        return _tables(path.read_text("utf-8-sig"), path.stem)
    except (OSError, *UNREADABLE) as error:
        raise BadExperiment(f"{source}: cannot be read as TOML: {error}") from None


def _tables(text: str, name: str) -> tuple[str, dict[str, Any]]:
    """The tables of an experiment file and the experiment's name, which a resolved file knows itself.

    Raises:
        BadExperiment: there are other tables, or no folder can have the name.
    """
    tables = tomllib.loads(text)
    record = tables.pop(RECORD, {})
    for table, content in tables.items():
        if table not in TABLES:
            raise BadExperiment(f"{table}: there is no such table; expected {', '.join(TABLES)}")
        if not isinstance(content, dict):
            raise BadExperiment(f"{table} = {content!r}: expected a table, [{table}]")
    known = record.get("experiment") if isinstance(record, dict) else None
    if isinstance(known, str) and known:
        name = known
    if re.search("[/\0\ud800-\udfff]", name):
        raise BadExperiment(f"{name!r}: no experiment can be called that, expected UTF-8 without / and NUL")
    return name, tables


def _apply(tables: dict[str, Any], change: str) -> None:
    """Carries out "world.path.0.radius_m=2": TOML values, and what is not TOML is text."""
    path, equals, text = change.partition("=")
    *parents, last = path.strip().split(".")
    if not equals or not parents or not all((*parents, last)):
        raise BadExperiment(f"--set {change}: expected TABLE.KEY=VALUE")
    if parents[0] not in TABLES:
        raise BadExperiment(f"--set {change}: there is no table {parents[0]!r}; expected {', '.join(TABLES)}")
    place: Any = tables
    for step in parents:
        place = _element(place, step, change) if isinstance(place, list) else place.setdefault(step, {})
        if not isinstance(place, dict | list):
            raise BadExperiment(f"--set {change}: {step} = {place!r} is not a table")
    if isinstance(place, list):
        _element(place, last, change)
        place[int(last)] = value(text.strip(), change)
    else:
        place[last] = value(text.strip(), change)


def _element(array: list[Any], step: str, change: str) -> Any:
    if not re.fullmatch("[0-9]{1,9}", step) or int(step) >= len(array):
        raise BadExperiment(f"--set {change}: {step!r} of an array: expected a number, 0 to {len(array) - 1}")
    return array[int(step)]


def value(text: str, change: str) -> Any:
    """A TOML value; what is not one is text."""
    try:
        change.encode()
        tables = tomllib.loads(f"value = {text}")
    except tomllib.TOMLDecodeError as error:
        if text == "" or text[0] in "[{\"'" or "\n" in text:
            raise BadExperiment(f"--set {change}: not a TOML value: {error}") from None
        return text
    except UNREADABLE as error:
        raise BadExperiment(f"--set {change}: not a TOML value: {error}") from None
    if len(tables) > 1:
        raise BadExperiment(f"--set {change!r}: expected one value, more keys take a --set each")
    return tables["value"]


def _inherit(world: dict[str, Any], agent: dict[str, Any]) -> dict[str, Any]:
    """The agent's table, with what the world's sensors are wherever it does not say what to believe of them."""
    agent = dict(agent)
    for name, kind in INHERITED.items():
        true, believed = world.get(name, {}), agent.get(name, {})
        if isinstance(true, dict) and isinstance(believed, dict):  # else the check names what is wrong
            known = {key: value for key, value in true.items() if key in kind.__struct_fields__}
            if known or believed:
                agent[name] = known | believed
    return agent


def version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "not installed"
