"""Walk the tutorials and the pages of the commands: run their commands, and keep what they print and draw in the pages.

    python docs/walk.py [tutorials/student | commands | ...] [--check]

Each page is walked in an empty folder, its blocks of `sh` one after the other in one shell. The block of `text` below a
block of `sh` becomes what that printed. A picture `![...](name.webp "folder/file.png")` is made from the file in the
walk. The pages of the commands begin with the blocks of commands/index.md, which make a camera to try.
`--check` writes nothing, and fails where the pages differ in more than numbers.
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

DOCS = Path(__file__).resolve().parent
FIRST = DOCS / "commands" / "index.md"
"""Its commands come before those of each page beside it."""

COMMANDS = re.compile(r"^```sh\n(.*?)^```\n(?:\n```text\n(.*?)^```\n)?", re.MULTILINE | re.DOTALL)
PICTURE = re.compile(r'!\[[^\]]*\]\(([\w-]+\.webp) "([^"]+)"\)')
NUMBER = re.compile(r"-?\b[0-9a-f]{8,}\b|-?\d[\d.,:]*(?:e-?\d+)?")
"""A hash, or a number."""
PROGRESS = re.compile(r"[\w :-]+: +\d+%")
"""A line that a long command prints once in a while."""

END = "--- end of block"
PLACE = "/camera"
"""Stands for the folder of the walk in what is printed."""
WIDTH = 1000
"""Pixels; a wider picture is reduced."""


def names() -> list[str]:
    """The pages, such as `tutorials/student`."""
    pages = [*(DOCS / "tutorials").glob("*.md"), *(DOCS / "commands").glob("*.md")]
    return sorted(str(page.relative_to(DOCS).with_suffix("")) for page in pages if COMMANDS.search(_read(page)))


def run(page: str, folder: Path, first: str = "") -> list[str]:
    """What each block of commands of a page prints, run in a folder.

    Args:
        page: its text.
        folder: to run in.
        first: text of a page whose commands are run before; what they print is not returned.

    Raises:
        RuntimeError: a command failed.
    """
    before, blocks = ([match[1] for match in COMMANDS.finditer(text)] for text in (first, page))
    script = "set -eu\n" + "".join(f"{block}echo '{END}'\n" for block in [*before, *blocks])
    places = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    environment = {**os.environ, "PATH": places, "COLUMNS": "100", "NO_COLOR": "1", "TERM": "dumb"}
    done = subprocess.run(
        ["bash", "-c", script], cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    *printed, rest = done.stdout.split(f"{END}\n")
    if done.returncode or len(printed) != len(before) + len(blocks):
        raise RuntimeError(f"block {len(printed) + 1} ended with {done.returncode}:\n{rest}")
    return [_without_progress(text.replace(str(folder), PLACE)) for text in printed[len(before) :]]


def _without_progress(text: str) -> str:
    return "\n".join(line.rstrip() for line in text.splitlines() if not PROGRESS.match(line))


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
    """Walk one page; returns the lines that differ from it."""
    path = DOCS / f"{name}.md"
    page = _read(path)
    first = _read(FIRST) if path.parent == FIRST.parent and path != FIRST else ""
    with tempfile.TemporaryDirectory() as folder:
        walked = filled(page, run(page, Path(folder), first))
        for picture, source in PICTURE.findall(page):
            if check:
                Image.open(Path(folder) / source).load()
            else:
                draw(Path(folder) / source, path.parent / picture)
    if not check:
        write_text(path, walked)
    changes = difflib.unified_diff(structure(page), structure(walked), "page", "walk", lineterm="", n=0)
    return list(changes)


def _read(path: Path) -> str:
    return path.read_text(encoding="utf-8")


def main() -> None:
    """Walk the pages of the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"page or folder: {', '.join(names())}")
    parser.add_argument("--check", action="store_true")
    arguments = parser.parse_args()
    chosen = [name for name in names() if not arguments.names or {name, name.partition("/")[0]} & {*arguments.names}]
    different = False
    for name in chosen:
        changes = walk(name, check=arguments.check)
        print("\n".join([f"{name}: {len(changes)} lines differ", *changes]), flush=True)
        different |= bool(changes)
    sys.exit(1 if arguments.check and different else 0)


if __name__ == "__main__":
    main()
