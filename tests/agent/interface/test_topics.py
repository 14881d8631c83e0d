"""Does every key lead back to its topic, and nothing else to any?"""

import pytest

from agent.interface import messages, topics


@pytest.mark.parametrize("topic", topics.TOPICS, ids=lambda topic: topic.name)
def test_a_key_names_its_topic_and_its_mav(topic):
    assert topics.parse(topics.key(topic, 12)) == (topic, 12)


def test_a_registration_is_what_an_agent_believes():
    assert topics.key(topics.REGISTRATION, 3) == "belief/3/registration"
    assert topics.all_keys(topics.REGISTRATION) == "belief/*/registration"


@pytest.mark.parametrize(
    "key", ["", "belief", "belief/3", "belief/3/reg", "belief/x/registration", "belief/1000/estimate"]
)
def test_other_keys_are_rejected(key):
    with pytest.raises(messages.Rejected, match="topic: nothing is known at"):
        topics.parse(key)
