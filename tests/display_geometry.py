"""Where a picture's pixels are on a display: the truth for tests of the rig and of the alignment."""

import numpy as np


def from_picture(place, size):
    """Homography from the pixels of a picture (height, width) to a display's, where it is spread over a `Place`."""
    down, across = place.height / size[0], place.width / size[1]
    return np.array([[across, 0, (across - 1) / 2 + place.left], [0, down, (down - 1) / 2 + place.top], [0, 0, 1.0]])
