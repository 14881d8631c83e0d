"""Which topics are there, who speaks on them and who listens? One row each.

`air/**` is all that MAVs ever tell each other. `truth/**` and `fault/**` are for deploy alone: the network
configuration of an agent denies it to hear them.
"""

from dataclasses import dataclass
from functools import lru_cache

from agent.interface import messages


@dataclass(frozen=True)
class Topic:
    name: str
    key: str  # Zenoh key expression; {mav} is whose it is
    kind: type[messages.Header]
    publisher: str
    readers: str
    may_be_lost: bool  # in real time; in lockstep nothing is


VIO = Topic("vio", "sensor/{mav}/vio", messages.Vio, "world", "that agent", True)
SIGHTINGS = Topic("sightings", "sensor/{mav}/sightings", messages.Sightings, "world", "that agent", True)
SURVEY = Topic("survey", "sensor/{mav}/survey", messages.Survey, "world", "that agent", False)
END = Topic("end", "sensor/{mav}/end", messages.End, "world", "that agent", False)
ODOMETRY = Topic("odometry", "air/{mav}/odometry", messages.Odometry, "agent", "every agent", True)
DETECTIONS = Topic("detections", "air/{mav}/detections", messages.Detections, "agent", "every agent", True)
COMMAND = Topic("command", "command/{mav}", messages.Setpoint, "agent", "world", True)
ESTIMATE = Topic("estimate", "belief/{mav}/estimate", messages.Estimate, "agent", "deploy", True)
REGISTRATION = Topic("registration", "belief/{mav}/registration", messages.Registration, "agent", "deploy", False)
STATUS = Topic("status", "status/{mav}", messages.Status, "agent, world (0)", "deploy", False)
ROLL = Topic("roll", "sensor/{mav}/roll", messages.Roll, "world", "that agent's wrapper", False)
ARRIVALS = Topic("arrivals", "fault/{mav}/arrivals", messages.Arrivals, "deploy", "deploy", False)
PROCESS_FAULT = Topic("process fault", "fault/{mav}/process", messages.ProcessFault, "deploy", "deploy", False)
TRUTH = Topic("truth", "truth/{mav}/pose", messages.Truth, "world", "deploy", False)
LABELS = Topic("labels", "truth/{mav}/labels", messages.Labels, "world", "deploy", False)
CONTACT = Topic("contact", "truth/{mav}/contact", messages.Contact, "world", "deploy", False)

TOPICS = (
    VIO, SIGHTINGS, SURVEY, END, ODOMETRY, DETECTIONS, COMMAND, ESTIMATE, REGISTRATION, STATUS,
    ROLL, ARRIVALS, PROCESS_FAULT, TRUTH, LABELS, CONTACT,
)  # fmt: skip

_BY_SHAPE = {tuple(topic.key.replace("{mav}", "*").split("/")): topic for topic in TOPICS}


@lru_cache(maxsize=1024)
def key(topic: Topic, mav: int) -> str:
    return topic.key.replace("{mav}", str(mav))


def all_keys(topic: Topic) -> str:
    """The key expression of this topic for every MAV."""
    return topic.key.replace("{mav}", "*")


@lru_cache(maxsize=1024)
def parse(key_expression: str) -> tuple[Topic, int]:
    """Topic and MAV of a key.

    Raises:
        messages.Rejected: no such topic, or not a MAV number.
    """
    chunks = key_expression.split("/")
    mav = chunks[1] if len(chunks) > 1 else ""
    topic = _BY_SHAPE.get((chunks[0], "*", *chunks[2:]))
    if topic is None or not (mav.isascii() and mav.isdigit() and len(mav) <= 3):
        raise messages.Rejected("topic", f"nothing is known at {key_expression!r}")
    return topic, int(mav)
