"""Put a trained network's weights into the package, as float16.

python recipes/bundle.py runs/universal/best.safetensors src/mwdn/weights/universal.safetensors [DENOISER]

DENOISER: the checkpoint of another denoiser, which takes the place of the network's own.
"""

import sys
from pathlib import Path

from mwdn.weights.bundled import bundle

bundle(*map(Path, sys.argv[1:]))
