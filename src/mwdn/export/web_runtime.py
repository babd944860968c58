"""onnxruntime-web: fetched once from npm by its own client, checked, and read from there."""

import base64
import hashlib
import json
import logging
import shutil
import subprocess
import tarfile
import tempfile
import zlib
from pathlib import Path

from mwdn.errors import ExportError
from mwdn.io.files import atomic, cache_folder

PACKAGE = "onnxruntime-web"
RUNTIME_VERSION = "1.30.0"
INTEGRITY = "sha512-q0y+JrrtukXSzsBWEMccVfqX25LRmosXHF+CaRJmg8pZClzcV7svNc4rKY3jL02Vb7QmRMDs1SigqR4CXAfKYQ=="
"""SHA-512 of the package's archive, as `npm view onnxruntime-web@1.30.0 dist.integrity` prints it."""

LIBRARIES = {"wasm": "ort.wasm.min.js", "webgpu": "ort.webgpu.min.js"}
BINARIES = {"wasm": "ort-wasm-simd-threaded", "webgpu": "ort-wasm-simd-threaded.asyncify"}
"""For each processor: its script for pages; and the module and the WebAssembly that this loads, which share a name."""

FETCH_S = 600.0
"""Longest time for the archive, 33 MB."""

RUNTIME_FILES = [*LIBRARIES.values(), *(name + suffix for name in BINARIES.values() for suffix in (".mjs", ".wasm"))]
"""All these files."""


def read_runtime(folder: Path | None = None) -> dict[str, bytes]:
    """Read the files of `LIBRARIES` and `BINARIES`, by name.

    Args:
        folder: the unpacked package; unless given, its archive is fetched by npm into ``~/.cache/mwdn``, once.

    Raises:
        ExportError: there is no npm, the archive cannot be fetched or is another one than `INTEGRITY` says, or the
            folder holds another version.
    """
    return _from_archive(_archive()) if folder is None else _from_folder(folder)


def _from_folder(folder: Path) -> dict[str, bytes]:
    try:
        about = json.loads((folder / "package.json").read_bytes())
        found = f"{about['name']} {about['version']}"
        files = {name: (folder / "dist" / name).read_bytes() for name in RUNTIME_FILES}
    except (OSError, ValueError, KeyError, TypeError) as error:
        reason = getattr(error, "strerror", None) or "it has another `package.json`"
        raise ExportError(
            f"`runtime` ({folder}) must be the unpacked npm package {PACKAGE} {RUNTIME_VERSION}: {reason}. Get it by "
            f"`npm install {PACKAGE}@{RUNTIME_VERSION}`; it is then `node_modules/{PACKAGE}`."
        ) from error
    if found != f"{PACKAGE} {RUNTIME_VERSION}":
        raise ExportError(f"`runtime` ({folder}) must be {PACKAGE} {RUNTIME_VERSION}, but is {found}.")
    return files


def _from_archive(archive: Path) -> dict[str, bytes]:
    content = archive.read_bytes()
    digest = "sha512-" + base64.b64encode(hashlib.sha512(content).digest()).decode("ascii")
    if digest != INTEGRITY:
        raise ExportError(
            f"`{archive}` must have the hash {INTEGRITY[:20]}... but has {digest[:20]}...: it is damaged or another "
            "file. Delete it and run the command again."
        )
    try:
        with tarfile.open(archive) as package:
            members = ((name, package.extractfile(f"package/dist/{name}")) for name in RUNTIME_FILES)
            return {name: member.read() for name, member in members if member is not None}
    except (tarfile.TarError, zlib.error, KeyError, OSError) as error:
        raise ExportError(f"`{archive}` cannot be read: {error}. Delete it and run the command again.") from error


def _archive() -> Path:
    """The package's archive in the cache, fetched if it is not there."""
    archive = cache_folder() / f"{PACKAGE}-{RUNTIME_VERSION}.tgz"
    if archive.is_file():
        return archive
    npm = shutil.which("npm")
    install = f"npm install {PACKAGE}@{RUNTIME_VERSION}"
    other = f"or get the package elsewhere (`{install}`) and name its folder: `--runtime FOLDER`"
    if npm is None:
        raise ExportError(f"{PACKAGE} comes from npm, which is not installed. Install Node.js, {other}.")
    # A warning is printed even if logging is not set up: 33 MB take a while.
    logging.getLogger(__name__).warning("Fetching %s %s by npm (33 MB, once)", PACKAGE, RUNTIME_VERSION)
    with tempfile.TemporaryDirectory(prefix="mwdn-") as folder:
        command = [npm, "pack", f"{PACKAGE}@{RUNTIME_VERSION}", "--ignore-scripts", "--pack-destination", folder]
        try:
            subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=FETCH_S, check=True)
            with atomic(archive) as temporary:
                shutil.copyfile(Path(folder) / archive.name, temporary)
        except (OSError, subprocess.SubprocessError) as error:
            lines = (getattr(error, "stderr", None) or str(error)).strip().splitlines()
            reason = next((line for line in lines if "code" in line.lower()), lines[-1] if lines else "")
            raise ExportError(
                f"{PACKAGE} {RUNTIME_VERSION} cannot be fetched by npm: {reason}. Check the connection, {other}."
            ) from error
    return archive
