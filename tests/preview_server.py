"""What the tests of the server share: small limits, and files."""

import io

import numpy as np

from mwdn.preview.limits import Limits

SIDE = 48
LIMITS = Limits(upload_bytes=200_000, frame_pixels=4 * SIDE**2, pixels=2 * SIDE**2, seconds=60.0, waiting=64, cameras=2)


def npy(array):
    """An array as the bytes of a file."""
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()
