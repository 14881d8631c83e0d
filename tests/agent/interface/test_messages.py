"""The boundary: what decodes is valid, and nothing else decodes."""

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agent.interface import messages as m
from agent.interface.topics import TOPICS

HEADER = (m.VERSION, 7, 3, 12, 1_500_000_000)
SPHERICAL = m.spherical_block(np.array([[2.0, 0.5, -0.1], [5.0, -3.0, 1.2]]))
POSES = np.arange(8.0).tobytes()
WEIGHTS = np.array([0.7, 0.3]).tobytes()
PLACED = bytes([1, 1, 0, 1])  # the first hypothesis knows both MAVs, the second one of them
PLACES = np.concatenate([np.arange(8), np.zeros(4), np.ones(4)]).astype("<f4").tobytes()
EXAMPLES = [
    m.Vio(*HEADER, np.zeros(3).tobytes(), np.array([0.0, 0, 0, 1]).tobytes()),
    m.Sightings(*HEADER, SPHERICAL),
    m.Survey(*HEADER, POSES, 0.2, 0.1),
    m.Odometry(*HEADER, np.arange(4.0).tobytes()),
    m.Detections(*HEADER, SPHERICAL),
    m.Estimate(*HEADER, bytes([2, 0]), POSES, np.ones(20, "<f4").tobytes(), bytes(32), 5, 4),
    m.Registration(*HEADER, ("", "zwei passen: hinten, oder 3° gedreht"), WEIGHTS, PLACED, PLACES),
    m.Setpoint(*HEADER, bytes(24), bytes(24), bytes(24), 0.5),
    m.Status(*HEADER, 1, 2, 3, 4, 5, 6, 7, (8, 9)),
    m.End(*HEADER),
    m.Roll(*HEADER, bytes([1, 3]), (0, 2)),
    m.Arrivals(*HEADER, bytes([2, 2]), bytes([0, 1]), np.array([5, 7]).tobytes(), (0, 1, 0)),
    m.ProcessFault(*HEADER, "restart"),
    m.Truth(*HEADER, 3, bytes(24), bytes(32)),
    m.Labels(*HEADER, 3, bytes([0, 2])),
    m.Contact(*HEADER, 3, bytes([1, 2])),
]


def test_every_topic_has_an_example():
    assert {type(example) for example in EXAMPLES} == {topic.kind for topic in TOPICS}


@pytest.mark.parametrize("message", EXAMPLES, ids=lambda e: type(e).__name__)
def test_round_trip(message):
    assert m.decode(type(message), m.encode(message), epoch=7) == message


@pytest.mark.parametrize("message", EXAMPLES, ids=lambda e: type(e).__name__)
def test_encoding_the_fields_gives_the_same_bytes(message):
    fields = (getattr(message, name) for name in message.__struct_fields__)
    assert m.encode_fields(type(message), *fields) == m.encode(message)


@pytest.mark.parametrize("message", EXAMPLES, ids=lambda e: type(e).__name__)
def test_any_msgpack_library_reads_it(message):
    assert msgpack.unpackb(m.encode(message))[:5] == list(HEADER)


@pytest.mark.parametrize("message", EXAMPLES, ids=lambda e: type(e).__name__)
def test_every_truncation_is_rejected(message):
    payload = m.encode(message)
    for length in range(len(payload)):
        with pytest.raises(m.Rejected):
            m.decode(type(message), payload[:length], epoch=7)


def header(**changed):
    fields = dict(zip(("version", "epoch", "sender", "seq", "stamp_ns"), HEADER, strict=True)) | changed
    return tuple(fields.values())


def pose(*values):
    return np.array(values).tobytes()


@pytest.mark.parametrize(
    ("kind", "message", "reason"),
    [
        (m.Odometry, m.Odometry(*header(version=2), pose(0.0, 0, 0, 0)), "version"),
        (m.Odometry, m.Odometry(*header(epoch=8), pose(0.0, 0, 0, 0)), "epoch"),
        (m.Odometry, m.Odometry(*header(sender=-1), pose(0.0, 0, 0, 0)), "malformed"),
        (m.End, m.End(*header(seq=-5)), "malformed"),
    ],
)
def test_a_wrong_header_is_named(kind, message, reason):
    with pytest.raises(m.Rejected) as caught:
        m.decode(kind, m.encode(message), epoch=7)
    assert caught.value.reason == reason


WRONG_BODIES = [
    (m.Odometry, [pose(0.0, 0, 0, 0), [8, 0, 0, 0, 0.0]]),
    (m.Odometry, [pose(0.0, 0, 0, 0), [0, -1, 0, 0, 0.0]]),
    (m.Odometry, [pose(0.0, 0, 0, 0), [0, 0, 256, 0, 0.0]]),
    (m.Odometry, [pose(0.0, 0, 0, 0), [0, 0, 0, 2**62, 0.0]]),
    (m.Odometry, [pose(0.0, 0, 0, 0), [0, 0, 0, 0, -1.0]]),
    (m.Odometry, [pose(0.0, 0, 0, 0), [0, 0, 0, 0]]),
    (m.Odometry, [pose(0.0, np.nan, 0, 0)]),
    (m.Odometry, [pose(0.0, np.inf, 0, 0)]),
    (m.Odometry, [pose(0.0, 0, 0)]),
    (m.Odometry, ["text"]),
    (m.Odometry, []),
    (m.Odometry, [pose(0.0, 0, 0, 0), 1]),
    (m.Vio, [bytes(24), bytes(32)]),
    (m.Vio, [bytes(24), pose(np.nan, 0, 0, 1)]),
    (m.Detections, [np.array([-1.0, 0, 0], "<f4").tobytes()]),
    (m.Detections, [np.array([1.0, 0, np.nan], "<f4").tobytes()]),
    (m.Detections, [np.array([1.0, 0, 1.7], "<f4").tobytes()]),
    (m.Detections, [bytes(7)]),
    (m.Detections, [np.ones((m.MAX_DETECTIONS + 1, 3), "<f4").tobytes()]),
    (m.Sightings, [np.array([np.inf, 0, 0], "<f4").tobytes()]),
    (m.Survey, [bytes(31), 0.2, 0.1]),
    (m.Survey, [bytes(32), float("nan"), 0.1]),
    (m.Survey, [bytes(32), 0.2, -1.0]),
    (m.Estimate, [bytes([3]), bytes(32), bytes(40), bytes(32), 0, 0]),
    (m.Estimate, [bytes([0]), bytes(64), bytes(40), bytes(32), 0, 0]),
    (m.Estimate, [bytes([0]), bytes(32), np.full(10, np.nan, "<f4").tobytes(), bytes(32), 0, 0]),
    (m.Estimate, [bytes([0]), bytes(32), bytes(40), bytes(24), 0, 0]),
    (m.Registration, ["no list", b"", b"", b""]),
    (m.Registration, [["too few places"], WEIGHTS, bytes(1), bytes(16)]),
    (m.Registration, [["too few poses"], WEIGHTS, bytes(2), bytes(16)]),
    (m.Registration, [["halved"], bytes(7), b"", b""]),
    (m.Registration, [["x" * (m.MAX_REASON + 1)], b"", b"", b""]),
    (m.Registration, [["two\nlines"], b"", b"", b""]),
    (m.Registration, [["not text: \x1b[2J"], b"", b"", b""]),
    (m.Registration, [[""], pose(1.01), bytes(1), bytes(16)]),
    (m.Registration, [[""], pose(-0.01), bytes(1), bytes(16)]),
    (m.Registration, [[""], pose(np.nan), bytes(1), bytes(16)]),
    (m.Registration, [[""], bytes(8 * 17), bytes(17), bytes(16 * 17)]),
    (m.Registration, [[""], pose(1.0), bytes([2]), bytes(16)]),
    (m.Registration, [[""], pose(1.0), bytes([1]), np.array([0, 0, np.nan, 0], "<f4").tobytes()]),
    (m.Registration, [[""], pose(1.0), bytes([1]), np.array([0, 2e6, 0, 0], "<f4").tobytes()]),
    (m.Registration, [[""], pose(1.0), bytes([0]), np.array([0, 0, 1, 0], "<f4").tobytes()]),
    (m.Setpoint, [bytes(24), bytes(24), bytes(24), float("inf")]),
    (m.Setpoint, [bytes(24), pose(np.nan, 0, 0), bytes(24), 0.0]),
    (m.Status, [1, 2, 3, 4, 5, 6, 7, [0] * 65]),
    (m.Contact, [3, b""]),
    (m.Contact, [3, bytes([2, 1])]),
    (m.Contact, [3, bytes([1, 3])]),
    (m.Roll, [bytes([3, 1]), [0, 0]]),
    (m.Roll, [bytes([1, 1]), [0, 0]]),
    (m.Roll, [bytes([1, 3]), [0]]),
    (m.Roll, [bytes([1]), [-1]]),
    (m.Arrivals, [bytes([2]), bytes([2]), bytes(8), [0]]),
    (m.Arrivals, [bytes([2]), bytes([1]), bytes(16), [0]]),
    (m.Arrivals, [bytes([2]), bytes([1]), bytes(8), [-1]]),
    (m.ProcessFault, ["bless"]),
    (m.Truth, [1, pose(np.nan, 0, 0), bytes(32)]),
]


@pytest.mark.parametrize(("kind", "body"), WRONG_BODIES)
def test_a_wrong_body_is_malformed(kind, body):
    with pytest.raises(m.Rejected) as caught:
        m.decode(kind, msgpack.packb([*HEADER, *body]), epoch=7)
    assert caught.value.reason == "malformed"


def test_text_that_is_none_is_malformed():
    payload = m.encode(m.Registration(*HEADER, ("why?",), b"", b"", b"")).replace(b"why?", b"wh\xff?")
    with pytest.raises(m.Rejected) as caught:
        m.decode(m.Registration, payload, epoch=7)
    assert caught.value.reason == "malformed"


def test_an_unreadable_message_of_another_version_says_so():
    with pytest.raises(m.Rejected) as caught:
        m.decode(m.Odometry, msgpack.packb([2, "a", "new", "layout"]), epoch=7)
    assert caught.value.reason == "version"


def test_the_longest_registration_of_the_largest_fleet_is_not_oversized():
    mavs, hypotheses = 50, m.MAX_HYPOTHESES
    weights, poses = np.ones(hypotheses).tobytes(), np.ones((hypotheses, mavs, 4), "<f4").tobytes()
    message = m.Registration(*HEADER, ("\N{GOAT}" * m.MAX_REASON,) * mavs, weights, b"\1" * hypotheses * mavs, poses)
    assert m.decode(m.Registration, m.encode(message), epoch=7) == message


def test_oversized_is_not_even_parsed():
    with pytest.raises(m.Rejected) as caught:
        m.decode(m.End, bytes(m.MAX_BYTES + 1), epoch=7)
    assert caught.value.reason == "oversized"


@settings(max_examples=300, deadline=None)
@given(st.sampled_from(TOPICS), st.binary(max_size=400))
def test_random_bytes_are_rejected_and_never_raise_anything_else(topic, payload):
    with pytest.raises(m.Rejected):
        m.decode(topic.kind, payload, epoch=7)


@settings(max_examples=300, deadline=None)
@given(st.sampled_from(EXAMPLES), st.integers(0, 10_000), st.integers(0, 255))
def test_a_flipped_byte_is_rejected_or_still_valid(message, place, value):
    payload = bytearray(m.encode(message))
    payload[place % len(payload)] = value
    try:
        decoded = m.decode(type(message), bytes(payload), epoch=7)
    except m.Rejected:
        return
    numbers = "<f4" if isinstance(message, m.Registration) else "<f8"
    for name in decoded.__struct_fields__:
        block = getattr(decoded, name)
        if isinstance(block, bytes) and len(block) % 8 == 0 and name in ("pose", "poses", "position"):
            assert np.isfinite(np.frombuffer(block, numbers)).all()
