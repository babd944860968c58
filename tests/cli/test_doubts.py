from mwdn.cli.doubts import Doubts
from mwdn.diagnosis import Verdict


def test_each_doubt_is_printed_once_and_counted(capsys):
    gamma = Verdict("capture", "gamma", "doubt", "Gamma-coded.", "srgb", "--gamma srgb")
    other = Verdict("capture", "gamma", "doubt", "Gamma-coded.", "2.2", "--gamma 2.2")
    good = Verdict("capture", "saturation", "good", "Nothing is saturated.")
    unknown = Verdict("psf", "orientation", "unknown", "Cannot be judged.")
    doubts = Doubts()
    for capture in "abcde":
        doubts.add(f"{capture}.png", (gamma, good, unknown))
    doubts.add("f.png", (other,))
    doubts.summarise()
    assert capsys.readouterr().err.splitlines() == [
        "Warning: a.png: Gamma-coded. Try `--gamma srgb`. Read `mwdn explain gamma`.",
        "Warning: f.png: Gamma-coded. Try `--gamma 2.2`. Read `mwdn explain gamma`.",
        "Warning: gamma: 4 other captures like a.png: b.png, c.png, d.png ...",
    ]
