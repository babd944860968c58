"""Recipes: what they hold, and what is said about mistakes in them."""

import json
import re

import pytest

from conftest import ROOT
from mwdn.data.simulated import Mismatch, Placement
from mwdn.errors import ParameterError, UnknownNameError
from mwdn.learning.recipe import Recipe, Schedule, read_recipe
from mwdn.networks import build

NETWORK = '[network]\nname = "wiener-bank"\nwidth = 4\n'


@pytest.fixture
def read(tmp_path):
    def call(text, **schedule):
        (tmp_path / "r.toml").write_text(text, encoding="utf-8")
        return read_recipe(tmp_path / "r.toml", **schedule)

    return call


@pytest.mark.parametrize("path", sorted((ROOT / "recipes").glob("*.toml")), ids=lambda path: path.stem)
def test_each_recipe_of_the_repository(path):
    recipe = read_recipe(path)
    assert build(**recipe.network)
    assert json.loads(json.dumps(recipe.as_dict()))["network"]["name"] == recipe.network["name"]


def test_network_alone_takes_defaults(read):
    assert read(NETWORK) == Recipe({"name": "wiener-bank", "width": 4})


def test_values_and_their_kinds(read):
    recipe = read(NETWORK + "[placement]\nextent = [0.2, 1]\nturn_degrees = 3\n[mismatch]\nshift_px = 0\n")
    assert recipe.placement == Placement(extent=(0.2, 1.0), turn_degrees=3.0)
    assert type(recipe.placement.turn_degrees) is float
    assert recipe.mismatch == Mismatch(shift_px=0.0)
    many = read('[network]\nname = "wiener-bank"\nwidth = 2\nregularisations = [1e-2, 1e-4]\n')
    assert build(**many.network).log_regularisations.exp().tolist() == pytest.approx([1e-2, 1e-4])


def test_overrides(read):
    text = NETWORK + "[schedule]\nsteps = 10\nbatch = 3\n"
    assert read(text, steps=7, batch=None, seed=5).schedule == Schedule(steps=7, batch=3, seed=5)
    assert read(NETWORK, steps=7).schedule == Schedule(steps=7)
    with pytest.raises(ParameterError, match=r"`steps` \(0\) must be positive"):
        read(text, steps=0)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (NETWORK + "[shedule]\nsteps = 3\n", "No table of a recipe named 'shedule'. Did you mean 'schedule'?"),
        (NETWORK + "[schedule]\nstep = 3\n", "No key of [schedule] named 'step'. Did you mean 'steps'?"),
        (NETWORK + "[mismatch]\nblur = 1\n", "No key of [mismatch] named 'blur'. Did you mean 'blur_px'?"),
        ('[network]\nname = "mwdm"\n', "No network named 'mwdm'. Did you mean 'mwdn'?"),
        (NETWORK + "widht = 3\n", "No option of the network 'wiener-bank' named 'widht'. Did you mean 'width'?"),
        (NETWORK + "[loss]\nmsee = 1\n", "No loss named 'msee'. Did you mean 'mse'?"),
    ],
)
def test_mistyped_names_get_the_nearest(read, text, said):
    with pytest.raises(UnknownNameError, match=re.escape(said)):
        read(text)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "must name a network"),
        ("network = 3", "`network` of `"),
        ("[network]\nname = 3", "must name a network"),
        ("[network", "cannot be read as a recipe"),
        (NETWORK + "[schedule]\nsteps = -1", "`steps` (-1) must be positive."),
        (NETWORK + "[schedule]\nsteps = 1.5", "`steps` of [schedule] (1.5) must be of the same kind"),
        (NETWORK + '[schedule]\nbatch = "4"', "`batch` of [schedule] ('4') must be of the same kind"),
        (NETWORK + "[schedule]\nbfloat16 = 1", "`bfloat16` of [schedule] (1) must be of the same kind"),
        (NETWORK + "[schedule]\nema = 1", "`ema` (1.0) must be in [0, 1)."),
        (NETWORK + "[schedule]\nlearning_rate = nan", "`learning_rate` (nan) must be positive."),
        (NETWORK + "[schedule]\nwarmup = -1", "`warmup` (-1) must not be negative."),
        (NETWORK + "[placement]\nextent = 0.3", "`extent` of [placement] (0.3) must be of the same"),
        (NETWORK + "[placement]\nextent = [0.7, 0.3]", "`extent` (0.7, 0.3) must be a range"),
        (NETWORK + "[placement]\nextent = [0, 0.3]", "`extent` (0.0, 0.3) must be positive"),
        (NETWORK + "[placement]\naspect = 0.5", "`aspect` (0.5) must be at least 1"),
        (NETWORK + "[placement]\noffset = 1.5", "`offset` (1.5) must be in [0, 1]"),
        (NETWORK + "[mismatch]\nshift_px = -1", "`shift_px` (-1.0) must not be negative"),
        (NETWORK + "[mismatch]\nbackground = 1", "`background` (1.0) must be below 1"),
        (NETWORK + "[sensor]\nbit_depth = 99", "`bit_depth` (99) must be 1 to 16."),
        (NETWORK + "[loss]\nmse = -1", "The weight of `mse` (-1) must be finite and not negative"),
        (NETWORK + '[loss]\nmse = "much"', "The weight of `mse` ('much') must be finite and not negative"),
        ('[network]\nname = "mwdn"\nwidth = "wide"', "cannot be built"),
    ],
)  # fmt: skip
def test_bad_values(read, text, said):
    with pytest.raises(ParameterError, match=re.escape(said)):
        read(text)


def test_no_such_file(tmp_path):
    with pytest.raises(ParameterError, match=r"`.*none\.toml` cannot be read as a recipe"):
        read_recipe(tmp_path / "none.toml")
