"""Hooks of the documentation site; `make check` builds the site itself and fails at any broken link."""

import importlib.util
import logging
from pathlib import Path
from types import SimpleNamespace

import pytest

pytest.importorskip("mkdocs", reason="the extra `docs` is not installed")

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[2]


def hook(name):
    spec = importlib.util.spec_from_file_location(f"site_{name}", ROOT / "docs" / "site" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def links(tmp_path, monkeypatch):
    """The hook in a repository of its own."""
    module = hook("links")
    for name, text in {
        "docs/page.md": "[record](../results/a.json) [card](../card.md#use) [lost](../lost.json) [other](other.md)",
        "docs/other.md": "",
        "card.md": "[page](docs/page.md) [record](results/a.json)",
        "results/a.json": "{}",
        "CONTRIBUTING.md": "",
        "CHANGELOG.md": "",
    }.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    monkeypatch.setattr(module, "ROOT", tmp_path)
    monkeypatch.setattr(module, "DOCS", tmp_path / "docs")
    return module


@pytest.fixture
def config(tmp_path):
    config = MkDocsConfig()
    config.load_dict({"site_name": "test", "docs_dir": str(tmp_path / "docs"), "site_dir": str(tmp_path / "site")})
    config["use_directory_urls"] = False
    config["plugins"] = SimpleNamespace(_current_plugin="test")
    return config


def rewritten(links, config, files, name):
    file = files.get_file_from_path(name)
    text = Path(file.abs_src_path).read_text()
    return links.on_page_markdown(text, page=SimpleNamespace(file=file), config=config, files=files)


def test_linked_files_outside_docs_become_files_of_the_site(links, config, tmp_path):
    pages = [File(name, str(tmp_path / "docs"), str(tmp_path / "site"), False) for name in ("page.md", "other.md")]
    files = links.on_files(Files(pages), config=config)
    assert {file.src_uri for file in files} == {
        *("page.md", "other.md"),
        *(f"repository/{name}" for name in ("CONTRIBUTING.md", "CHANGELOG.md", "card.md", "results/a.json")),
    }
    assert rewritten(links, config, files, "page.md") == (
        "[record](repository/results/a.json) [card](repository/card.md#use) [lost](../lost.json) [other](other.md)"
    )
    assert rewritten(links, config, files, "repository/card.md") == "[page](../page.md) [record](results/a.json)"


@pytest.mark.parametrize(
    ("html", "reported"),
    [
        ('<script src="https://unpkg.com/x"></script>', ["https://unpkg.com/x"]),
        ('<link href="//fonts.example/css" rel="stylesheet">', ["//fonts.example/css"]),
        ('<a href="https://opg.optica.org">paper</a><img src="a.webp"><script src="assets/x.js"></script>', []),
    ],
)
def test_what_a_page_would_load_from_elsewhere_is_reported(links, html, reported, caplog):
    with caplog.at_level(logging.WARNING):
        assert links.on_post_page(html, page=SimpleNamespace(file=SimpleNamespace(src_uri="page.md"))) == html
    assert [message.partition(" loads ")[2] for message in caplog.messages] == reported


def test_every_public_name_has_its_place_in_the_reference():
    import mwdn

    top = hook("api")._top()
    assert all(f"`mwdn.{name}`" in top for name in mwdn.__all__ if name not in ("networks", "solvers"))
