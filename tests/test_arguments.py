"""Options of every method, checked against their annotations, with errors that name option and value."""

import re

import pytest
import torch

import mwdn
from mwdn import Calibration, Camera, FrameFormat, Reconstructor, Sensor
from mwdn.errors import MwdnError, ParameterError, UnknownNameError
from mwdn.networks import DENOISERS, NETWORKS, FlatNet, LeAdmm, Mwdn, WienerBank
from mwdn.solvers import BUNDLED_NAMES, NETWORK_NAMES, SOLVERS, Admm, Fista, Pyramid, WarmStart, Wiener
from mwdn.weights.bundled import BUNDLED

PSF = torch.ones(1, 3, 8, 8)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("create", "options", "wanted"),
    [
        (Admm, {"regularisation": "a"}, "a number"),
        (Admm, {"iterations": 1.5}, "a whole number"),
        (Admm, {"penalties": (1, 2, 3)}, "`Penalties`"),
        (Fista, {"iterations": True}, "a whole number"),
        (Pyramid, {"levels": (1, 2)}, "a tuple, each `Level`"),
        (WarmStart, {"solver": Wiener()}, "`Admm` or `Fista`"),
        (Mwdn, {"width": 2.0}, "a whole number"),
        (FlatNet, {"size": 3}, "two whole numbers or none"),
        (WienerBank, {"regularisations": (1e-3, "a")}, "a tuple, each a number"),
        (FrameFormat, {"crop": 100}, "two whole numbers or none"),
        (FrameFormat, {"grey": 1}, "true or false"),
        (Sensor, {"bit_depth": "12"}, "a whole number"),
    ],
)
def test_an_option_of_another_type_is_named_with_its_value(create, options, wanted):
    (name, value) = next(iter(options.items()))
    with pytest.raises(ParameterError) as caught:
        create(**options)
    assert f"`{name}` (" in str(caught.value)
    assert str(value)[:5] in str(caught.value)
    assert wanted in str(caught.value)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    "create",
    [
        lambda: Camera(PSF, size=128),
        lambda: Calibration(PSF, 3),
        lambda: Calibration.from_array(torch.rand(8, 8).numpy(), crop=100),
        lambda: Calibration.from_array(torch.rand(8, 8).numpy(), background="none"),
        lambda: Reconstructor(5, Calibration(PSF)),
        lambda: Reconstructor("admm", Calibration(PSF), device=3),
        lambda: Reconstructor("admm", Calibration(PSF), precision="half"),
        lambda: mwdn.build("mwdn", width="a"),
        lambda: mwdn.solvers.build("admm", iterations="a"),
        lambda: mwdn.read_frame(torch.rand(8, 8).numpy()),
        lambda: mwdn.read_picture(None),
        lambda: mwdn.write_picture(3, PSF),
        lambda: mwdn.write_linear(None, PSF),
        lambda: mwdn.load_network(3),
        lambda: Calibration.from_file(torch.rand(8, 8).numpy()),
        lambda: Calibration.from_file("psf.png", dark=3),
        lambda: Calibration.load(None),
        lambda: Reconstructor("wiener", Calibration(PSF)).stream(None),
        lambda: Reconstructor("wiener", Calibration(PSF)).stream([], refresh="a"),
        lambda: mwdn.convolve(PSF, PSF, size=12),
        lambda: mwdn.correlate(PSF, PSF, size=(3.5, 4)),
        lambda: mwdn.wiener(PSF, PSF, "a"),
        lambda: mwdn.train("quick-cpu", PSF, out="runs/none"),
        lambda: mwdn.simulate("quick-cpu", PSF, photos="photos", out="pairs.h5", count=2),
    ],
)
def test_every_border_refuses_other_types(create):
    """Python's own TypeErrors named a line inside the package, not the argument."""
    with pytest.raises(ParameterError, match=r"^`\w+` \(.*\).* must be |Known: "):
        create()


def test_a_mistyped_argument_of_a_function_gets_the_nearest():
    with pytest.raises(UnknownNameError, match=r"named 'upsidedown'\. Did you mean 'upside_down'"):
        mwdn.read_frame("psf.png", upsidedown=True)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("create", "options", "nearest"),
    [
        (Admm, {"variation": "color"}, "colour"),
        (LeAdmm, {"variation": "color"}, "colour"),
        (Mwdn, {"widht": 3}, "width"),
    ],
)
def test_a_mistyped_name_gets_the_nearest(create, options, nearest):
    with pytest.raises(UnknownNameError, match=f"Did you mean '{nearest}'"):
        create(**options)


def test_what_json_and_numpy_hold_is_accepted():
    """Whole numbers for floats, lists for tuples, numpy's numbers for Python's."""
    import numpy as np

    assert Admm(regularisation=1, iterations=np.int64(3)).iterations == 3
    assert FrameFormat(crop=(np.int32(4), 4)).crop == (4, 4)
    assert mwdn.build("flatnet", size=[8, 8], width=8).correction.shape[-2:] == (8, 8)


def test_solvers_and_networks_name_each_other():
    """The solvers' list of networks is written by hand: networks are above solvers."""
    assert (NETWORKS.keys() | DENOISERS.keys()) - SOLVERS.keys() == NETWORK_NAMES
    assert BUNDLED.keys() == BUNDLED_NAMES
    with pytest.raises(ParameterError, match=r"'le-admm' is a network, .*`mwdn\.networks\.build\('le-admm'\)`"):
        mwdn.solvers.build("le-admm")
    with pytest.raises(ParameterError, match=r"'admm' is a solver, .*`mwdn\.solvers\.build\('admm'\)`"):
        mwdn.build("admm")


def test_a_class_of_the_user_is_checked_too():
    class Mine(mwdn.networks.Network[None]):
        def __init__(self, *, width: int = 3, other=None) -> None:
            super().__init__()
            self.width = width

    assert Mine(width=4, other="anything").width == 4
    with pytest.raises(MwdnError, match=r"`width` \(1\.5\) of `Mine`"):
        Mine(width=1.5)


def test_many_known_names_are_cut_off():
    """The 26 keys of [mismatch], say."""
    message = str(UnknownNameError("key of [mismatch]", "gamma_errop", [f"gamma_error_{n}" for n in range(40)]))
    assert 280 < len(message) <= 300
    assert "Did you mean 'gamma_error_" in message
    assert re.search(r", gamma_error_\d+, \.\.\.$", message)  # whole names


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("value", [float("nan"), float("inf"), 1e300, 10**400, -(2**63)])
def test_numbers_that_no_arithmetic_holds_are_refused(value):
    """1e300 and 10**400 ended in torch's `RuntimeError` and an `OverflowError`."""
    with pytest.raises(ParameterError, match="`regularisation` "):
        mwdn.solvers.build("admm", regularisation=value)


def test_a_message_is_short_whatever_was_given():
    """File names are kept whole; the start and the way out are kept of everything else."""
    text = str(MwdnError(f"`name` ({'x' * 100_000}) must be short. Cut it."))
    assert len(text) <= 300
    assert text.startswith("`name` (xxx")
    assert text.endswith("xxx) must be short. Cut it.")
    path = "/a" * 200
    assert str(MwdnError(f"`{path}` does not exist.")) == f"`{path}` does not exist."
    assert len(str(MwdnError(f"`{'/a' * 5000}` does not exist."))) <= 300
