"""Convert a trained network's weights to float16, to bundle them with the package.

python recipes/bundle.py runs/universal/best.safetensors src/mwdn/weights/universal.safetensors [DENOISER]

DENOISER: checkpoint of a denoiser that replaces the network's own.
"""

import sys
from pathlib import Path

from mwdn.weights.bundled import bundle

bundle(*map(Path, sys.argv[1:]))
