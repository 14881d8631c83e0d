"""How does a program read its table of the experiment file? With exact errors: which key, what was expected."""

import re
from typing import Any, TypeVar

import msgspec

T = TypeVar("T")


class BadExperiment(Exception):
    """The experiment asks for something that cannot be; the message names the key, the value and what was expected."""


def parse_table(kind: type[T], table: dict[str, Any], name: str) -> T:
    """The frozen struct of this table; missing keys take their defaults.

    Raises:
        BadExperiment: unknown key, wrong type or impossible value.
    """
    try:
        return msgspec.convert(table, kind, strict=True)
    except msgspec.ValidationError as error:
        raise BadExperiment(_readable(str(error), table, name)) from None


def _readable(text: str, table: dict[str, Any], name: str) -> str:
    """msgspec's "Expected `float`, got `str` - at `$.detector.P_D`" as "agent.detector.P_D = 'high': expected ..."."""
    what, _, where = text.partition(" - at `$")
    path = where.rstrip("`")
    unknown = re.fullmatch(r"Object contains unknown field `(.*)`", what)
    if unknown:
        return f"{name}{path}.{unknown[1]}: there is no such key"
    missing = re.fullmatch(r"Object missing required field `(.*)`", what)
    if missing:
        return f"{name}{path}.{missing[1]}: this key is required"
    if re.match(r"\w+ = ", what):  # said by a struct's own check, which names the key and the value
        return f"{name}{path}.{what}"
    value: Any = table
    for step in re.findall(r"[^.\[\]]+", path):
        value = value[int(step)] if isinstance(value, list) else value.get(step)
    shown = "" if isinstance(value, dict | list) else f" = {value!r}"
    return f"{name}{path}{shown}: {what[0].lower()}{what[1:].replace('`', '')}"
