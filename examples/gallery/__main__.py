"""Run the scripts of this folder and keep their pictures and what they print, for the site.

python examples/gallery [NAME ...] [--out docs/gallery]
"""

import argparse
import contextlib
import io
import runpy
from pathlib import Path

import matplotlib

from mwdn.io.files import atomic, write_text

matplotlib.use("agg")
HERE = Path(__file__).resolve().parent


def scripts():
    """Every script of the gallery by its name."""
    return {path.stem: path for path in sorted(HERE.glob("*.py")) if path.stem != "__main__"}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(scripts()))
    parser.add_argument("--out", type=Path, default=HERE.parents[1] / "docs" / "gallery")
    arguments = parser.parse_args()
    for name in arguments.names or scripts():
        printed, drawn = io.StringIO(), io.BytesIO()
        with contextlib.redirect_stdout(printed):
            figure = runpy.run_path(str(scripts()[name]))["figure"]
        figure.savefig(drawn, format="webp", dpi=110, pil_kwargs={"quality": 82, "method": 6})
        with atomic(arguments.out / f"{name}.webp") as temporary:
            temporary.write_bytes(drawn.getvalue())
        write_text(arguments.out / f"{name}.txt", printed.getvalue())
        print(f"{name}: {len(drawn.getvalue()) // 1000} kB\n{printed.getvalue()}")


if __name__ == "__main__":
    main()
