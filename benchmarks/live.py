"""The live picture from the camera to the page: frames a second, latency, and processor time of each part.

    python benchmarks/live.py [--seconds 20] [--fps 25] [--out benchmarks/results/live.json]

`mwdn preview --live rig` runs in a process of its own, with frames of 320 x 320 that the rig has prepared, so that its
simulation is not counted, and `universal-small`; a headless Chromium (`apt install chromium`) opens the page and
presses *Start*. Latency is from the end of a frame's exposure to the moment at which the page paints its picture, as
the page measures it. Processor time is that of the two programs with all their processes, over the frames on the page.
Memory is that at the start and at the end, and of each minute in between (server, browser).
`--stages` measures the server's stages alone, in this process, with one thread and without a page.
"""

import argparse
import json
import os
import re
import statistics
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from contextlib import contextmanager
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from browser import open_page

SIZE = 320
WARM_UP = 60
"""Frames before the measurement begins: the rig prepares those of three pictures, half a second each."""

COLLECT = """
new Promise((done) => {
  const state = document.getElementById('live-state'), found = [];
  let last = state.dataset.count;
  const watch = new MutationObserver(() => {
    if (state.dataset.count === last) return;
    last = state.dataset.count;
    found.push([performance.now(), Number(state.dataset.latency), Number(state.dataset.frame)]);
  });
  watch.observe(state, { attributes: true });
  setTimeout(() => { watch.disconnect(); done(found); }, SECONDS * 1000);
})
"""

CHOOSE = """
((list) => {
  if (list.value !== 'METHOD') {
    list.value = 'METHOD';
    list.onchange();
  }
})(document.getElementById('method'))
"""


def processes(root):
    """A process and all below it."""
    children = {}
    for entry in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = entry.read_text().rpartition(")")[2].split()
        except OSError:  # it has ended meanwhile
            continue
        children.setdefault(int(fields[1]), []).append(int(entry.parent.name))
    found, queue = [], [root]
    while queue:
        found.append(queue.pop())
        queue += children.get(found[-1], [])
    return found


def usage(root):
    """Processor seconds and resident megabytes of a process and all below it."""
    ticks = pages = 0
    for process in processes(root):
        try:
            fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
        except OSError:
            continue
        ticks += int(fields[11]) + int(fields[12])
        pages += int(fields[21])
    return ticks / os.sysconf("SC_CLK_TCK"), pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def stage_seconds(url):
    """Seconds of all stages so far, from the server's metrics, and frames."""
    with urllib.request.urlopen(f"{url}metrics", timeout=30) as answer:
        text = answer.read().decode()
    stages = re.findall(r'mwdn_live_seconds_total\{stage="(\w+)"\} (\S+)', text)
    frames = float(re.search(r"^mwdn_live_frames_total (\S+)", text, re.MULTILINE)[1])
    return {name: float(value) for name, value in stages}, frames


def start_server(options, folder):
    """The server in a process of its own, and its address."""
    line = [sys.executable, "-m", "mwdn", "preview", "--port", "0", "--out", str(folder), "--device", "cpu"]
    rig = f"rig,height={SIZE},width={SIZE},fps={options.fps:g},prepared=8,picture_s=0.5"
    server = subprocess.Popen([*line, "--live", rig], stdout=subprocess.PIPE, text=True)
    for said in server.stdout:
        if address := re.search(r"http://\S+/", said):
            return server, address[0]
    raise SystemExit("The server did not start.")


def measure(options):
    """One run."""
    with tempfile.TemporaryDirectory() as folder:
        server, url = start_server(options, Path(folder) / "preview")
        try:
            with open_page(url, Path(folder) / "profile") as page:
                page.wait("document.getElementById('live')?.hidden === false")
                page.run("document.getElementById('live-start').click()")
                page.wait("Number(document.getElementById('live-state').dataset.count) >= 1")
                page.run(CHOOSE.replace("METHOD", options.method))
                seen = page.run("Number(document.getElementById('live-state').dataset.count)")
                page.wait(f"Number(document.getElementById('live-state').dataset.count) >= {seen + WARM_UP}")
                browser = next(p for p in processes(os.getpid())[1:] if "chromium" in command(p))
                before = usage(server.pid), usage(browser), stage_seconds(url)
                start = time.perf_counter()
                with sampled_memory(server.pid, browser) as memory:
                    frames = collect(page, options.seconds)
                seconds = time.perf_counter() - start
                after = usage(server.pid), usage(browser), stage_seconds(url)
                if options.screenshot:
                    page.screenshot(options.screenshot)
        finally:
            server.terminate()
            server.wait(timeout=60)
    result = summary(options.method, frames, seconds, before, after)
    return result | ({"each_minute_mb": memory} if memory else {})


def collect(page, seconds):
    """Time, latency and number of each frame on the page."""
    frames, end = [], time.perf_counter() + seconds
    while (left := end - time.perf_counter()) > 0:
        # In parts: a page that does not answer for a minute counts as lost.
        frames += page.run(COLLECT.replace("SECONDS", str(min(30, left))))
    return frames


@contextmanager
def sampled_memory(*roots):
    """Resident megabytes of some processes and all below them, each minute."""
    found, ended = [], threading.Event()

    def sample():
        while not ended.wait(60):
            found.append([round(usage(root)[1]) for root in roots])

    thread = threading.Thread(target=sample, daemon=True)
    thread.start()
    try:
        yield found
    finally:
        ended.set()
        thread.join()


def command(process):
    """The command line of a process."""
    return Path(f"/proc/{process}/cmdline").read_text().replace("\0", " ")


def summary(method, frames, seconds, before, after):
    """The figures of one run."""
    latencies = sorted(latency for _, latency, _ in frames)
    count = len(frames)
    made = after[2][1] - before[2][1]
    stages = {name: after[2][0][name] - before[2][0].get(name, 0.0) for name in after[2][0]}
    server, browser = ((b[0] - a[0]) for a, b in zip(before[:2], after[:2], strict=True))
    return {
        "method": method,
        "seconds": round(seconds, 1),
        "frames_per_second": round(count / seconds, 1),
        "latency_ms_median": round(statistics.median(latencies), 1),
        "latency_ms_95": round(latencies[int(0.95 * count)], 1),
        "stage_ms": {name: round(1000 * value / made, 2) for name, value in stages.items()},
        "server_cpu_ms": round(1000 * server / count, 1),
        "browser_cpu_ms": round(1000 * browser / count, 1),
        "server_mb": [round(usage[0][1]) for usage in (before, after)],
        "browser_mb": [round(usage[1][1]) for usage in (before, after)],
        "load": [round(value, 1) for value in os.getloadavg()],
        "processors": os.cpu_count(),
    }


def measure_stages(repeats=60):
    """Processor milliseconds of each stage for one frame, in one thread; the shortest of some."""
    import torch

    from mwdn.calibration import Calibration, FrameFormat
    from mwdn.capture import open_source
    from mwdn.inference.reconstructor import Reconstructor
    from mwdn.preview.live_encoding import brightest, encode_jpeg

    torch.set_num_threads(1)
    with open_source(f"rig,height={SIZE},width={SIZE}") as rig:
        frame = rig.read()
        calibration = Calibration(rig.psf, FrameFormat(bit_depth=frame.bit_depth))
        reconstruct = Reconstructor("universal-small", calibration, device="cpu")
        measurement = reconstruct.calibration.correct(frame.array)
        scene = reconstruct(measurement)
        stages = {
            "simulate a frame (not in the live picture)": rig.read,
            "correct": lambda: reconstruct.calibration.correct(frame.array),
            "reconstruct": lambda: reconstruct(measurement),
            **network_parts(reconstruct.engine, measurement),
            "encode": lambda: [encode_jpeg(each, brightest(each)) for each in (measurement, scene)],
        }
        found = {name: round(min(processor_ms(work) for _ in range(repeats)), 2) for name, work in stages.items()}
    matrix = torch.rand(1024, 1024)
    product_ms = min(processor_ms(lambda: matrix @ matrix) for _ in range(repeats))
    return found | {"GFLOP/s of a product of matrices, 1024 x 1024": round(2 * 1024**3 / product_ms / 1e6, 1)}


def network_parts(engine, measurement):
    """Estimates (iterations and Wiener filters) and the U-Net of `universal-small`, from within."""
    import torch

    network = engine.network

    def inferring(work):
        with torch.inference_mode():
            return work()

    estimates = inferring(lambda: network._estimates(measurement, engine.prepared))
    unit = network.unit(estimates)
    return {
        "of it estimates": lambda: inferring(lambda: network._estimates(measurement, engine.prepared)),
        "of it U-Net": lambda: inferring(lambda: network.correct(estimates, unit)),
    }


def processor_ms(work):
    """Processor milliseconds of one call."""
    start = time.process_time()
    work()
    return 1000 * (time.process_time() - start)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=20)
    parser.add_argument("--fps", type=float, default=25, help="of the camera")
    parser.add_argument("--method", default="universal-small", help="`wiener` for all but the network")
    parser.add_argument("--stages", action="store_true", help="the server's stages alone")
    parser.add_argument("--screenshot", type=Path)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    result = {"stages_cpu_ms": measure_stages()} if options.stages else measure(options)
    print(json.dumps(result, indent=2))
    if options.out:
        options.out.write_text(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main()
