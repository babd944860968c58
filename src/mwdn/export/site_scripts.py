"""The scripts of a static page: modules as one classic script, and files as text.

Browsers refuse modules and other files of a page that was opened from the disk (``file://``); classic scripts work
there as on any static host. So modules are joined, and files are stored in scripts as base64 of gzip.
"""

import base64
import gzip
import json
import re
from collections.abc import Mapping
from importlib.resources import files
from typing import Any

MODULES = ("png", "npy", "hot_pixels", "frames", "psf", "display", "network", "divider", "dropping", "saving", "site")
"""In the order of their imports. They are joined in one scope, so their top-level names must differ."""

_SHARED = {"divider.js", "dropping.js", "saving.js", "page.css", "icon.svg", "welcome.svg"}  # of `mwdn preview`


def read_static(name: str) -> str:
    """A file of this folder or, if both pages share it, of `mwdn.preview`."""
    package = "mwdn.preview" if name in _SHARED else "mwdn.export"
    return (files(package) / "static" / name).read_text(encoding="utf-8")


def joined_modules() -> str:
    """The page's modules as one classic script."""
    parts = []
    for name in MODULES:
        text = re.sub(r"^import .*\n", "", read_static(f"{name}.js"), flags=re.MULTILINE)
        parts.append(re.sub(r"^export ", "", text, flags=re.MULTILINE))
    return "\n".join(['(() => {\n"use strict";', *parts, "})();\n"])


def stored(contents: Mapping[str, bytes]) -> str:
    """A script that holds files, which the page reads by ``unpack(name)``."""
    lines = ["globalThis.mwdnFiles ??= {};"]
    for name, content in contents.items():
        # mtime 0: the same content gives the same script.
        text = base64.b64encode(gzip.compress(content, mtime=0)).decode("ascii")
        lines.append(f"mwdnFiles[{json.dumps(name)}] = {json.dumps({'length': len(content), 'text': text})};")
    return "\n".join(lines) + "\n"


def constant(name: str, content: dict[str, Any]) -> str:
    """A script that sets a global constant."""
    return f"globalThis.{name} = {json.dumps(content, allow_nan=False)};\n"
