"""Division of pairs into training, validation and test."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from mwdn.errors import ParameterError, UnknownNameError

Split = dict[str, range | list[int]]
"""Positions of the pairs for ``"train"``, ``"test"`` and, if the protocol has it, ``"validation"``."""

SPLIT_KINDS = ("paper", "diffusercam", "phlatcam", "in-order", "random", "folds")


def split(
    count: int,
    kind: str = "paper",
    *,
    fractions: Sequence[float] = (0.8, 0.1, 0.1),
    seed: int = 0,
    folds: int = 4,
    fold: int = 0,
) -> Split:
    """Divide pairs by a published protocol or at random.

    The published protocols are defined by position, so they are valid only if no pair was skipped at the import.

    Args:
        count: number of pairs in the file.
        kind: ``"paper"``, 8:1:1 by position, test first, then validation, then training;
            ``"diffusercam"``, test the first 1,000 (im1 to im1000), the rest training;
            ``"phlatcam"``, 9,900 for training, then 100 for test, in the order of ``mwdn import phlatcam``;
            ``"in-order"``, by ``fractions`` and position, training first, then validation, then test;
            ``"random"``, by ``fractions`` and ``seed``;
            ``"folds"``, for few pairs: one of ``folds`` parts by position validation, the rest training. Neighbours,
            which are often of one scene, stay together.
        fractions: of training, validation and test, with sum 1; only for ``"random"`` and ``"in-order"``.
        seed: only for ``"random"``; the same seed gives the same division on every machine.
        folds: number of parts, of equal size to one pair; only for ``"folds"``.
        fold: number of the part for validation, from 0; only for ``"folds"``.

    Returns:
        Disjoint positions in ascending order; together they are ``range(count)``.

    Raises:
        UnknownNameError: no such kind.
        ParameterError: too few pairs for the kind, not 10,000 for ``"phlatcam"``, fractions that do not sum to 1, or
            no such fold.
    """
    match kind:
        case "paper":
            tenth = count // 10
            _require(count, 10, kind)
            return {
                "train": range(2 * tenth, count),
                "validation": range(tenth, 2 * tenth),
                "test": range(tenth),
            }
        case "diffusercam":
            _require(count, 1001, kind)
            return {"train": range(1000, count), "test": range(1000)}
        case "phlatcam":
            if count != 10_000:
                raise ParameterError(
                    f"`count` ({count:,}) must be 10,000 for the split 'phlatcam': 9,900 for training, 100 for test. "
                    "Import the whole data set, or use 'random'."
                )
            return {"train": range(9900), "test": range(9900, 10_000)}
        case "in-order":
            return _by_fractions(np.arange(count), fractions)
        case "random":
            if seed < 0:
                raise ParameterError(f"`seed` ({seed}) of the split 'random' must not be negative.")
            return _by_fractions(np.random.default_rng(seed).permutation(count), fractions)
        case "folds":
            return _folds(count, folds, fold)
    raise UnknownNameError("split", kind, SPLIT_KINDS)


def _require(count: int, least: int, kind: str) -> None:
    if count < least:
        raise ParameterError(
            f"The split '{kind}' needs at least {least:,} pairs, but there are {count:,}. Use 'random', or for few "
            "pairs 'folds'."
        )


def _by_fractions(order: npt.NDArray[np.int64], fractions: Sequence[float]) -> Split:
    """Parts of the positions in this order."""
    count = len(order)
    if len(fractions) != 3 or not (min(fractions) >= 0 and abs(sum(fractions) - 1) <= 1e-6):
        raise ParameterError(f"`fractions` {tuple(fractions)} must be three numbers >= 0 with sum 1: (0.8, 0.1, 0.1).")
    parts = dict(zip(("train", "validation", "test"), fractions, strict=True))
    ends = np.rint(np.cumsum(list(fractions)) * count).astype(int)
    result: Split = {name: sorted(part.tolist()) for name, part in zip(parts, np.split(order, ends[:-1]), strict=True)}
    if empty := [name for name, fraction in parts.items() if fraction > 0 and not result[name]]:
        raise ParameterError(
            f"`fractions` {tuple(fractions)} of {count:,} pairs leave none for {', '.join(empty)}. Use larger ones, or "
            "for few pairs the split 'folds'."
        )
    return result


def _folds(count: int, folds: int, fold: int) -> Split:
    if count < 2:
        raise ParameterError(f"The split 'folds' needs two pairs or more, but there is {count}: one part is held back.")
    if not 2 <= folds <= count:
        advice = f" Use {count}: `--pairs.folds {count}`." if count < folds else ""
        raise ParameterError(
            f"`folds` ({folds}) must be 2 or more, and at most the number of pairs ({count:,}).{advice}"
        )
    if not 0 <= fold < folds:
        raise ParameterError(f"`fold` ({fold}) must be from 0 to {folds - 1}, for {folds} `folds`.")
    first, end = (count * part // folds for part in (fold, fold + 1))
    return {"train": [*range(first), *range(end, count)], "validation": range(first, end), "test": range(0)}
