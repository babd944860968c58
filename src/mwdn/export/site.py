"""A folder for static hosts: one page that reconstructs a camera's captures in the visitor's browser."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mwdn.arguments import checked
from mwdn.calibration import Calibration
from mwdn.calibration.pixel_repair import PixelRepair
from mwdn.calibration.refinement import MIN_FIELD
from mwdn.errors import ParameterError
from mwdn.export.exporter import Exported, agreement, check_agreement, exact_reconstructor, simulate_captures
from mwdn.export.network_models import NetworkModels, network_models, run_models
from mwdn.export.site_scripts import constant, joined_modules, read_static, stored
from mwdn.export.web_runtime import BINARIES, LIBRARIES, PACKAGE, RUNTIME_VERSION, read_runtime
from mwdn.inference.methods import Method, as_method
from mwdn.io.files import as_parameter_error, atomic, check_folder, refuse_foreign
from mwdn.io.images import encode_png
from mwdn.io.pictures import PICTURES
from mwdn.networks.network import Network
from mwdn.types import Measurement, Scene
from mwdn.version import __version__

CHECKED = 4096
"""Pixels of the first sample's scene that the page compares with the package's."""

SITE_FILES = (
    "index.html",
    "page.css",
    "site.css",
    "icon.svg",
    "welcome.svg",
    "page.js",
    "camera.js",
    "network.js",
    *(name for kind, library in LIBRARIES.items() for name in (library, f"runtime-{kind}.js")),
    "LICENSES.txt",
)
"""Files of a site; the first has a mark that lets a later export replace them."""

_MARK = b"<!-- mwdn export -->"


@checked
def export_site(
    method: Method | str | Path,
    calibration: Calibration,
    out: str | Path,
    *,
    runtime: str | Path | None = None,
    name: str = "the camera",
    least: float | None = None,
) -> Exported:
    """Write a static page that reconstructs captures of this camera, or of any other camera of its picture size.

    The network takes the PSF as an input: the page prepares this camera's, or one that a visitor drops. Before anything
    is written, the network's files are run in onnxruntime and compared with `Reconstructor`; the page compares itself
    again in each browser.

    Args:
        method: a bundled network that does not align the PSF, or a checkpoint.
        calibration: of the camera that the page starts with.
        out: folder; files of an earlier site in it are replaced, all others stay.
        runtime: folder of the unpacked npm package, see `mwdn.export.web_runtime`; fetched by npm unless given.
        name: of the camera, shown on the page.
        least: minimum agreement in dB, in place of `MIN_AGREEMENT`.

    Raises:
        ExportError: the network cannot be written as ONNX or agrees too little; or onnxruntime-web cannot be had.
        ParameterError: the method is a solver, aligns or takes the PSF as stored; or ``out`` cannot be written or holds
            files of others.
        MwdnError: as for `Reconstructor`.
    """
    out = Path(out)
    if out.exists() and not out.is_dir():
        raise ParameterError(f"`out` ({out}) must be a folder, but is a file. Choose another one: `-o site`.")
    check_folder(out)
    refuse_foreign(out, SITE_FILES, _MARK)
    network = _network(method)
    binaries = read_runtime(None if runtime is None else Path(runtime))
    channels = network.channels or calibration.psf.shape[1]
    models = network_models(network, calibration.size, channels)
    captures = _sample_captures(calibration)
    exact = exact_reconstructor(method, network, calibration)
    scenes = exact.as_recorded(exact.on_device(captures.float() / 65535))
    reached = _compare(models, calibration, captures, scenes, channels)
    check_agreement(reached, "The page", _title(method), least=least)
    about = {"method": _title(method), "version": __version__, "runtime": f"{PACKAGE} {RUNTIME_VERSION}"}
    camera = _camera(calibration, about | {"name": name}, channels, scenes)
    images = {key: _bytes(image) for key, image in _images(calibration).items()}
    frames = captures.movedim(1, -1).numpy().astype("uint16")
    samples = {f"{key}.png": encode_png(frame, f"{key}.png") for key, frame in zip(PICTURES, frames, strict=True)}
    texts = [name for name in SITE_FILES if not name.endswith(".js")]
    contents = {name: read_static(name) for name in texts}
    contents |= {
        "page.js": joined_modules(),
        "camera.js": constant("mwdnCamera", camera) + stored(images | samples),
        "network.js": stored({f"{key}.onnx": content for key, content in models._asdict().items()}),
        **_runtime_scripts(binaries),
    }
    _write(out, contents)
    return Exported(out, reached, about)


def _network(method: Method | str | Path) -> Network[Any]:
    network = as_method(method)
    if not isinstance(network, Network):
        raise ParameterError(
            f"`method` ({_title(method)}) must be a network for a page, but is none. Use `universal-small`, or a "
            "checkpoint."
        )
    if network.align:
        raise ParameterError(
            f"`method` ({_title(method)}) aligns the PSF to each capture by dozens of reconstructions, which takes too "
            "long in a browser. Use `universal-small`."
        )
    if network.stored_psf:
        raise ParameterError(
            f"`method` ({_title(method)}) takes the PSF as its file stores it, as the authors' networks do, but a page "
            "scales each colour to unit sum. Use `universal-small`."
        )
    return network


def _title(method: Method | str | Path) -> str:
    """Name of a bundled network, or of a checkpoint without its folders, which a public page should not show."""
    return Path(method).name if isinstance(method, str | Path) else type(method).__name__


def _sample_captures(calibration: Calibration) -> Tensor:
    """Measurements of `PICTURES` as whole numbers up to 65,535, (3, C, H, W)."""
    captures = simulate_captures(calibration, PICTURES, calibration.psf.shape[1])[: len(PICTURES)]
    return (captures.clamp(0, 1) * 65535).round().int()


def _compare(models: NetworkModels, calibration: Calibration, captures: Tensor, scenes: Scene, channels: int) -> float:
    """Agreement in dB with the reconstructor; grey is given as equal colours, as the page does."""
    psf = calibration.psf.expand(-1, channels, -1, -1).contiguous()
    measurements: Measurement = (captures.float() / 65535).expand(-1, channels, -1, -1).contiguous()
    result = run_models(models, psf, measurements)
    return agreement(result if scenes.shape[1] > 1 else result.mean(1, keepdim=True), scenes)


def _camera(calibration: Calibration, about: Mapping[str, str], channels: int, scenes: Scene) -> dict[str, Any]:
    """Data of the camera for the page, besides its images."""
    values = scenes[0].flatten()
    step = max(1, len(values) // CHECKED) | 1  # odd: not the same columns of each row
    frames = calibration.frames
    fields = ("bit_depth", "gamma", "bgr", "crop", "mosaic", "grey", "bin", "upside_down")
    return {
        **about,
        "about": _in_words(calibration),
        "size": calibration.size,
        "channels": channels,
        "light": calibration.light,
        "white_balance": calibration.white_balance,
        "format": {name: getattr(frames, name) for name in fields} | {"hot_pixels": _hot_pixels(calibration)},
        "images": {
            name: {"channels": image.shape[1], "height": image.shape[2], "width": image.shape[3]}
            for name, image in _images(calibration).items()
        },
        "samples": PICTURES,
        "expected": {"step": step, "values": [float(f"{value:.7g}") for value in values[::step].tolist()]},
    }


def _in_words(calibration: Calibration) -> str:
    """What the page does with a frame, for its visitors; `mwdn.export.exporter` says what a program must do."""
    frames = calibration.frames
    steps = (
        "" if frames.bit_depth is None else f"{frames.bit_depth} bits",
        "" if frames.mosaic is None else f"mosaic {frames.mosaic}",
        "" if frames.crop is None else f"cropped to {frames.crop[0]} x {frames.crop[1]}",
        "" if frames.bin == 1 else f"binned by {frames.bin}",
        "" if frames.gamma is None else f"gamma {frames.gamma}",
        "" if calibration.dark is None else "dark frame subtracted",
        "" if calibration.ambient is None else "light of the room subtracted",
    )
    return ", ".join(filter(None, steps))


def _images(calibration: Calibration) -> dict[str, Tensor]:
    """The PSF, and what is applied to each frame."""
    stray, field = (
        make(calibration.size) for make in (calibration.refinement.stray_map, calibration.refinement.field_map)
    )
    images = {
        "psf": calibration.psf,
        "offset": calibration.offset,
        "flat": calibration.corrections.flat,
        "stray": stray,
        "field": None if field is None else field.clamp(min=MIN_FIELD),
    }
    return {name: image for name, image in images.items() if image is not None}


def _hot_pixels(calibration: Calibration) -> list[tuple[int, list[int]]] | None:
    """Each hot pixel with its good neighbours, whose mean replaces it; ``None`` if the page must find them itself."""
    if calibration.corrections.defects is None:
        return None
    repair = PixelRepair(calibration.corrections.defects[0, 0], calibration.frames.cell)
    return [
        (pixel, neighbours[weights > 0].tolist())
        for pixel, neighbours, weights in zip(repair.index.tolist(), repair.neighbours.T, repair.weights.T, strict=True)
    ]


def _bytes(image: Tensor) -> bytes:
    return image.to(torch.float32).contiguous().numpy().astype("<f4").tobytes()


def _runtime_scripts(binaries: Mapping[str, bytes]) -> dict[str, str]:
    scripts = {name: binaries[name].decode("utf-8") for name in LIBRARIES.values()}
    for kind, name in BINARIES.items():
        scripts[f"runtime-{kind}.js"] = stored(
            {f"{kind}{suffix}": binaries[name + suffix] for suffix in (".mjs", ".wasm")}
        )
    return scripts


def _write(out: Path, contents: Mapping[str, str]) -> None:
    for name in SITE_FILES:
        with as_parameter_error(out), atomic(out / name) as temporary:
            temporary.write_text(contents[name], encoding="utf-8")
