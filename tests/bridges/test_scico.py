"""A camera as an operator of SCICO: its own adjoint check, its solvers, and the same numbers as torch's."""

import numpy as np
import pytest
import torch

pytest.importorskip("scico", reason="the extra `scico` is not installed")

import scico.numpy as snp
from scico.linop import valid_adjoint
from scico.solver import cg

from mwdn import Camera
from mwdn.bridges import scico_operator
from mwdn.errors import ShapeError
from mwdn.optics import unit_sum

pytestmark = pytest.mark.filterwarnings("ignore")  # of jax, flax and SCICO

# scene, sensor, PSF
SIZES = [
    ((9, 12), (9, 12), (9, 12)),
    ((13, 11), (9, 12), (5, 6)),
    ((4, 5), (9, 8), (3, 3)),
    ((16, 16), (5, 4), (8, 11)),
]


def camera(sensor, psf, generator, channels=3):
    return Camera(unit_sum(torch.rand(1, channels, *psf, generator=generator) ** 4), size=sensor)


@pytest.mark.parametrize(("scene", "sensor", "psf"), SIZES)
def test_it_is_the_forward_model_and_its_adjoint(scene, sensor, psf, generator):
    ours = camera(sensor, psf, generator)
    operator = scico_operator(ours, scene_size=scene)
    x, y = torch.rand(1, 3, *scene, generator=generator), torch.rand(1, 3, *sensor, generator=generator)
    np.testing.assert_allclose(operator(snp.array(x[0].numpy())), ours(x)[0], atol=1e-6)
    np.testing.assert_allclose(operator.T(snp.array(y[0].numpy())), ours.adjoint(y, scene_size=scene)[0], atol=1e-6)
    assert valid_adjoint(operator, operator.T, eps=1e-5)


def test_one_channel_of_the_psf_serves_all_of_the_scene(generator):
    ours = camera((9, 12), (5, 6), generator, channels=1)
    x = torch.rand(1, 3, 9, 12, generator=generator)
    operator = scico_operator(ours, channels=3)
    np.testing.assert_allclose(operator(snp.array(x[0].numpy())), ours(x)[0], atol=1e-6)


def test_conjugate_gradients_solve_its_normal_equations(generator):
    ours = camera((9, 12), (5, 6), generator)
    operator = scico_operator(ours)
    y = torch.rand(1, 3, 9, 12, generator=generator)
    right = operator.T(snp.array(y[0].numpy()))
    x, _ = cg(lambda v: operator.T(operator(v)) + 1e-2 * v, right, snp.zeros_like(right), tol=1e-6, maxiter=500)
    v = torch.from_numpy(np.array(x))[None]
    residual = ours.adjoint(ours(v) - y) + 1e-2 * v
    assert residual.norm() < 1e-4 * ours.adjoint(y).norm()


def test_a_batch_of_psfs_is_refused(generator):
    with pytest.raises(ShapeError, match="2 PSFs"):
        scico_operator(Camera(torch.rand(2, 1, 5, 6, generator=generator)))
