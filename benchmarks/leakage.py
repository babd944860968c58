"""Whether photographs of the test are also among those of the training.

    python benchmarks/leakage.py ../shared/data/photos/train ../shared/data/photos/test

Every photograph, grey and shrunk to 16 x 16 pixels, is correlated with every other one, also mirrored. A resized or
recompressed copy has a correlation of 0.99 and more; other photographs of one scene 0.9 to 0.98, and so have some that
share a layout only: look at the pairs that are printed.
"""

import argparse
from pathlib import Path

import torch
from torch.nn import functional as F

from mwdn.data.photographs import Photographs


def thumbnails(photographs):
    """(N, 256), each of mean 0 and norm 1."""
    rows = torch.arange(len(photographs)).split(200)
    small = [F.adaptive_avg_pool2d(photographs.light(part).sqrt().mean(1, keepdim=True), 16) for part in rows]
    flat = torch.cat(small).flatten(1)
    return F.normalize(flat - flat.mean(1, keepdim=True), dim=1)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("train", type=Path)
    parser.add_argument("test", type=Path)
    arguments = parser.parse_args()
    train, test = Photographs(arguments.train), Photographs(arguments.test)
    first, second = thumbnails(train), thumbnails(test)
    mirrored = second.unflatten(1, (16, 16)).flip(-1).flatten(1)
    likeness, nearest = torch.maximum(second @ first.T, mirrored @ first.T).max(1)
    for level in (0.9, 0.95, 0.98, 0.99):
        print(f"correlation above {level}: {int((likeness > level).sum())} of {len(test)} test photographs")
    for row in likeness.argsort(descending=True)[:6]:
        print(f"{likeness[row]:.3f} {test.names[row]} {train.names[nearest[row]]}")


if __name__ == "__main__":
    main()
