"""The recipe of a benchmark: methods, data sets, and one training budget."""

from dataclasses import dataclass, field, fields

from mwdn.benchmark.dataset_recipe import DatasetRecipe
from mwdn.benchmark.methods import Method
from mwdn.optics import Deviation
from mwdn.training.recipe import Schedule
from mwdn.training.tables import Plateau

SWEPT = {"noise": 1.0, **{part.name: 0.0 for part in fields(Deviation)}}
"""What a robustness sweep varies, and its value in the camera of the training; noise is a factor."""


@dataclass(frozen=True)
class Robustness:
    """Test of cameras that differ more from their calibration than in training.

    Args:
        data: a simulated data set; empty for no test.
        count: test pictures for each size.
        sizes: of the mismatch, for each of `SWEPT` to sweep.
    """

    data: str = ""
    count: int = 8
    sizes: dict[str, tuple[float, ...]] = field(default_factory=dict)


@dataclass(frozen=True)
class Benchmark:
    """Methods to compare on data sets, under one training budget and one protocol per data set.

    Args:
        title: of the page.
        methods: in the order of the tables.
        data: data sets by name.
        schedule: training schedule of every network; see `published`.
        loss: weights of the loss's parts, for every network.
        plateau: of the schedule "plateau", for every network.
        later_loss: weights of the second phase of that schedule.
        rates: learning rates to try for each network with `trial` of the steps; the best of the validation then trains
            to the end. Empty for the schedule's, or the published one.
        trial: part of the steps for each trial.
        mean_picture: whether the mean of all training scenes is a row of the tables, whatever the capture.
        published: take a network's optimiser, learning rate and weight decay from its publication if that gives them.
        rate_factor: factor on the published learning rates; less than 1 slows sources that train much longer.
        ablation: labels of the paper's ablation, in its order.
        compared: label of the method that all others are compared with, picture by picture.
        shown: test pictures of each data set on the page.
        width_factor: factor on every network's default width; a ``width`` in the recipe takes precedence.
        robustness: see `Robustness`.
        alexnet: file of AlexNet's weights; searched for or downloaded unless given.
        heads: file of LPIPS's heads; likewise.
        path: of the recipe.
    """

    title: str = "Benchmark"
    methods: tuple[Method, ...] = ()
    data: dict[str, DatasetRecipe] = field(default_factory=dict)
    schedule: Schedule = Schedule()
    loss: dict[str, float] = field(default_factory=lambda: {"mse": 1.0})
    plateau: Plateau = Plateau()
    later_loss: dict[str, float] = field(default_factory=dict)
    rates: tuple[float, ...] = ()
    trial: float = 0.1
    mean_picture: bool = False
    published: bool = False
    rate_factor: float = 1.0
    ablation: tuple[str, ...] = ()
    compared: str = ""
    shown: int = 4
    width_factor: float = 1.0
    robustness: Robustness = Robustness()
    alexnet: str = ""
    heads: str = ""
    path: str = ""

    def rates_of(self, method: Method) -> tuple[float, ...]:
        """Learning rates to try for a network; none if its line of the recipe gives one."""
        return () if "learning_rate" in method.schedule else self.rates
