import re
from pathlib import Path

import mwdn.diagnosis
from mwdn.cli.explain import GUIDE, sections
from mwdn.diagnosis import Verdict


def test_doubt_names_options_and_guide():
    verdict = Verdict("capture", "gamma", "doubt", "The capture is gamma-coded.", "srgb", "--gamma srgb")
    assert verdict.sentence == ("The capture is gamma-coded. Try `--gamma srgb`. Read `mwdn explain gamma`.")


def test_good_needs_no_guide():
    assert Verdict("psf", "orientation", "good", "The PSF has the right orientation.").sentence.endswith("orientation.")


def test_each_topic_is_a_section_of_the_guide():
    sources = [path.read_text() for path in Path(mwdn.diagnosis.__file__).parent.glob("*.py")]
    topics = {topic for source in sources for topic in re.findall(r'Verdict\(\s*"[a-z]+",\s*"([a-z-]+)"', source)}
    assert len(topics) > 7
    assert topics <= set(sections(GUIDE.read_text(encoding="utf-8")))
