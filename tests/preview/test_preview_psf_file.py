"""What the file of a PSF tells besides its pixels: its type and EXIF orientation, of uploads and known cameras."""

import io
import json

import cv2
import httpx2 as httpx
import numpy as np
from PIL import Image

from mwdn.calibration import Calibration
from mwdn.inference.capture_pipeline import PsfFile
from mwdn.io.images import srgb_encode
from mwdn.preview.cameras import StoredCameras
from preview_server import LIMITS


def for_viewing(psf):
    """A PSF as a JPEG."""
    coded = srgb_encode(psf / psf.max() * 0.9)[0].movedim(0, -1).numpy()
    bgr = (255 * coded[..., ::-1]).round().astype(np.uint8)
    return cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, 100])[1].tobytes()


def turned_by_exif(psf):
    """A PSF, mirrored, because a right one settles the doubt, whose EXIF orientation is 6."""
    pixels, exif, file = psf[0].flip(-1).movedim(0, -1) / psf.max(), Image.Exif(), io.BytesIO()
    exif[274] = 6
    Image.fromarray((255 * pixels).round().byte().numpy()).save(file, "png", exif=exif)
    return file.getvalue()


def test_a_psf_for_viewing_is_doubted_as_on_the_command_line(client, psf, capture):
    files = {"capture": capture, "psf": for_viewing(psf)}
    response = client.post("/reconstruct", files=files, data={"method": "wiener"})
    verdicts = json.loads(response.headers["mwdn-report"])["verdicts"]
    assert [each["options"] for each in verdicts if each["topic"] == "psf-gamma"] == ["--psf-gamma srgb"]


def verdict_options(client, capture, topic, **data):
    response = client.post("/reconstruct", files={"capture": capture}, data={"method": "wiener"} | data)
    verdicts = json.loads(response.headers["mwdn-report"])["verdicts"]
    return [each["options"] for each in verdicts if each["topic"] == topic]


def test_a_stored_camera_keeps_what_the_file_of_its_psf_tells(serve, psf, capture, tmp_path):
    server = serve(StoredCameras(LIMITS, tmp_path))
    with httpx.Client(base_url=server.url, timeout=120) as client:
        for name, file in (("coded", for_viewing(psf)), ("turned", turned_by_exif(psf))):
            assert client.post("/cameras", files={"psf": file}, data={"name": name}).status_code == 201
        assert verdict_options(client, capture, "psf-gamma", camera="coded") == ["--psf-gamma srgb"]
        assert verdict_options(client, capture, "exif", camera="turned") == ["--psf-orientation rotate-270"]
    again = serve(StoredCameras(LIMITS, tmp_path))  # another start of the server
    with httpx.Client(base_url=again.url, timeout=120) as client:
        assert verdict_options(client, capture, "exif", camera="turned") == ["--psf-orientation rotate-270"]
        assert client.delete("/cameras/turned").status_code == 204


def test_a_given_camera_is_compared_with_the_file_of_its_psf(serve, psf, capture, tmp_path):
    """By default nothing is known of the file."""
    (tmp_path / "psf.png").write_bytes(turned_by_exif(psf))
    given = dict.fromkeys(("known", "array"), Calibration.from_file(tmp_path / "psf.png"))
    files = {"known": PsfFile.read(tmp_path / "psf.png")}
    server = serve(StoredCameras(LIMITS, None, given, files))
    with httpx.Client(base_url=server.url, timeout=120) as client:
        assert verdict_options(client, capture, "exif", camera="known") == ["--psf-orientation rotate-270"]
        assert not verdict_options(client, capture, "exif", camera="array")


def test_exif_turns_that_differ_are_doubted_as_on_the_command_line(client, psf, capture):
    files = {"capture": capture, "psf": turned_by_exif(psf)}
    response = client.post("/reconstruct", files=files, data={"method": "wiener"})
    verdicts = json.loads(response.headers["mwdn-report"])["verdicts"]
    assert [each["options"] for each in verdicts if each["topic"] == "exif"] == ["--psf-orientation rotate-270"]
