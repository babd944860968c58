import numpy as np
import pytest
import torch
from displayed import placed, seen_from

from mwdn.errors import ParameterError, ShapeError
from mwdn.registration import Projection, warp_pictures


def picture(*shape, seed=0):
    return torch.rand(1, 3, *shape, generator=torch.Generator().manual_seed(seed))


def test_the_identity_changes_nothing():
    shown = picture(20, 30)
    projection = Projection.from_homography(np.eye(3), (20, 30), (20, 30))
    warped = warp_pictures(shown, projection)
    # Each pixel is the mean of 9 bilinear samples within it: noise of one pixel is smoothed, a ramp is not.
    ramp = torch.linspace(0, 1, 30).expand(1, 3, 20, 30)
    torch.testing.assert_close(warp_pictures(ramp, projection)[..., 1:-1], ramp[..., 1:-1])
    assert warped.mean().item() == pytest.approx(shown.mean().item(), abs=0.01)


def test_a_pixel_is_the_mean_of_the_light_within_it():
    shown = picture(120, 160)
    projection = Projection.from_homography(
        np.array([[1 / 8, 0, -7 / 16], [0, 1 / 8, -7 / 16], [0, 0, 1]]), (120, 160), (15, 20)
    )
    means = torch.nn.functional.avg_pool2d(shown, 8)
    warped = warp_pictures(shown, projection)
    assert (warped - means).abs().max() < 0.05
    assert warped.mean().item() == pytest.approx(means.mean().item(), abs=1e-3)


def test_light_is_where_another_program_puts_it():
    smooth = torch.nn.functional.interpolate(picture(6, 8), (90, 120), mode="bicubic").clamp(0, 1)
    for radial in (0.0, 0.06):
        projection = placed((90, 120), (64, 80), turn=20, mirrored=True, radial=radial)
        expected = seen_from(smooth[0].movedim(0, -1).numpy(), projection.homography, (64, 80), radial=radial)
        warped = warp_pictures(smooth, projection)
        assert (warped - expected).abs().mean() < 0.002
        assert warped.sum().item() == pytest.approx(expected.sum().item(), rel=0.02)
        assert (warped[..., 0, :] == 0).all()


def test_another_size_is_refused():
    with pytest.raises(ShapeError, match="20 x 30"):
        warp_pictures(picture(20, 30), placed((90, 120), (64, 80)))


@pytest.mark.usefixtures("unchecked")
def test_one_picture_without_a_batch_is_refused():
    """Its colours were taken for pictures, whose columns were taken for colours."""
    with pytest.raises(ShapeError, match=r"`pictures\[None\]`"):
        warp_pictures(picture(90, 120)[0], placed((90, 120), (64, 80)))
    with pytest.raises(ParameterError, match="uint8"):
        warp_pictures(picture(90, 120).mul(255).byte(), placed((90, 120), (64, 80)))
