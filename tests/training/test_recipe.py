"""Recipes: their values, and the messages for mistakes in them."""

import dataclasses
import json
import re

import pytest

from mwdn.benchmark.published import PUBLISHED
from mwdn.data.cameras import Cameras
from mwdn.data.mismatch import REAL_OPTIONS, Mismatch
from mwdn.data.simulated import Placement
from mwdn.errors import ParameterError, UnknownNameError
from mwdn.io.toml import packaged_recipes
from mwdn.networks import build
from mwdn.optics import Sensor
from mwdn.training.recipe import TABLES, Recipe, Schedule, read_recipe
from mwdn.training.schedule import make_lr_schedule

DENOISER = '[network]\nname = "drunet"\n'
NETWORK = '[network]\nname = "wiener-bank"\nwidth = 4\n'


@pytest.fixture
def read(tmp_path):
    def call(text, **schedule):
        (tmp_path / "r.toml").write_text(text, encoding="utf-8")
        return read_recipe(tmp_path / "r.toml", **schedule)

    return call


OTHERS = ("camera-", "benchmark-", "capture")
TRAININGS = [name for name in packaged_recipes() if not name.startswith(OTHERS)]


@pytest.mark.parametrize("name", TRAININGS)
def test_each_recipe_of_the_package(name):
    recipe = read_recipe(name)
    assert build(**recipe.network)
    assert json.loads(json.dumps(recipe.as_dict()))["network"]["name"] == recipe.network["name"]


def test_network_alone_takes_defaults(read):
    assert read(NETWORK) == Recipe({"name": "wiener-bank", "width": 4})


def test_values_and_their_types(read):
    recipe = read(NETWORK + "[placement]\nextent = [0.2, 1]\nturn_degrees = 3\n[mismatch]\nshift_px = 0\n")
    assert recipe.placement == Placement(extent=(0.2, 1.0), turn_degrees=3.0)
    assert type(recipe.placement.turn_degrees) is float
    assert recipe.mismatch == Mismatch(shift_px=0.0)
    many = read('[network]\nname = "wiener-bank"\nwidth = 2\nregularisations = [1e-2, 1e-4]\n')
    assert build(**many.network).regularisations == (1e-2, 1e-4)


@pytest.mark.parametrize("table", sorted(TABLES.keys() - {"sheet"}))
@pytest.mark.usefixtures("unchecked")
def test_tables_made_in_python_have_their_types(table):
    """A wrong one was raw Python's error, or one in the middle of a training."""
    for field in dataclasses.fields(TABLES[table]):
        with pytest.raises(ParameterError, match=f"`{field.name}`"):
            TABLES[table](**{field.name: 1.5 if isinstance(field.default, bool | str) else "a"})


def test_options_that_are_off_leave_the_identity_of_earlier_runs(read):
    """Otherwise no run begun before them could resume, and every cached sample would be computed again."""
    assert not set(REAL_OPTIONS) & read(NETWORK).as_dict()["mismatch"].keys()
    assert read(NETWORK + "[mismatch]\ntails = 0.1\n").as_dict()["mismatch"]["tails"] == 0.1


def test_overrides(read):
    text = NETWORK + "[schedule]\nsteps = 10\nbatch = 3\n"
    assert read(text, steps=7, batch=None, seed=5).schedule == Schedule(steps=7, batch=3, seed=5)
    assert read(NETWORK, steps=7).schedule == Schedule(steps=7)
    with pytest.raises(ParameterError, match=r"`steps` \(7\) and `epochs` \(3\) exclude each other"):
        read(text, steps=7, epochs=3)
    with pytest.raises(ParameterError, match=r"`steps` \(0\) must be positive"):
        read(text, steps=0)
    other = read(text, network={"width": 6}, mismatch={"blur_px": 1}, schedule={"crop": 8}, pool=5, loss={"l1": 2})
    assert (other.network["width"], other.mismatch, other.loss) == (6, Mismatch(blur_px=1.0), {"l1": 2.0})
    assert other.schedule == Schedule(steps=10, batch=3, crop=8, pool=5)
    with pytest.raises(UnknownNameError, match=r"No table of a recipe named 'mismatc'. Did you mean 'mismatch'"):
        read(text, mismatc={"blur_px": 1})
    with pytest.raises(UnknownNameError, match=r"No key of \[mismatch\] named 'blur'. Did you mean 'blur_px'"):
        read(text, mismatch={"blur": 1})


def test_a_renamed_key_still_works_and_warns_once(read):
    new = NETWORK + '[schedule]\nlr_schedule = "plateau"\n'
    for text, changes in ((new.replace("lr_schedule", "course"), {}), (NETWORK, {"course": "plateau"})):
        with pytest.warns(FutureWarning, match="`course` of .schedule. is now called `lr_schedule`") as warned:
            assert read(text, **changes) == read(new)
        assert len(warned) == 1
    with pytest.warns(FutureWarning):  # a change replaces the recipe's value, whichever names they use
        assert read(new, course="cosine").schedule.lr_schedule == "cosine"
    with pytest.warns(FutureWarning):
        assert read(new.replace("lr_schedule", "course"), lr_schedule="cosine").schedule.lr_schedule == "cosine"
    with pytest.raises(ParameterError, match="`course` and `lr_schedule`"):
        read(new + 'course = "plateau"\n')


def test_without_a_file_all_is_default():
    assert read_recipe(None, seed=3, sensor={"full_well": 2000}) == Recipe(
        schedule=Schedule(seed=3), sensor=Sensor(full_well=2000.0)
    )


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (NETWORK + "[shedule]\nsteps = 3\n", "No table of a recipe named 'shedule'. Did you mean 'schedule'?"),
        (NETWORK + "[schedule]\nstep = 3\n", "No key of [schedule] named 'step'. Did you mean 'steps'?"),
        (NETWORK + "[mismatch]\nblur = 1\n", "No key of [mismatch] named 'blur'. Did you mean 'blur_px'?"),
        ('[network]\nname = "mwdm"\n', "No network named 'mwdm'. Did you mean 'mwdn'?"),
        (NETWORK + "widht = 3\n", "No option of the network 'wiener-bank' named 'widht'. Did you mean 'width'?"),
        (NETWORK + "[loss]\nmsee = 1\n", "No loss named 'msee'. Did you mean 'mse'?"),
        (NETWORK + "[later_loss]\nmsee = 1\n", "No loss named 'msee'. Did you mean 'mse'?"),
        (NETWORK + '[schedule]\nlr_schedule = "plato"\n', "No lr_schedule named 'plato'. Did you mean 'plateau'?"),
        (NETWORK + '[schedule]\noptimiser = "adamv"\n', "No optimiser named 'adamv'. Did you mean 'adam'?"),
        (NETWORK + "[pairs]\nsplitt = 3\n", "No key of [pairs] named 'splitt'. Did you mean 'split'?"),
    ],
)
def test_mistyped_names_get_the_nearest(read, text, said):
    with pytest.raises(UnknownNameError, match=re.escape(said)):
        read(text)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "must name a network"),
        ("network = 3", "`network` (3) must be a table"),
        ("[network]\nname = 3", "must name a network"),
        ("[network", "cannot be read as a recipe"),
        (NETWORK + "[schedule]\nsteps = -1", "`steps` (-1) must be positive."),
        (NETWORK + "[schedule]\nsteps = 1.5", "`steps` of [schedule] (1.5) must be a whole number; the"),
        (NETWORK + '[schedule]\nbatch = "4"', "`batch` of [schedule] ('4') must be a whole number"),
        (NETWORK + "[schedule]\nbfloat16 = 1", "`bfloat16` of [schedule] (1) must be true or false"),
        (NETWORK + "[schedule]\nema = 1", "`ema` (1.0) must be in [0, 1)."),
        (NETWORK + "[schedule]\nlearning_rate = nan", "`learning_rate` (nan) must be finite."),
        (NETWORK + "[schedule]\nlearning_rate = inf", "`learning_rate` (inf) must be finite."),
        (NETWORK + "[sensor]\nfull_well = inf", "[sensor]: `full_well` (inf) must be finite."),
        (NETWORK + "[placement]\nexposure = [0.1, nan]", "[placement]: `exposure` (nan) must be finite."),
        (NETWORK + "[sensor]\nread_noise = 1e300", "[sensor]: `read_noise` (1e+300) must be 1e+09 at most."),
        (NETWORK + "[sensor]\nfull_well = 1000000000000", "`full_well` (1e+12) must be 1e+09 at most."),
        (NETWORK + "[sensor]\nfull_well = 1" + "0" * 400, "must have 63 bits at most."),
        (NETWORK + "[loss]\nmse = 1" + "0" * 400, "The weight of `mse` ("),
        ('[network]\nname = "mwdn"\nregularisation = inf', "`regularisation` (inf) of the network 'mwdn' must be"),
        ('[network]\nname = "mwdn"\nwidth = 20000', "[network]: the network 'mwdn' has 1,684,804,740,011 parameters"),
        ('[network]\nname = "updn"\ndepth = 10000000', "[network]: the network has too many layers. Lower its depth."),
        (NETWORK + '[cameras]\nsizes = ["²x99"]', '`sizes` of [cameras] ("'),
        (NETWORK + "[schedule]\ncrop = 8", "`crop` (8) applies to cached samples: set `pool`"),
        (NETWORK + f"[schedule]\nseed = {2**63 - 1}0", "must have 63 bits at most."),
        ('[network]\nname = "mwdn"\nwidth = 0', "[network]: `width` (0) must be at least 1"),
        ('[network]\nname = "mwdn"\nchannels = 0', "[network]: `channels` (0) must be at least 1"),
        ('[network]\nname = "mwdn"\nchannels = 2', "[network]: `channels` (2) must be 1 (grey) or 3 (RGB)"),
        (NETWORK + "[loss]\nmse = 0", "[loss]: The loss (mse) must have a weight above 0"),
        (NETWORK + "[loss]", "[loss]: The loss must name at least one of feature_mse, "),
        (NETWORK + "[schedule]\nwarmup = -1", "`warmup` (-1) must not be negative."),
        (NETWORK + "[schedule]\nepochs = -1", "`epochs` (-1) must not be negative."),
        (NETWORK + "[plateau]\nfactor = 1", "`factor` (1.0) must be in (0, 1)"),
        (NETWORK + "[plateau]\npatience = -1", "`patience` (-1) must not be negative"),
        (
            NETWORK + '[schedule]\nlr_schedule = "plateau"\nlearning_rate = 1e-9',
            "`learning_rate` (1e-09) must be at least `stop` (2e-08) of [plateau]",
        ),
        (NETWORK + "[plateau]\npatience = 3", "[plateau] needs `lr_schedule` (cosine) to be plateau."),
        (NETWORK + "[later_loss]\nmse = 1", "[later_loss] needs `lr_schedule` (cosine) to be plateau."),
        (
            NETWORK + '[schedule]\nlr_schedule = "plateau"\n[later_loss]\nl1 = 1',
            "[later_loss] (l1) must have the parts of [loss] (mse). Give",
        ),
        (NETWORK + "[sheet]\ncaptures = [3]", "`captures` of [sheet] ([3]) must be"),
        (NETWORK + '[sheet]\ncaptures = "a.png"', "`captures` of [sheet] ('a.png') must be a"),
        (NETWORK + "[pairs]\nfractions = [1, 0]", "`fractions` of [pairs] ([1, 0]) must be three numbers"),
        (NETWORK + "[placement]\nextent = 0.3", "`extent` of [placement] (0.3) must be two numbers"),
        (NETWORK + "[placement]\nextent = [0.7, 0.3]", "`extent` (0.7, 0.3) must be a range"),
        (NETWORK + "[placement]\nextent = [0, 0.3]", "`extent` (0.0, 0.3) must be positive"),
        (NETWORK + "[placement]\naspect = 0.5", "`aspect` (0.5) must be at least 1"),
        (NETWORK + "[placement]\noffset = 1.5", "`offset` (1.5) must be in [0, 1]"),
        (NETWORK + "[mismatch]\nshift_px = -1", "`shift_px` (-1.0) must not be negative"),
        (NETWORK + "[mismatch]\nhaze = 1", "`haze` (1.0) must be below 1"),
        (NETWORK + "[sensor]\nbit_depth = 99", "`bit_depth` (99) must be 1 to 16."),
        (NETWORK + "[loss]\nmse = -1", "The weight of `mse` (-1) must be finite and not negative"),
        (NETWORK + '[loss]\nmse = "much"', "The weight of `mse` ('much') must be finite and not negative"),
        ('[network]\nname = "mwdn"\nwidth = "wide"', "[network]: `width` ('wide') of the network 'mwdn' must be"),
        (DENOISER, "[denoising] and a denoising network (drunet)"),
        (NETWORK + "[denoising]\nlevels = [0.01, 0.1]", "[denoising] and a denoising network (drunet)"),
        (DENOISER + "[denoising]\nlevels = [0.1, 0.01]", "`levels` of [denoising] (0.1, 0.01) must rise from above 0"),
        (DENOISER + '[denoising]\nlevels = [0.01, 0.1]\n[cameras]\nsizes = ["32x32"]', "[denoising] has no camera"),
        (DENOISER + '[denoising]\nlevels = [0.01, 0.1]\n[sheet]\ncaptures = ["a.png"]', "[denoising] has no camera"),
    ],
)  # fmt: skip
def test_bad_values(read, text, said):
    with pytest.raises(ParameterError, match=re.escape(said)):
        read(text)


def test_captures_are_beside_the_recipe(read, tmp_path):
    recipe = read(NETWORK + f'[sheet]\ncaptures = ["a.png", "../b", "{tmp_path}/c"]')
    assert recipe.sheet.captures == (f"{tmp_path}/a.png", f"{tmp_path}/../b", f"{tmp_path}/c")
    assert read(NETWORK + "[sheet]\ncaptures = []").sheet.captures == ()
    assert read_recipe("quick-cpu", sheet={"captures": ["caps"]}).sheet.captures == ("caps",)


def test_steps_replace_epochs(read):
    text = NETWORK + "[schedule]\nepochs = 3\n"
    assert read(text).schedule.epochs == 3
    assert read(text, batch=2).schedule.epochs == 3
    assert (read(text, steps=5).schedule.epochs, read(text, steps=5).schedule.steps) == (0, 5)


def test_recipe_of_the_paper():
    """Training in section 4 of the paper and in its public code; its camera in section 4."""
    recipe = read_recipe("paper")
    schedule, plateau = recipe.schedule, recipe.plateau
    assert sum(p.numel() for p in build(**recipe.network).parameters()) == 17_267_531
    assert (schedule.optimiser, schedule.learning_rate, schedule.weight_decay) == ("adam", 1e-4, 1e-4)
    assert (schedule.lr_schedule, schedule.batch, schedule.epochs, schedule.validation) == ("plateau", 16, 300, 2500)
    assert (schedule.clip, schedule.ema, schedule.bfloat16) == (0, 0, False)
    assert (plateau.factor, plateau.patience, plateau.later, plateau.stop) == (0.1, 5, 1e-6, 2e-8)
    assert recipe.loss == {"mse": 1, "feature_mse": 1}
    assert recipe.later_loss == {"mse": 1, "feature_mse": 0.05}
    assert recipe.pairs.split == "paper"
    assert schedule.best_by == "loss"
    # A scene of 137 x 137, padded by 94 at the top and on the left to 320 x 320.
    extent, room = 137 / 320, 1 - 137 / 320
    assert recipe.placement.extent == pytest.approx((extent, extent), abs=1e-3)
    assert recipe.placement.offset * room * 160 == pytest.approx(94 - (320 - 137) / 2, abs=0.3)


@pytest.mark.parametrize("name", ["wiener", "unet", "wiener-unet", "mwdn-cpsf"])
def test_recipe_of_the_paper_for_the_other_networks(name):
    changed = read_recipe("paper", network={"name": name})
    assert changed.network == {"name": name}
    assert changed.schedule == read_recipe("paper").schedule


@pytest.mark.parametrize("name", ["le-admm-u", "mmcn", "updn"])
def test_recipes_of_compared_networks_have_their_published_settings(name):
    schedule, published = read_recipe(f"paper-{name}").schedule, PUBLISHED.get(name)
    if published:
        assert schedule.optimiser == published.optimiser
        assert schedule.weight_decay == published.weight_decay
        assert published.rate in (None, schedule.learning_rate)
        assert published.epochs in (None, schedule.epochs)
        assert published.batch in (None, schedule.batch)
        assert published.lr_schedule in (None, schedule.lr_schedule)


def test_recipe_of_the_authors_code():
    """Its rates are floats: 1e-4 x 0.1 x 0.1 is not yet 1e-6, so three of the four are the first phase."""
    recipe = read_recipe("paper-code")
    lr, phases = make_lr_schedule(recipe), []
    while not lr.finished:
        phases.append(lr.loss_weights["feature_mse"])
        for _ in range(7):
            lr = lr.after(1.0)
    assert phases == [1.0, 1.0, 1.0, 0.05]
    assert recipe.network["authors_form"]
    assert recipe.schedule.filter_rate == 1


def test_another_network_drops_the_options_of_the_first(read):
    assert read(NETWORK, network={"name": "mwdn"}).network == {"name": "mwdn"}
    assert read(NETWORK, network={"name": "mwdn", "width": 8}).network == {"name": "mwdn", "width": 8}
    assert read(NETWORK, network={"name": "wiener-bank", "fold": 1}).network["width"] == 4


def test_no_such_file(tmp_path):
    with pytest.raises(ParameterError, match=r"`.*none\.toml` does not exist"):
        read_recipe(tmp_path / "none.toml")


def test_cached_samples_of_several_sizes_need_a_crop():
    several = Cameras(("32x32", "48x32"))
    with pytest.raises(ParameterError, match="Set `crop`"):
        Recipe(schedule=Schedule(pool=4), cameras=several)
    assert Recipe(schedule=Schedule(pool=4, crop=32), cameras=several).cameras == several
