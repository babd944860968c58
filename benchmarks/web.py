"""The page of `mwdn export --web` in a headless Chromium: size of the folder, time of a capture, agreement.

    python benchmarks/web.py --psf PSF --captures FILE ... [--runtime FOLDER] [--repeats 5]

One thread of WebAssembly. The time is the processor time of the page's process, from the choice of a capture to its
picture: measurement, network, and both PNG files for viewing. On a shared machine it says more than the time on the
wall, which is the page's own and of the network alone. Agreement is the PSNR against the exact reconstruction, with its
brightest pixel as peak, of the worst capture. Needs Chromium, which is driven by `tests/browser.py`, and Linux.
"""

import argparse
import json
import os
import sys
import tempfile
from contextlib import suppress
from pathlib import Path

import torch

from mwdn import Calibration, Reconstructor
from mwdn.export import export_site
from mwdn.export.exporter import agreement
from mwdn.export.site import SITE_FILES

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
import browser

browser.PATIENCE_S = 600  # on a busy machine

STATE = "document.getElementById('state')"
METHOD = "universal-small"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--psf", type=Path, required=True)
    parser.add_argument("--captures", type=Path, nargs="+", required=True, help="PNG of the PSF's size")
    parser.add_argument("--site", type=Path, help="an earlier page of this size, onto which the PSF is dropped")
    parser.add_argument("--runtime", type=Path, help="unpacked npm package onnxruntime-web")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/web.json"))
    arguments = parser.parse_args()
    calibration = Calibration.from_file(arguments.psf)
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        site = arguments.site or Path(folder) / "site"
        if not arguments.site:
            export_site(METHOD, calibration, site, runtime=arguments.runtime, name=arguments.psf.name)
        sizes = {name: (site / name).stat().st_size for name in SITE_FILES}
        with browser.open_page((site / SITE_FILES[0]).as_uri(), Path(folder) / "profile") as page:
            page.wait(f"{STATE}?.textContent.includes('pixels in')")
            if arguments.site:
                page.drop("#psf", arguments.psf)
                page.wait(f"{STATE}.textContent.includes('Drop captures')")
            results = [measured(page, calibration, path, arguments.repeats) for path in arguments.captures]
            checked = page.run("document.getElementById('checked').textContent")
    record = {
        "method": METHOD,
        "size": list(calibration.size),
        "bytes": sizes,
        "folder_megabytes": sum(sizes.values()) / 1e6,
        "page": checked,
        "cpu_seconds": min(result["cpu_seconds"] for result in results),
        "network_wall_seconds": min(result["network_wall_seconds"] for result in results),
        "decibels": min(result["decibels"] for result in results),
        "captures": results,
    }
    arguments.out.write_text(json.dumps(record, indent=2) + "\n")
    print(json.dumps({key: value for key, value in record.items() if key not in ("captures", "bytes")}, indent=2))


def measured(page, calibration, path, repeats):
    """Shortest times of a capture, and the agreement of its scene."""
    page.run(
        "window.made = []; window.make ??= URL.createObjectURL; URL.createObjectURL = b => (made.push(b), make(b))"
    )
    page.drop("#capture", path)
    page.wait(f"{STATE}.textContent.startsWith('{path.name}: ')")
    cpu, wall = [], []
    for _ in range(repeats):
        start = busy()
        page.run(f"{STATE}.textContent = ''; document.querySelector('#captures button').click()")
        page.wait(f"{STATE}.textContent.startsWith('{path.name}: ')")
        cpu.append(busy() - start)
        wall.append(float(page.run(f"{STATE}.textContent.match(/in ([0-9.]+) s/)[1]")))
    page.run("made.length = 0; document.getElementById('save-npy').click()")
    page.wait("made.length")
    # The array follows the header of 128 bytes.
    values = page.run("made[0].slice(128).arrayBuffer().then(data => [...new Float32Array(data)])")
    height, width = calibration.size
    scene = torch.tensor(values).reshape(1, height, width, -1).movedim(-1, 1)
    reconstruct = Reconstructor(METHOD, calibration, device="cpu", precision="exact")
    expected = reconstruct.on_device(calibration.correct(calibration.frames.read(path)))
    best = {"cpu_seconds": min(cpu), "network_wall_seconds": min(wall), "decibels": agreement(scene, expected)}
    return {"capture": path.name, **best}


def busy():
    """Processor time in seconds that the browser's pages have used, all of their threads."""
    parents, times = {}, {}
    for folder in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            fields = (folder / "stat").read_text().rpartition(")")[2].split()
            parents[int(folder.name)] = int(fields[1])
            if b"--type=renderer" in (folder / "cmdline").read_bytes():
                times[int(folder.name)] = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    return sum(time for process, time in times.items() if os.getpid() in ancestors(process, parents))


def ancestors(process, parents):
    while process in parents:
        process = parents[process]
        yield process


if __name__ == "__main__":
    main()
