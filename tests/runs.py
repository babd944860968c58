"""What a training run has left in its folder."""

import json

import torch
from safetensors.torch import load_file


def same(one, other):
    """Whether two files of weights hold the same numbers."""
    one, other = load_file(one), load_file(other)
    assert one.keys() == other.keys()
    return all(torch.equal(value, other[key]) for key, value in one.items())


def log(folder):
    return [json.loads(line) for line in (folder / "log.jsonl").read_text(encoding="utf-8").splitlines()]
