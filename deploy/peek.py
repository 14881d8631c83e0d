"""Whose message is this, and of when? The header alone, without a look at the rest."""

import msgspec


class Peek(msgspec.Struct, array_like=True, frozen=True, gc=False):
    """The header fields: msgspec skips what follows, so that nothing more is decoded."""

    version: int
    epoch: int
    sender: int
    seq: int
    stamp_ns: int


_peek = msgspec.msgpack.Decoder(Peek)


def peek(payload: bytes) -> Peek | None:
    """The header of a message; None if there is none."""
    try:
        return _peek.decode(payload)
    except (msgspec.ValidationError, msgspec.DecodeError, RecursionError):
        return None
