"""Compare and read files of training runs."""

import json

import torch
from safetensors.torch import load_file


def same(one, other):
    """Whether two files of weights are equal."""
    one, other = load_file(one), load_file(other)
    assert one.keys() == other.keys()
    return all(torch.equal(value, other[key]) for key, value in one.items())


def log(folder):
    """Lines of a run's log."""
    return [json.loads(line) for line in (folder / "log.jsonl").read_text(encoding="utf-8").splitlines()]
