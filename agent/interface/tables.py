"""How does a program read its table of the experiment file? With exact errors: which key, what was expected."""

import re
from types import UnionType
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

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
        raise BadExperiment(_readable(str(error), kind, table, name)) from None


def _readable(text: str, kind: type, table: dict[str, Any], name: str) -> str:
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
    steps = re.findall(r"[^.\[\]]+", path)
    value: Any = table
    for step in steps:
        value = value[int(step)] if isinstance(value, list) else value.get(step)
    shown = "" if isinstance(value, dict | list) else f" = {value!r}"
    if what.startswith("Invalid enum value"):
        return f"{name}{path}{shown}: expected {' or '.join(_choices(kind, steps))}"
    return f"{name}{path}{shown}: {what[0].lower()}{what[1:].replace('`', '')}"


def _choices(kind: Any, steps: list[str]) -> list[str]:
    """What a value of this type, or of that to which the steps lead in it, may be; only literals and tables count."""
    origin = get_origin(kind)
    if origin in (Union, UnionType):
        return [choice for each in get_args(kind) for choice in _choices(each, steps)]
    if origin is Literal:
        return [] if steps else [repr(each) for each in get_args(kind)]
    if steps and origin is tuple:  # its elements are all alike
        return _choices(get_args(kind)[0], steps[1:])
    if isinstance(kind, type) and issubclass(kind, msgspec.Struct):
        return _choices(get_type_hints(kind)[steps[0]], steps[1:]) if steps else ["a table"]
    return []
