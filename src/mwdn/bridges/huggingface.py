"""Trained networks as folders in the layout of the Hugging Face hub: config, weights, model card."""

import json
import re
import warnings
from pathlib import Path, PureWindowsPath
from typing import Any

from safetensors.torch import load_file, save_file
from torch import nn

from mwdn.arguments import checked
from mwdn.errors import CheckpointError, MwdnError
from mwdn.io.files import as_parameter_error, atomic, refuse_foreign, write_json, write_text
from mwdn.io.reading import read_json
from mwdn.weights.bundled import WEIGHTS_FILE, find_weights, load_network
from mwdn.weights.checkpoint import load_checkpoint, read_metadata

CONFIG, CARD = "config.json", "README.md"
"""Files of a folder, beside the weights."""

_LIBRARY = "mwdn"
_TAGS = ["lensless-imaging", "computational-imaging", "deconvolution", "image-reconstruction"]


@checked
def save_pretrained(method: str | Path, folder: str | Path, *, license: str | None = None) -> Path:
    """Write a trained network as a folder that can be uploaded to the Hugging Face hub.

    ``config.json`` names the network and its options, ``model.safetensors`` is the checkpoint, ``README.md`` the model
    card with metadata. A card that was edited stays, with a warning. Of absolute paths in the recipe only the last part
    is published.

    Args:
        method: path of a checkpoint of this package, or ``universal`` or ``universal-small``.
        folder: the folder; its name is the title of the card.
        license: identifier of the hub, for example ``mit``; that of the card before unless given.

    Returns:
        The folder.

    Raises:
        CheckpointError: no usable checkpoint of this package.
        ParameterError: the folder cannot be written to, or holds files of another origin.
    """
    source, folder = find_weights(str(method)) or Path(method), Path(folder)
    network, metadata = load_checkpoint(source), _without_folders(read_metadata(source))
    refuse_foreign(folder, (CONFIG, WEIGHTS_FILE), b'"library_name": "mwdn"')
    config = {"library_name": _LIBRARY, "model_type": metadata["name"], **metadata}
    card, title = folder / CARD, folder.resolve().name
    is_own, license_before = _own_card(folder)
    with as_parameter_error(folder, "Choose another one: `folder`."):
        write_json(folder / CONFIG, config)
        with atomic(folder / WEIGHTS_FILE) as temporary:
            save_file(load_file(source), temporary, metadata={"mwdn": json.dumps(metadata)})
        if is_own or not card.exists():
            write_text(card, _card(title, network, metadata, license or license_before))
        else:
            warnings.warn(
                f"`{card}` differs from what mwdn wrote, and stays: check that it describes these weights.",
                stacklevel=3,
            )
    return folder


def _without_folders(value: Any) -> Any:  # noqa: ANN401
    """Metadata with the last part of each absolute path, of any system: folders may name people and projects."""
    if isinstance(value, dict):
        return {key: _without_folders(part) for key, part in value.items()}
    if isinstance(value, list):
        return [_without_folders(part) for part in value]
    if isinstance(value, str) and (value.startswith(("/", "~")) or PureWindowsPath(value).drive):
        return PureWindowsPath(value).name
    return value


def _own_card(folder: Path) -> tuple[bool, str | None]:
    """Whether the card of a folder is as `save_pretrained` wrote it for the weights there, and its license."""
    try:
        written = (folder / CARD).read_text(encoding="utf-8")
        network, metadata = load_checkpoint(folder / WEIGHTS_FILE), read_metadata(folder / WEIGHTS_FILE)
    except (OSError, UnicodeDecodeError, MwdnError):
        return False, None
    stated = re.search(r'^license: "([^"]*)"$', written, re.MULTILINE)
    license = stated[1] if stated else None
    return written == _card(folder.resolve().name, network, metadata, license), license


@checked
def from_pretrained(name: str | Path) -> nn.Module:
    """Load a network, on the CPU, in evaluation mode.

    Args:
        name: a folder of `save_pretrained`, or ``owner/name`` on the Hugging Face hub, which needs the package
            ``huggingface_hub``.

    Raises:
        CheckpointError: no such folder or repository, a damaged file, or a config that is not that of the weights.
        ParameterError: ``config.json`` cannot be read.
    """
    folder = Path(name)
    if not folder.is_dir():
        of_hub = str(name).removeprefix("hub:")
        if of_hub.count("/") != 1:
            raise CheckpointError(f"`{name}` is no folder, and no `owner/name` of the Hugging Face hub.")
        try:
            return load_network(f"hub:{of_hub}")
        except CheckpointError as error:
            raise CheckpointError(f"There is no folder `{name}`, and on the hub: {error}") from error
    config, metadata = read_json(folder / CONFIG), read_metadata(folder / WEIGHTS_FILE)
    for key in ("name", "options"):
        if not isinstance(config, dict) or config.get(key) != metadata[key]:
            raise CheckpointError(
                f"`{folder / CONFIG}` and `{WEIGHTS_FILE}` must have the same `{key}`. Write the folder anew: "
                "`mwdn.bridges.save_pretrained`."
            )
    return load_checkpoint(folder / WEIGHTS_FILE)


def _card(title: str, network: nn.Module, metadata: dict[str, Any], license: str | None) -> str:
    """Model card: metadata in YAML, then text."""
    about: dict[str, Any] = {"library_name": _LIBRARY, "pipeline_tag": "image-to-image", "tags": _TAGS}
    about |= {"license": license} if license else {}
    numbers = sum(parameter.numel() for parameter in network.parameters())
    rows = {
        "network": f"`{metadata['name']}`, {numbers:,} parameters",
        "options": f"`{json.dumps(metadata['options'])}`",
        "camera": f"PSF `{metadata['psf_hash']}`" if metadata.get("psf_hash") else "any: the PSF is an input",
        "training step": metadata.get("step"),
        "validation PSNR": metadata.get("psnr") and f"{metadata['psnr']:.2f} dB",
        "mwdn": metadata.get("version"),
    }
    table = "\n".join(f"| {name} | {value} |" for name, value in rows.items() if value is not None)
    recipe = json.dumps(metadata["recipe"], indent=2) if "recipe" in metadata else "unknown"
    # JSON is YAML: each value on the line of its key.
    header = "".join(f"{key}: {json.dumps(value, ensure_ascii=False)}\n" for key, value in about.items())
    return f"---\n{header}---\n{_TEXT.format(title=title, table=table, recipe=recipe)}"


_TEXT = """
# {title}

Reconstructs the captures of a lensless camera. The PSF of the camera is an input.

| | |
| --- | --- |
{table}

```python
import mwdn

calibration = mwdn.Calibration.from_file("psf.png")
reconstruct = mwdn.Reconstructor("FOLDER, or hub:OWNER/NAME", calibration)
scene = reconstruct(mwdn.read_frame("capture.png"))
mwdn.write_picture("scene.png", mwdn.to_display(scene))
```

Detail below the noise of a capture is guessed, and a wrong PSF gives a wrong picture.

## Training

```json
{recipe}
```
"""
