"""Choose the terms of a `Refinement` by leaving pairs out.

In each round, each term is tried at each order beyond the one it has, on top of the terms taken so far. Terms are
scored by cross-validation: the pairs are split into parts (`left_out`); for each part, terms are fitted to the other
parts, and only gain and offset to its own pairs.

The best term is taken if it lowers the mean unexplained part by `MIN_IMPROVEMENT`, and that of more than half of the
pairs. The field dependence, which no solver uses, comes last: fitted together with the other terms, it would absorb
what they can explain.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from statistics import fmean

from mwdn.calibration.pair_model import Fit, PairModel, Terms
from mwdn.errors import ParameterError
from mwdn.types import Measurement, Psf, Scene

MIN_IMPROVEMENT = 0.02
"""Relative decrease of the unexplained part that makes a term worth taking."""

HIGHEST = {"envelope": 1, "psf_gain": 3, "sensor_field": 2, "stray_light": 2, "field_dependence": 2}
"""Terms, and the highest order of each."""

LAST = "field_dependence"
"""Term that is tried when no other one is taken any more."""

KERNELS = Terms(psf_gain=3, field_dependence=2).kernels

MIN_PAIRS = 2

MAX_FOLDS = 10
"""Most parts of the pairs that are left out in turn; the time is in proportion to parts times pairs."""

MOVES = 3
"""Gauss-Newton steps on the envelope's displacement."""

MeasuredPairs = Iterable[tuple[Measurement, Scene]]
"""Measurements and scenes, (1, C, H, W) each."""


@dataclass(frozen=True)
class Step:
    """A term that was tried, and what it explains.

    Args:
        term: its name in `Terms`; "" for the calibration as it was.
        order: of its polynomial.
        unexplained: of each pair when it is left out, see `PairModel.unexplained`.
        taken: whether it is part of the refinement.
        terms: all terms with this one.
    """

    term: str
    order: int
    unexplained: tuple[float, ...]
    taken: bool
    terms: Terms

    @property
    def mean(self) -> float:
        """Mean over the pairs."""
        return fmean(self.unexplained)


@dataclass(frozen=True, eq=False)
class Selection:
    """Result of `select_terms`.

    Args:
        model: of all pairs.
        displaced: the same with the displaced envelope, if that was taken. The displacement is that of all pairs, also
            where one is left out.
        steps: the calibration as it was, then the terms in the order in which they were tried.
    """

    model: PairModel
    displaced: PairModel | None
    steps: tuple[Step, ...]

    @property
    def taken(self) -> list[Step]:
        """The calibration as it was, and the terms that were taken, in their order."""
        return [step for step in self.steps if step.taken]

    def fit(self, terms: Terms, *, without: range = range(0)) -> Fit:
        """Fit to all pairs, or to all but some."""
        model = self.displaced if terms.envelope and self.displaced is not None else self.model
        return model.fit(terms, [pair for pair in range(len(model)) if pair not in without])


def left_out(count: int) -> list[range]:
    """The pairs that are left out in turn: each alone, or `MAX_FOLDS` parts of more pairs."""
    return [range(first, count, MAX_FOLDS) for first in range(min(count, MAX_FOLDS))]


def select_terms(
    psf: Psf,
    pairs: Callable[[], MeasuredPairs],
    *,
    report: Callable[[Step], None] = lambda step: None,
) -> Selection:
    """Choose terms and fit them.

    Args:
        psf: (1, C, H, W), of the calibration.
        pairs: reads the pairs, (1, C, H, W) each; called once or twice.
        report: called with each term that was tried.

    Raises:
        ParameterError: fewer than two pairs.
    """
    plain = model = PairModel(psf, pairs(), kernels=KERNELS)
    displaced = None
    if len(model) < MIN_PAIRS:
        raise ParameterError(f"`pairs` ({len(model)}) must be {MIN_PAIRS} or more: each in turn is left out.")
    steps = [_tried(model, "", 0, Terms())]
    report(steps[0])
    for names in ([name for name in HIGHEST if name != LAST], [name for name in HIGHEST if name == LAST]):
        while True:
            before = [step for step in steps if step.taken][-1]
            tried = [
                _tried(model, term, order, replace(before.terms, **{term: order}))
                for term in names
                for order in range(getattr(before.terms, term) + 1, HIGHEST[term] + 1)
            ]
            best = min(tried, key=lambda step: step.mean, default=None)
            taken = best if best is not None and _is_better(best, before) else None
            for step in tried:
                steps.append(replace(step, taken=step is taken))
                report(steps[-1])
            if taken is None:
                break
            if taken.term == "envelope":
                displaced = model = _displaced(model, taken.terms, psf, pairs)
    return Selection(plain, displaced, tuple(steps))


def _displaced(model: PairModel, terms: Terms, psf: Psf, pairs: Callable[[], MeasuredPairs]) -> PairModel:
    """Gauss-Newton on the displacement, which a model linearises: the other terms then apply to the displaced PSF."""
    down, right = 0.0, 0.0
    for step in range(1, MOVES + 1):
        moved = model.fit(replace(terms, envelope=min(step, 2)), range(len(model))).displacement
        down, right = down + moved[0], right + moved[1]
        model = PairModel(psf, pairs(), kernels=KERNELS, shift=(down, right))
    return model


def _tried(model: PairModel, term: str, order: int, terms: Terms) -> Step:
    everything = range(len(model))
    start = model.fit(terms, everything)
    unexplained = [0.0] * len(model)
    for part in left_out(len(model)):
        fit = model.fit(terms, [pair for pair in everything if pair not in part], start=start, steps=2)
        for pair in part:
            unexplained[pair] = model.unexplained(fit, pair)
    return Step(term, order, tuple(unexplained), taken=not term, terms=terms)


def _is_better(step: Step, before: Step) -> bool:
    pairs = zip(step.unexplained, before.unexplained, strict=True)
    wins = sum(new < old for new, old in pairs)
    return step.mean < (1 - MIN_IMPROVEMENT) * before.mean and wins > len(before.unexplained) / 2
