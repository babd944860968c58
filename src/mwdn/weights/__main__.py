"""Convert a trained network's weights to float16, to bundle them with the package.

python -m mwdn.weights runs/universal/best.safetensors src/mwdn/weights/universal.safetensors [DENOISER]

The first may be the name of a bundled network. DENOISER: checkpoint of a denoiser that replaces the network's own.
"""

import sys
from pathlib import Path

from mwdn.weights.bundled import bundle, find_weights

if __name__ == "__main__":
    bundle(*(find_weights(name) or Path(name) for name in sys.argv[1:]))
