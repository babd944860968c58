"""The HTTP interface on a real socket: what is right is answered, what is wrong is refused with a reason."""

import errno
import io
import json
import socket
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from urllib.parse import urlsplit

import httpx2 as httpx
import numpy as np
import pytest
import tifffile
import torch

from mwdn import Reconstructor
from mwdn.calibration import Calibration
from mwdn.errors import ImageError, ParameterError
from mwdn.preview.cameras import StoredCameras
from mwdn.preview.jobs import Jobs
from mwdn.preview.reconstruction import with_ambient
from mwdn.preview.samples import SAMPLE_CAMERA
from preview_server import LIMITS, SIDE, hostile, npy


def order(client, capture, expect=200, /, files=None, **fields):
    fields = {"camera": "camera", "method": "wiener", "trust": "false", "format": "npy"} | fields
    fields = {name: value for name, value in fields.items() if value is not None}
    response = client.post("/reconstruct", files={"capture": capture, **(files or {})}, data=fields)
    assert response.status_code == expect, response.text[:500]
    return response


def test_picture_and_report_equal_the_package(client, capture, psf):
    response = order(client, capture)
    expected = Reconstructor("wiener", Calibration(psf), device="cpu")(np.load(io.BytesIO(capture)))
    np.testing.assert_allclose(np.load(io.BytesIO(response.content)), expected, atol=1e-6)
    report = json.loads(response.headers["mwdn-report"])
    assert report["method"] == "wiener"
    assert report["psf_hash"] == Calibration(psf).psf_hash


def test_uploaded_psf_and_options(client, capture, psf_file):
    smooth = order(
        client, capture, camera=None, files={"psf": psf_file}, options='{"regularisation": 1.0}', format="npy"
    )
    sharp = order(
        client, capture, camera=None, files={"psf": psf_file}, options='{"regularisation": 1e-5}', format="npy"
    )
    variations = [np.abs(np.diff(np.load(io.BytesIO(each.content)), axis=0)).sum() for each in (smooth, sharp)]
    assert variations[0] < variations[1]


def test_a_client_may_leave_a_number_to_the_method(client, capture):
    """`/methods` says that the regularisation is null by default."""
    fields = {"camera": "camera", "method": "wiener", "trust": "false", "format": "npy"}
    answers = [
        client.post("/reconstruct", files={"capture": capture}, data={**fields, "options": options})
        for options in ("{}", '{"regularisation": null}')
    ]
    assert [answer.status_code for answer in answers] == [200, 200]
    assert answers[0].content == answers[1].content
    none = {**fields, "method": "admm", "options": '{"iterations": null}'}
    assert client.post("/reconstruct", files={"capture": capture}, data=none).status_code == 422


@pytest.mark.parametrize(
    ("format", "start"), [("png", b"\x89PNG"), ("png16", b"\x89PNG"), ("tiff", b"II*\0"), ("npy", b"\x93NUMPY")]
)
def test_formats(client, capture, format, start):
    assert order(client, capture, format=format).content.startswith(start)


def test_exposure_and_white_balance(client, capture):
    import cv2

    def mean(**look):
        png = np.frombuffer(order(client, capture, format="png", **look).content, np.uint8)
        return cv2.imdecode(png, cv2.IMREAD_COLOR).astype(float).mean((0, 1))

    assert (mean(exposure="-2") < mean()).all()
    blue, _, red = mean(white_balance="4,1,0.25", exposure="-3")
    assert red > blue


def test_white_balance_of_the_camera_unless_another_is_asked_for(serve, psf, capture):
    calibration = Calibration(psf, white_balance=(1.0, 1.0, 4.0))
    server = serve(StoredCameras(LIMITS, None, {"camera": calibration}))

    with httpx.Client(base_url=server.url, timeout=120) as client:

        def scene(**look):
            return np.load(io.BytesIO(order(client, capture, format="npy", **look).content))

        own, none = scene(), scene(white_balance="none")
        np.testing.assert_allclose(own, none * np.float32([1, 1, 4]), rtol=1e-5)
        np.testing.assert_array_equal(scene(white_balance="camera"), own)


def test_verdicts(client, capture):
    report = json.loads(order(client, capture, trust="true").headers["mwdn-report"])
    assert {verdict["subject"] for verdict in report["verdicts"]} >= {"capture", "picture"}
    assert 0 < report["explained"] <= 1


@pytest.mark.parametrize(
    "kind",
    ["empty", "text", "truncated", "bomb", "many pixels", "not a number", "pickle", "dark", "other size"],
)
def test_hostile_captures_are_refused(client, capture, kind):
    data, named = hostile(capture)[kind]
    error = order(client, data, 422).json()["error"]
    assert named in error
    assert "/tmp" not in error
    assert "mwdn-" not in error


@pytest.mark.parametrize(
    ("fields", "status", "named"),
    [
        ({"method": "/etc/passwd"}, 422, "/etc/passwd"),
        ({"method": "hub:someone/something"}, 422, "hub:"),
        ({"camera": "../../etc/passwd"}, 404, "passwd"),
        ({"options": "[1]"}, 422, "options"),
        ({"options": '{"iterations": 3}'}, 422, "iterations"),
        ({"options": '{"regularisation": NaN}'}, 422, "`options` must be JSON: NaN"),
        ({"options": f'{{"regularisation": {400 * "9"}}}'}, 422, "regularisation"),
        ({"options": "[" * 5000}, 422, "options"),
        ({"trust": "perhaps"}, 422, "trust"),
        ({"format": "exe"}, 422, "format"),
        ({"exposure": "nan"}, 422, "exposure"),
        ({"white_balance": "1,2"}, 422, "white_balance"),
        ({"white_balance": "0,1,1"}, 422, "white_balance"),
        ({"calibration": '{"bin": 2}'}, 422, "calibration"),
        ({"unknown": "1"}, 422, "unknown"),
        ({"camera": None}, 422, "psf"),
    ],
)
def test_wrong_fields_are_named(client, capture, fields, status, named):
    assert named in order(client, capture, status, **fields).json()["error"]


def test_an_ambient_frame_on_another_scale_is_refused(psf):
    with pytest.raises(ParameterError, match=r"`ambient`.* 12\.5\b"):
        with_ambient(Calibration(psf), npy(np.full((SIDE, SIDE, 3), 12.5, np.float32)), LIMITS)


@pytest.mark.parametrize("option", ["dark", "ambient", "corrections", "path"])
def test_no_option_of_a_camera_names_a_file(client, capture, psf_file, option):
    calibration = json.dumps({option: "/etc/passwd"})
    error = order(client, capture, 422, camera=None, files={"psf": psf_file}, calibration=calibration).json()["error"]
    assert option in error


# Starlette before 1.10 leaves a file of a refused upload to the garbage collector.
@pytest.mark.filterwarnings("ignore:.*SpooledTemporaryFile:pytest.PytestUnraisableExceptionWarning")
def test_a_psf_too_small_to_judge_by_is_refused(client, capture, psf_file):
    cropped = '{"crop": [14, 14]}'
    error = order(client, capture, 422, camera=None, files={"psf": psf_file}, calibration=cropped).json()["error"]
    assert "(14 x 14) must have at least 15 pixels" in error


def test_upload_limit(client, capture):
    error = order(client, b"\0" * (LIMITS.upload_bytes + 1), 413).json()["error"]
    assert f"{LIMITS.upload_bytes:,}" in error

    def chunks():  # without a length
        yield b'--x\r\nContent-Disposition: form-data; name="capture"; filename="a"\r\n\r\n'
        for _ in range(8):
            yield b"\0" * (LIMITS.upload_bytes // 4)

    kind = {"content-type": "multipart/form-data; boundary=x"}
    with suppress(httpx.TransportError):  # the server may close the connection while the client is still sending
        assert client.post("/reconstruct", content=chunks(), headers=kind).status_code == 413


def test_job_has_progress_and_a_result(client, capture):
    fields = {"camera": "camera", "method": "admm", "trust": "false", "options": '{"iterations": 3}'}
    response = client.post("/jobs", files={"capture": capture}, data=fields)
    assert response.status_code == 202
    place = response.headers["location"]
    while (job := client.get(place).json())["state"] not in ("done", "failed"):
        pass
    assert (job["state"], job["progress"]) == ("done", 1)
    assert client.get(f"{place}/picture").content.startswith(b"\x89PNG")
    assert client.get(f"{place}/picture?fromat=npy").status_code == 422
    assert np.load(io.BytesIO(client.get(f"{place}/measurement?format=npy").content)).shape == (SIDE, SIDE, 3)


def test_the_numbers_of_a_measurement_may_be_negative(serve, capture, psf):
    camera = Calibration(psf, dark=torch.full((1, 1, SIDE, SIDE), 0.02))
    server = serve(StoredCameras(LIMITS, None, {"camera": camera}))
    with httpx.Client(base_url=server.url, timeout=120) as client:
        place = order(client, capture).headers["location"]
        expected = camera.correct(np.load(io.BytesIO(capture)))[0].movedim(0, -1).numpy()
        assert expected.min() < -0.01
        for format, read in (("npy", np.load), ("tiff", tifffile.imread)):
            stored = client.get(f"{place}/measurement?format={format}").content
            np.testing.assert_allclose(read(io.BytesIO(stored)), expected, atol=1e-6)


def test_job_can_be_cancelled(client, capture):
    fields = {"camera": "camera", "method": "admm", "trust": "false", "options": '{"iterations": 1000000000}'}
    place = client.post("/jobs", files={"capture": capture}, data=fields).headers["location"]
    waiting = client.post("/jobs", files={"capture": capture}, data=fields).headers["location"]
    while client.get(place).json()["state"] == "waiting":
        pass
    assert client.get(f"{place}/picture").status_code == 404
    assert client.delete(waiting).json()["state"] == "cancelled"
    client.delete(place)
    while (job := client.get(place).json())["state"] == "reconstructing":
        pass
    assert job["state"] == "cancelled"
    assert "report" not in job
    order(client, capture)  # the next one is served


def test_work_that_exits_ends_its_job_alone():
    """The worker ended with it, and no later job was done."""
    jobs = Jobs(LIMITS)

    def leave(job):
        raise SystemExit(0)

    try:
        ended = [jobs.submit(work, size=1) for work in (leave, lambda job: None)]
        while any(job.state not in ("failed", "done") for job in ended):
            time.sleep(0.01)
        assert [job.state for job in ended] == ["failed", "done"]
        assert "SystemExit" in str(ended[0].error)
    finally:
        jobs.close()


def test_stopping_ends_requests_in_progress_at_once(serve, psf, capture):
    """They ended after ten seconds, with a traceback and a page of plain text."""
    server, answers = serve(StoredCameras(LIMITS, None, {"camera": Calibration(psf)})), []
    fields = {"camera": "camera", "method": "admm", "trust": "false", "options": '{"iterations": 1000000000}'}

    def post():
        answers.append(httpx.post(f"{server.url}reconstruct", files={"capture": capture}, data=fields, timeout=60))

    threads = [threading.Thread(target=post) for _ in range(2)]
    for thread in threads:
        thread.start()
    metrics = f"{server.url}metrics"
    while "mwdn_jobs_running 1" not in (text := httpx.get(metrics).text) or "mwdn_jobs_waiting 1" not in text:
        pass
    server.stop()
    for thread in threads:
        thread.join()
    assert [(each.status_code, each.json()) for each in answers] == [
        (503, {"error": "The server is being stopped."})
    ] * 2


def test_cameras_are_listed_added_and_removed(serve, tmp_path, psf_file):
    server = serve(StoredCameras(LIMITS, tmp_path))
    with httpx.Client(base_url=server.url, timeout=120) as client:
        added = client.post("/cameras", files={"psf": psf_file}, data={"name": "mine"})
        assert added.status_code == 201, added.text
        assert client.post("/cameras", files={"psf": psf_file}, data={"name": "mine"}).status_code == 409
        assert client.post("/cameras", files={"psf": psf_file}, data={"name": "live"}).status_code == 409
        assert client.post("/cameras", files={"psf": psf_file}, data={"name": "../mine"}).status_code == 422
        assert {path.suffix for path in tmp_path.iterdir()} == {".json", ".psf"}
        assert "mine" not in "".join(path.name for path in tmp_path.iterdir())
        again = StoredCameras(LIMITS, tmp_path)  # another start of the server
        assert again.get("mine").psf_hash == added.json()["psf_hash"]
        stored = next(tmp_path.glob("*.psf"))
        content = stored.read_bytes()
        stored.write_bytes(content[:-9])
        with pytest.warns(UserWarning, match=rf"`{stored.with_suffix('.json')}` is left out"):
            assert SAMPLE_CAMERA in [each["name"] for each in StoredCameras(LIMITS, tmp_path).list()]
        stored.write_bytes(content)
        assert client.delete("/cameras/sample").status_code == 409
        assert client.delete("/cameras/mine").status_code == 204
        assert client.get("/cameras/mine").status_code == 404
        assert not list(tmp_path.iterdir())


def test_a_camera_that_cannot_be_stored_is_the_servers_fault(serve, tmp_path, psf_file, monkeypatch):
    (tmp_path / "file").touch()
    server = serve(StoredCameras(LIMITS, tmp_path / "file"))  # a file in the place of its folder
    answer = httpx.post(f"{server.url}cameras", files={"psf": psf_file}, data={"name": "mine"}, timeout=120)
    assert answer.status_code == 500
    assert "cannot store" in answer.text
    assert str(tmp_path) not in answer.text
    server = serve(StoredCameras(LIMITS, tmp_path / "folder"))

    def full(path, content):
        raise ImageError("full") from OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("mwdn.preview.cameras.write_json", full)
    answer = httpx.post(f"{server.url}cameras", files={"psf": psf_file}, data={"name": "mine"}, timeout=120)
    assert answer.status_code == 507


def test_a_field_that_is_given_twice_is_refused(client, psf_file, capture):
    files = [("psf", psf_file), ("capture", capture), ("capture", capture)]
    answer = client.post("/reconstruct", files=files)
    assert (answer.status_code, "`capture` is given twice" in answer.text) == (422, True)


def test_inspect(client):
    report = client.post("/inspect", files={"camera": (None, "camera")}).json()
    assert report["headline"]
    assert {finding["weight"] for finding in report["verdict"]} <= {"bad", "weak", "good"}


def test_the_document_names_every_route(client):
    document = client.get("/openapi.json").json()
    paths = document["paths"]
    assert f"{LIMITS.upload_bytes:,}" in document["info"]["description"]
    for path in ("/methods", "/samples", "/cameras", "/healthz", "/metrics"):
        assert "get" in paths[path]
        assert client.get(path).status_code == 200
    for path, operations in paths.items():  # each path is served: 405 means no such method, 404 no such thing
        for method in operations:
            place = path.replace("{name}", "nothing").replace("{id}", "nothing")
            response = client.request(method.upper(), place)
            assert response.status_code != 405, place
            assert str(response.status_code) in operations[method]["responses"], (place, response.status_code)


def test_method_that_a_path_has_not_is_answered_with_those_that_it_has(client):
    answer = client.request("TRACE", "/cameras/sample")
    assert answer.status_code == 405
    assert set(answer.headers["allow"].split(", ")) == {"GET", "HEAD", "DELETE"}
    assert client.head("/cameras/sample").status_code == 200


def test_job_with_a_wrong_look_is_refused(client, capture):
    response = client.post("/jobs", files={"capture": capture}, data={"camera": "camera", "exposure": "7"})
    assert response.status_code == 422
    assert "exposure" in response.json()["error"]


def test_a_job_has_the_look_that_it_was_ordered_with(client, capture):
    fields = {"camera": "camera", "method": "wiener", "trust": "false", "format": "npy", "exposure": "1"}
    place = client.post("/jobs", files={"capture": capture}, data=fields).headers["location"]
    while client.get(place).json()["state"] not in ("done", "failed"):
        pass
    assert client.get(f"{place}/picture").content.startswith(b"\x93NUMPY")
    brighter, plain = (client.get(f"{place}/picture?format=png{look}").content for look in ("", "&exposure=0"))
    assert brighter.startswith(b"\x89PNG")
    assert brighter != plain


def test_metrics_and_health(client, capture):
    before = client.get("/metrics").text
    order(client, capture)
    after = client.get("/metrics").text
    name = 'mwdn_reconstructions_total{method="wiener",outcome="done"}'

    def count(text):
        return next((float(line.split()[-1]) for line in text.splitlines() if line.startswith(name)), 0.0)

    assert count(after) == count(before) + 1
    assert client.get("/healthz").json()["status"] == "ok"


@pytest.mark.parametrize("path", ["/", "/methods", "/nothing", "/static/page.js"])
def test_security_headers(client, path):
    headers = client.get(path).headers
    assert "script-src 'self'" in headers["content-security-policy"]
    assert headers["x-content-type-options"] == "nosniff"
    assert headers["referrer-policy"] == "no-referrer"


@pytest.mark.parametrize("path", ["/static/../application.py", "/static/%2e%2e/application.py", "/static//etc/passwd"])
def test_static_files_stay_in_their_folder(client, path):
    host, port = urlsplit(str(client.base_url)).hostname, urlsplit(str(client.base_url)).port
    with socket.create_connection((host, port)) as raw:  # clients tidy such paths
        raw.sendall(f"GET {path} HTTP/1.1\r\nHost: {host}:{port}\r\nConnection: close\r\n\r\n".encode())
        assert b" 404 " in raw.makefile("rb").readline()


def test_good_and_bad_at_once_and_a_client_that_stalls(client, capture):
    expected = np.load(io.BytesIO(order(client, capture).content))
    bad = list(hostile(capture).values())
    address = urlsplit(str(client.base_url))
    stalled = socket.create_connection((address.hostname, address.port))
    stalled.sendall(
        f"POST /reconstruct HTTP/1.1\r\nHost: {address.netloc}\r\nContent-Length: 9999\r\n"
        "Content-Type: multipart/form-data; boundary=x\r\n\r\n--x".encode()
    )

    def ask(number):
        if number % 2:
            return order(client, bad[number // 2 % len(bad)][0], 422)
        return order(client, capture)

    with stalled, ThreadPoolExecutor(20) as pool:
        answers = list(pool.map(ask, range(40)))
    for answer in answers[::2]:
        np.testing.assert_array_equal(np.load(io.BytesIO(answer.content)), expected)
