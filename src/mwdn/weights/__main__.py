"""Convert a trained network's weights to float16, to bundle them with the package.

python -m mwdn.weights runs/universal/best.safetensors src/mwdn/weights/universal.safetensors [DENOISER]
"""

from argparse import ArgumentParser
from pathlib import Path

from mwdn.errors import MwdnError
from mwdn.weights.bundled import bundle, find_weights

if __name__ == "__main__":
    parser = ArgumentParser("python -m mwdn.weights", description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("checkpoint", help="of a network, or the name of a bundled one")
    parser.add_argument("out", type=Path, help="file to write, ending in .safetensors")
    parser.add_argument("denoiser", type=Path, nargs="?", help="checkpoint that replaces the network's own denoiser")
    given = parser.parse_args()
    try:
        bundle(find_weights(given.checkpoint) or Path(given.checkpoint), given.out, given.denoiser)
    except (MwdnError, OSError) as error:
        parser.exit(2, f"Error: {error}\n")
