"""On a full disk each writer keeps the old file and says what was not written."""

from pathlib import Path

import pytest
import torch

from full_disk import full_after
from image_files import put
from mwdn.errors import ImageError
from mwdn.io.files import as_parameter_error, write_json
from mwdn.io.images import write_linear, write_picture
from mwdn.networks import build
from mwdn.optics.mask_files import write_gds, write_mask, write_stl
from mwdn.optics.masks import Mask
from mwdn.weights.checkpoint import save_network

PICTURE = torch.rand(3, 64, 64)
MASK = Mask("phase", torch.rand(64, 64), pitch_um=2.0, index=1.5, step_um=0.1)

WRITERS = {
    "a.png": lambda path: write_picture(path, PICTURE),
    "a.npy": lambda path: write_linear(path, PICTURE),
    "a.tif": lambda path: write_linear(path, PICTURE),
    "a.json": lambda path: write_json(path, {"text": "x" * 10_000}),
    "mask.tif": lambda path: write_mask(path, MASK),
    "a.gds": lambda path: write_gds(path, MASK),
    "a.stl": lambda path: write_stl(path, MASK),
}


@pytest.mark.parametrize("name", WRITERS)
@pytest.mark.parametrize("limit", [0, 100, 6000])
def test_the_old_file_stays(tmp_path: Path, name: str, limit: int, capfd: pytest.CaptureFixture[str]) -> None:
    """gdstk reported success; the file was cut off."""
    path = put(tmp_path / name, b"old")
    with full_after(limit), pytest.raises(ImageError, match=rf"`.*{name}` cannot be written: .*Make room"):
        WRITERS[name](path)
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]
    assert capfd.readouterr() == ("", "")
    WRITERS[name](path)
    assert path.stat().st_size > 6000


def test_weights(tmp_path: Path) -> None:
    """safetensors' own error was a traceback."""
    path = put(tmp_path / "a.safetensors", b"old")
    with full_after(1000), pytest.raises(OSError, match="File too large"):
        save_network(path, build("wiener-unet"), "wiener-unet", {})
    with full_after(1000), pytest.raises(ValueError, match="File too large"), as_parameter_error(tmp_path):
        save_network(path, build("wiener-unet"), "wiener-unet", {})
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]
