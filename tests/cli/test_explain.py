"""`mwdn explain`, which the doubts of other commands name."""

import pytest

from mwdn.cli.explain import GUIDE, sections


def test_every_topic_is_listed_with_its_symptom(run):
    code, out, err = run("explain")
    topics = sections(GUIDE.read_text(encoding="utf-8"))
    assert (code, err) == (0, "")
    assert len(topics) > 15
    assert all(topic in out for topic in topics)
    assert all(section.startswith("**Symptom**:") and "**What to do**" in section for section in topics.values())


@pytest.mark.parametrize("topic", ["gamma", "orientation", "size"])
def test_a_topic_is_explained_without_links_that_a_wheel_lacks(run, topic):
    code, out, err = run("explain", topic)
    assert (code, err) == (0, "")
    assert "What to do" in out
    assert ".md" not in out
    assert "](" not in out


def test_an_unknown_topic_names_the_nearest(run):
    code, out, err = run("explain", "gama")
    assert (code, out) == (2, "")
    assert "No topic named 'gama'. Did you mean 'gamma'?" in err
