import torch
from torch.nn import functional as F

from mwdn.data.pairs import PairFile
from mwdn.data.recorded import RecordedPairs
from mwdn.data.simulated import Batch
from mwdn.networks import Network
from mwdn.optics.distortion import distort, undistort
from mwdn.training.losses import Loss
from mwdn.training.tasks import SupervisedTask

DISTORTION = torch.tensor([[0.0, 0.03, 0.0], [0.0, 0.0, -0.02]])


class Seen(Network[torch.Tensor]):
    """The measurement itself; another camera recorded the scenes, displaced."""

    def prepare(self, psf, size):
        return psf

    def reconstruct(self, measurement, prepared):
        return measurement

    def as_recorded(self, scene):
        return undistort(scene, DISTORTION)

    def as_reconstructed(self, scene):
        return distort(scene, DISTORTION)


def test_loss_and_validation_know_how_scenes_were_recorded(generator, tmp_path):
    scene = F.avg_pool2d(torch.rand(1, 3, 44, 52, generator=generator), 5, 1)
    psf = torch.ones(1, 3, 40, 48)
    with PairFile.create(tmp_path / "pairs.h5", measurement_shape=(40, 48, 3), scene_shape=(40, 48, 3)) as file:
        file.append(distort(scene, DISTORTION)[0], scene[0])
    task = SupervisedTask(RecordedPairs(PairFile(tmp_path / "pairs.h5"), range(1), psf))
    network, loss = Seen().eval(), Loss({"mse": 1.0})
    assert task.loss(network, loss, range(1))[0] < 1e-6
    assert task.batch_loss(network, loss, Batch(scene, scene, psf))[0] > 1e-4
    assert task.score(network, loss, range(1)).psnr > 40
