"""Walk the tutorials: run every command of docs/tutorials, and keep what it prints and draws in the pages.

    python docs/tutorials.py [NAME ...] [--check]

Each page is walked in an empty folder, its blocks of `sh` one after the other in one shell. The block of `text` below a
block of `sh` becomes what that printed. A picture `![...](name.webp "folder/file.png")` is made from the file in the
walk. `--check` writes nothing, and fails where the pages differ in more than numbers.
"""

import argparse
import difflib
import io
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image

from mwdn.io.files import atomic, write_text

PAGES = Path(__file__).resolve().parent / "tutorials"
COMMANDS = re.compile(r"^```sh\n(.*?)^```\n(?:\n```text\n(.*?)^```\n)?", re.MULTILINE | re.DOTALL)
PICTURE = re.compile(r'!\[[^\]]*\]\(([\w-]+\.webp) "([^"]+)"\)')
NUMBER = re.compile(r"\b[0-9a-f]{8,}\b|-?\d[\d.,:]*(?:e-?\d+)?")
"""A hash, or a number."""
PROGRESS = re.compile(r"[A-Z]\w+: +\d+%")
"""A line that a long command prints once in a while."""

END = "--- end of block"
WIDTH = 1000
"""Pixels; a wider picture is reduced."""


def names() -> list[str]:
    """The tutorials."""
    return sorted(path.stem for path in PAGES.glob("*.md") if path.stem != "index")


def run(page: str, folder: Path) -> list[str]:
    """What each block of commands of a page prints, run in a folder.

    Raises:
        RuntimeError: a command failed.
    """
    blocks = [match[1] for match in COMMANDS.finditer(page)]
    script = "set -eu\n" + "".join(f"{block}echo '{END}'\n" for block in blocks)
    places = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    environment = {**os.environ, "PATH": places, "COLUMNS": "100", "NO_COLOR": "1", "TERM": "dumb"}
    done = subprocess.run(
        ["bash", "-c", script], cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    *printed, rest = done.stdout.split(f"{END}\n")
    if done.returncode or len(printed) != len(blocks):
        raise RuntimeError(f"block {len(printed) + 1} ended with {done.returncode}:\n{rest}")
    return ["\n".join(line.rstrip() for line in text.splitlines() if not PROGRESS.match(line)) for text in printed]


def filled(page: str, printed: list[str]) -> str:
    """The page with what its commands print."""
    texts = iter(printed)

    def block(match: re.Match[str]) -> str:
        text = next(texts)
        return f"```sh\n{match[1]}```\n" + (f"\n```text\n{text}\n```\n" if text else "")

    return COMMANDS.sub(block, page)


def structure(page: str) -> list[str]:
    """Its lines without numbers and the width of columns."""
    return [re.sub(r"[\s─━-]+", " ", NUMBER.sub("0", line)) for line in page.splitlines()]


def draw(source: Path, target: Path) -> None:
    """A picture of the walk, for the page."""
    with Image.open(source) as picture:
        shown = picture.convert("RGB")
    if shown.width > WIDTH:
        shown = shown.resize((WIDTH, round(shown.height * WIDTH / shown.width)), Image.Resampling.LANCZOS)
    written = io.BytesIO()
    shown.save(written, "webp", quality=82, method=6)
    with atomic(target) as temporary:
        temporary.write_bytes(written.getvalue())


def walk(name: str, *, check: bool) -> list[str]:
    """Walk one tutorial; returns the lines that differ from its page."""
    page = (PAGES / f"{name}.md").read_text(encoding="utf-8")
    with tempfile.TemporaryDirectory() as folder:
        walked = filled(page, run(page, Path(folder)))
        for picture, source in PICTURE.findall(page):
            if check:
                Image.open(Path(folder) / source).load()
            else:
                draw(Path(folder) / source, PAGES / picture)
    if not check:
        write_text(PAGES / f"{name}.md", walked)
    changes = difflib.unified_diff(structure(page), structure(walked), "page", "walk", lineterm="", n=0)
    return list(changes)


def main() -> None:
    """Walk the tutorials of the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(names()))
    parser.add_argument("--check", action="store_true")
    arguments = parser.parse_args()
    different = False
    for name in arguments.names or names():
        changes = walk(name, check=arguments.check)
        print("\n".join([f"{name}: {len(changes)} lines differ", *changes]), flush=True)
        different |= bool(changes)
    sys.exit(1 if arguments.check and different else 0)


if __name__ == "__main__":
    main()
