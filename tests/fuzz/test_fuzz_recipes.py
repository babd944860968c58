"""Recipes with wrong values or damaged text: refused on one line, or good for a finite sample."""

import itertools
import json
import warnings
from dataclasses import asdict

import driver
import numpy as np
import pytest
import torch

from mwdn.data.photographs import Photographs
from mwdn.data.simulated import SimulatedPairs
from mwdn.io.images import write_picture
from mwdn.io.toml import RECIPES, packaged_recipes
from mwdn.optics import unit_sum
from mwdn.training.recipe import TABLES, read_recipe

pytestmark = pytest.mark.usefixtures("unchecked")

SIMULATION = "\n".join(
    ["[network]", 'name = "unet"']
    + [
        line
        for table in ("placement", "mismatch", "sensor")
        for line in (f"[{table}]", *(f"{key} = {json.dumps(value)}" for key, value in asdict(TABLES[table]()).items()))
    ]
)
"""Every number of a simulated camera, with its default."""

OTHERS = ("benchmark-", "camera-")
TEXTS = [(RECIPES / f"{name}.toml").read_text() for name in packaged_recipes() if not name.startswith(OTHERS)]

VALUES = (
    *("inf", "-inf", "nan", "-1", "0", "1", "1.5", "1e300", "-1e-300", "9" * 30, "9" * 400, "9" * 5000, "true", '""'),
    *('"inf"', "[]", "[inf, nan]", "[0.1, 0.2]", "{}", "{a = 1}", "2026-11-24", "[[[]]]", "[" * 2000, "{a=" * 2000),
    *("'\\u0000'", '"' + "x" * 100_000 + '"', '["\u00b2x99"]', '["99999x99999"]', "0x7fffffffffffffff", "1e9", "1e8"),
)


NUMBERS = ("0", "1e-9", "0.01", "0.5", "1", "3", "20", "1000", "1e9", "[0.5, 0.6]", "[1e-9, 1e-9]", "[1e8, 1e9]")


def cases(seed):
    random = np.random.default_rng(seed)
    while True:
        text = SIMULATION if random.random() < 0.75 else str(random.choice(TEXTS))
        if random.random() < 0.2:
            yield driver.damaged(text.encode(), random)
            continue
        lines = text.splitlines()
        for _ in range(random.integers(1, 3)):
            at = int(random.choice([i for i, line in enumerate(lines) if "=" in line and line[0] != "#"]))
            lines[at] = f"{lines[at].partition('=')[0]}= {random.choice(NUMBERS if random.random() < 0.6 else VALUES)}"
        yield "\n".join(lines).encode()


@pytest.fixture
def use(tmp_path):
    """Read a recipe, and simulate a sample by it."""
    pixels = np.random.default_rng(29).integers(0, 256, (24, 24, 3), np.uint8)
    write_picture(tmp_path / "photos" / "a.png", torch.from_numpy(pixels / np.float32(255)).movedim(-1, 0)[None])
    photographs, psf = Photographs(tmp_path / "photos", side=24), unit_sum(torch.rand(1, 3, 16, 20))

    def simulate(path):
        with warnings.catch_warnings(action="ignore", category=FutureWarning):
            recipe = read_recipe(path)
        pairs = SimulatedPairs(photographs, psf, recipe.placement, recipe.mismatch, recipe.sensor, recipe.schedule.seed)
        sample = pairs.batch([0])
        assert sample.measurement.isfinite().all()
        assert sample.scene.isfinite().all()

    return simulate


def test_damaged_recipes(tmp_path, use):
    """`inf` and `nan` passed, and ended later as "invalid Poisson rate"; nesting and digits were tracebacks."""
    outcomes = driver.sweep(itertools.islice(cases(29), 120), use, tmp_path / "a.toml", named=False)
    assert driver.failures(outcomes) == []
    assert min(outcomes["refused"], outcomes["taken"]) > 15


@pytest.mark.acceptance
def test_damaged_recipes_for_long(tmp_path, use):
    endless = cases(np.random.SeedSequence().entropy)
    outcomes = driver.sweep(endless, use, tmp_path / "a.toml", duration_s=driver.DURATION_S, named=False)
    print(dict(outcomes))
    assert driver.failures(outcomes) == []
