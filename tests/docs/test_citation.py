"""CITATION.cff, README and the package's metadata name the same paper; the long description has no dead links."""

import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def test_the_paper_is_cited_as_in_the_readme():
    citation, readme = ((ROOT / name).read_text(encoding="utf-8") for name in ("CITATION.cff", "README.md"))
    fields = dict(re.findall(r"^  (\w+): \"?([^\"\n]+)\"?$", citation, re.MULTILINE))
    assert re.fullmatch(r"10\.1364/OE\.\d+", fields["doi"])
    text = " ".join(readme.split())
    assert fields["title"] in text
    assert f"Optics Express {fields['volume']}, {fields['start']}, {fields['year']}" in text
    authors = re.findall(r"family-names: (\w+), given-names: (\w)\.", citation)
    assert ", ".join(f"{given}. {family}" for family, given in authors) in text


def test_the_long_description_has_no_links_to_files_of_the_repository():
    """As pyproject.toml makes it of README.md."""
    hook = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["metadata"]["hooks"]
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    before = len(text)
    for rule in hook["fancy-pypi-readme"]["substitutions"]:
        text = re.sub(rule["pattern"], rule["replacement"], text)
    assert [link for link in re.findall(r"\]\(([^)]*)\)", text) if not link.startswith(("https://", "#"))] == []
    assert 0.8 * before < len(text) < before


def test_the_versions_of_constraints_are_in_the_ranges_of_pyproject():
    """So that `make test` and `make lowest` install what they say."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    ranges = [*project["dependencies"], *(one for extra in project["optional-dependencies"].values() for one in extra)]
    bounds = dict(re.findall(r"^([\w.-]+)(?:\[\w+\])?>=([\d.]+)$", "\n".join(ranges), re.MULTILINE))
    for file in ("constraints.txt", "constraints-lowest.txt"):
        lines = re.findall(r"^([\w.-]+)==([\d.]+)", (ROOT / file).read_text(), re.MULTILINE)
        pins = {name.replace("_", "-"): version for name, version in lines}
        numbers = {name: tuple(map(int, version.strip(".").split("."))) for name, version in pins.items()}
        for name, bound in bounds.items():
            lowest = tuple(map(int, bound.split(".")))
            if name in numbers:
                assert numbers[name] >= lowest, (file, name)
                if file == "constraints-lowest.txt" and name != "torch":
                    assert numbers[name][: len(lowest)] == lowest, name
