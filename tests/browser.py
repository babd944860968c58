"""A headless Chromium, driven through its debugging protocol: no driver to install."""

import base64
import itertools
import json
import os
import re
import shutil
import subprocess
import tarfile
import threading
import urllib.request
from contextlib import contextmanager
from pathlib import Path

from websockets.sync.client import connect

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
AXE = "axe-core@4.14.1"
LOOKS = {
    "light": (1280, 900, False),
    "dark": (1280, 900, True),
    "phone": (390, 800, False),
    "dark-phone": (390, 800, True),
}
"""Width, height, and whether it is dark."""

PATIENCE_S = 90
"""Longest wait for something on the page; a machine may be busy."""


class Page:
    """One tab."""

    def __init__(self, socket):
        self.socket, self.numbers, self.errors = socket, itertools.count(1), []

    def command(self, method, **params):
        number = next(self.numbers)
        self.socket.send(json.dumps({"id": number, "method": method, "params": params}))
        while True:
            message = json.loads(self.socket.recv(timeout=PATIENCE_S))
            if message.get("method") == "Runtime.exceptionThrown":
                self.errors.append(message["params"]["exceptionDetails"])
            if message.get("method") == "Log.entryAdded" and message["params"]["entry"]["level"] == "error":
                self.errors.append(message["params"]["entry"]["text"])
            if message.get("id") == number:
                assert "error" not in message, message
                return message["result"]

    def run(self, expression):
        """Value of a JavaScript expression, after its promise."""
        result = self.command("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in result, result
        return result["result"].get("value")

    def wait(self, condition):
        """Until a JavaScript expression is true."""
        return self.run(
            f"new Promise((done, fail) => {{ const end = Date.now() + {1000 * PATIENCE_S}; const look = () => "
            f"{{ if ({condition}) done(true); else if (Date.now() > end) fail(new Error(document.body.innerText)); "
            "else setTimeout(look, 50); }; look(); })"
        )

    def drop(self, selector, *files):
        """Choose files in an input."""
        root = self.command("DOM.getDocument")["root"]["nodeId"]
        node = self.command("DOM.querySelector", nodeId=root, selector=selector)["nodeId"]
        self.command("DOM.setFileInputFiles", files=[str(file) for file in files], nodeId=node)

    def press(self, key, code, text=""):
        for kind in ("keyDown", "keyUp"):
            self.command("Input.dispatchKeyEvent", type=kind, key=key, code=key, windowsVirtualKeyCode=code, text=text)

    def tab_to(self, condition, most=60):
        """Press Tab until a JavaScript condition holds for the element with the focus, `e`."""
        for _ in range(most):
            self.press("Tab", 9)
            if self.run(f"(e => {condition})(document.activeElement)"):
                return
        raise AssertionError(f"no element with {condition} in {most} steps of Tab")

    def size(self, width, height, *, dark=False):
        self.command(
            "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=width < 600
        )
        wanted = {"prefers-color-scheme": "dark" if dark else "light", "prefers-reduced-motion": "reduce"}
        features = [{"name": name, "value": value} for name, value in wanted.items()]
        self.command("Emulation.setEmulatedMedia", features=features)

    def screenshot(self, path):
        data = self.command("Page.captureScreenshot", captureBeyondViewport=True)["data"]
        Path(path).write_bytes(base64.b64decode(data))


@contextmanager
def open_page(url, profile):
    """A tab at an address, in a browser of its own."""
    options = ["--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--no-first-run"]
    options += [f"--user-data-dir={profile}", "--remote-debugging-port=0", "--window-size=1280,900"]
    process = subprocess.Popen(
        [CHROMIUM, *options, "about:blank"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "HOME": str(profile)},
    )
    readers = []
    try:
        address = _debugger(process, readers)
        with connect(address, max_size=2**26, open_timeout=PATIENCE_S) as socket:
            page = Page(socket)
            for domain in ("Runtime", "Log", "DOM", "Page"):
                page.command(f"{domain}.enable")
            page.size(1280, 900)
            page.command("Page.navigate", url=url)
            yield page
    finally:
        process.terminate()
        process.wait(timeout=30)
        for thread in readers:
            thread.join()
        process.stderr.close()


def fetch_axe(folder):
    """axe-core as a script, from npm, pinned; it is not kept."""
    subprocess.run(["npm", "pack", "--silent", AXE], cwd=folder, check=True, stdout=subprocess.DEVNULL, timeout=120)
    with tarfile.open(next(folder.glob("*.tgz"))) as archive:
        return archive.extractfile("package/axe.min.js").read().decode()


def violations(page, axe, pictures):
    """What axe-core finds on the page in each look, by rule; screenshots go to ``pictures``-light.png ..."""
    pictures.parent.mkdir(parents=True, exist_ok=True)
    page.run(axe + "; true")
    found = {}
    for look, (width, height, dark) in LOOKS.items():
        page.size(width, height, dark=dark)
        result = json.loads(page.run("axe.run().then(found => JSON.stringify(found))"))
        assert result["passes"]
        page.screenshot(f"{pictures}-{look}.png")
        for violation in result["violations"]:
            nodes = [node["html"][:120] + node["failureSummary"] for node in violation["nodes"]]
            found.setdefault(violation["id"], []).append((look, nodes))
    return found


def _debugger(process, readers):
    for line in process.stderr:
        if port := re.search(r"DevTools listening on ws://127.0.0.1:(\d+)/", line):
            # Nobody reads the rest: a full pipe would stop the browser.
            readers.append(threading.Thread(target=process.stderr.read, daemon=True))
            readers[0].start()
            with urllib.request.urlopen(f"http://127.0.0.1:{port[1]}/json/list", timeout=PATIENCE_S) as answer:
                return next(tab["webSocketDebuggerUrl"] for tab in json.load(answer) if tab["type"] == "page")
    raise AssertionError("Chromium did not start.")
