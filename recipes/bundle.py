"""Put a trained network's weights into the package, as float16.

python recipes/bundle.py runs/universal/best.safetensors src/mwdn/weights/universal.safetensors
"""

import sys
from pathlib import Path

from mwdn.learning.bundled import bundle

bundle(Path(sys.argv[1]), Path(sys.argv[2]))
