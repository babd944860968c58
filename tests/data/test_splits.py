import pytest

from mwdn.data import split
from mwdn.errors import ParameterError, UnknownNameError


def test_the_papers_split_is_by_position_with_test_first():
    parts = split(25_000, "paper")
    assert parts == {"train": range(5000, 25_000), "validation": range(2500, 5000), "test": range(2500)}
    assert split(25_000) == parts


def test_diffusercams_test_set_is_its_first_thousand():
    assert split(25_000, "diffusercam") == {"train": range(1000, 25_000), "test": range(1000)}


def test_phlatcams_split_is_of_ten_thousand_only():
    assert split(10_000, "phlatcam") == {"train": range(9900), "test": range(9900, 10_000)}
    with pytest.raises(ParameterError, match=r"`count` \(9,999\) must be 10,000 .* Import the whole"):
        split(9_999, "phlatcam")


@pytest.mark.parametrize("kind", ["paper", "diffusercam", "in-order", "random"])
@pytest.mark.parametrize("count", [1001, 1009, 5437])
def test_every_pair_is_in_exactly_one_part(kind, count):
    parts = split(count, kind)
    assert sorted(index for part in parts.values() for index in part) == list(range(count))
    assert all(list(part) == sorted(part) and len(part) for part in parts.values())


def test_random_follows_its_seed_and_its_fractions():
    parts = split(1000, "random", fractions=(0.5, 0.3, 0.2), seed=7)
    assert [len(parts[name]) for name in ("train", "validation", "test")] == [500, 300, 200]
    assert parts == split(1000, "random", fractions=(0.5, 0.3, 0.2), seed=7)
    assert parts != split(1000, "random", fractions=(0.5, 0.3, 0.2), seed=8)
    assert split(7, "random", fractions=(1.0, 0.0, 0.0)) == {"train": list(range(7)), "validation": [], "test": []}


def test_in_order_training_comes_first():
    parts = split(11, "in-order", fractions=(6 / 11, 2 / 11, 3 / 11))
    assert parts == {"train": [*range(6)], "validation": [6, 7], "test": [8, 9, 10]}


def test_a_negative_seed_is_refused():
    with pytest.raises(ParameterError, match=r"`seed` \(-1\)"):
        split(10, "random", seed=-1)


@pytest.mark.parametrize("fractions", [(0.8, 0.1), (0.8, 0.1, 0.2), (1.1, 0.0, -0.1), (float("nan"), 0.5, 0.5)])
def test_fractions_are_three_of_sum_one(fractions):
    with pytest.raises(ParameterError, match=r"`fractions` .* sum 1"):
        split(100, "random", fractions=fractions)


@pytest.mark.parametrize(("count", "kind"), [(9, "paper"), (1000, "diffusercam"), (3, "random"), (0, "random")])
def test_too_few_pairs(count, kind):
    with pytest.raises(ParameterError, match=r"pairs.* 'folds'"):
        split(count, kind)


def test_unknown_split():
    with pytest.raises(UnknownNameError, match="Did you mean 'paper'"):
        split(100, "papre")


@pytest.mark.parametrize(("count", "folds"), [(8, 4), (9, 4), (4, 4), (200, 4), (5, 2)])
def test_folds_hold_out_each_pair_once(count, folds):
    parts = [split(count, "folds", folds=folds, fold=fold) for fold in range(folds)]
    assert [index for part in parts for index in part["validation"]] == list(range(count))
    for part in parts:
        assert sorted([*part["train"], *part["validation"]]) == list(range(count))
        assert count // folds <= len(part["validation"]) <= -(-count // folds)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"folds": 1}, "`folds`"),
        ({"folds": 9}, "Use 8: `--pairs.folds 8`"),
        ({"fold": 4}, "`fold`"),
        ({"fold": -1}, "`fold`"),
    ],
)
def test_folds_that_do_not_exist(options, said):
    with pytest.raises(ParameterError, match=said):
        split(8, "folds", **options)
