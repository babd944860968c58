"""Independent float64 references in numpy and scipy, written from the equations and not from the source."""

import numpy as np
from scipy.signal import convolve2d


def convolve(scene, psf, size=None, *, circular=False):
    """2-D convolution as a sum over points, centres ``n // 2`` of scene, PSF and sensor on one axis."""
    size = size or scene.shape
    full = convolve2d(np.asarray(scene, float), np.asarray(psf, float))
    start = [s // 2 + p // 2 - o // 2 for s, p, o in zip(scene.shape, psf.shape, size, strict=True)]
    rows, columns = (a + np.arange(o) for a, o in zip(start, size, strict=True))
    if circular:
        grid = tuple(max(s, o) for s, o in zip(scene.shape, size, strict=True))
        wrapped = np.zeros(grid)
        indices = np.ix_(np.arange(full.shape[0]) % grid[0], np.arange(full.shape[1]) % grid[1])
        np.add.at(wrapped, indices, full)
        return wrapped[np.ix_(rows % grid[0], columns % grid[1])]
    # Two zero borders wide enough for every index that lies beside the full convolution.
    margin = max(*size, *full.shape, *(abs(a) for a in start))
    return np.pad(full, margin)[np.ix_(rows + margin, columns + margin)]


def pad(image, grid, boundary):
    """The measurement on a longer grid, far border continued after the end, near border before the start."""
    pads, fades = [], []
    for length, long in zip(image.shape, grid, strict=True):
        after = (long - length + 1) // 2
        pads.append((long - length - after, after))
        steps = np.concatenate([np.arange(pads[-1][0], 0, -1), np.zeros(length), np.arange(1, after + 1)])
        # cos^2, a quarter period from the border to the middle of the padding.
        fades.append(np.cos(np.pi / 2 * steps / ((long - length) / 2 + 1)) ** 2)
    if boundary == "zero":
        wide = np.pad(image, pads)
    else:
        wide = np.pad(image, pads, mode="edge")
        if boundary == "taper":
            wide = wide * fades[0][:, None] * fades[1]
    return np.roll(wide, (-pads[0][0], -pads[1][0]), (0, 1))


def smooth_even(length):
    """Next even length whose prime factors are all at most 7."""
    while True:
        factor = length
        for prime in (2, 3, 5, 7):
            while factor % prime == 0:
                factor //= prime
        if factor == 1 and length % 2 == 0:
            return length
        length += 1


def transfer(psf, grid):
    """Full Fourier transform of a PSF with its centre brought to the origin."""
    wide = np.zeros(grid)
    wide[: psf.shape[0], : psf.shape[1]] = psf
    return np.fft.fft2(np.roll(wide, (-(psf.shape[0] // 2), -(psf.shape[1] // 2)), (0, 1)))


def wiener(measurement, psf, regularisation, boundary="taper"):
    """Eq. (2) of the paper on the padded grid, one channel."""
    b, h = np.asarray(measurement, float), np.asarray(psf, float)
    size = b.shape
    grid = size if boundary == "circular" else tuple(smooth_even(n + n // 2) for n in size)
    H = transfer(h, grid)
    B = np.fft.fft2(b if boundary == "circular" else pad(b, grid, boundary))
    return np.fft.ifft2(H.conj() * B / (abs(H) ** 2 + regularisation)).real[: size[0], : size[1]]


def admm(b, h, grid, *, mu, tau, iterations, variation):
    """ADMM with TV and non-negativity as in methods.md, all copies and multipliers on the whole grid.

    ``b`` and ``h`` are (C, H, W); sensor at the top left of the grid. Returns the scene on the grid.
    """
    mu1, mu2, mu3 = mu
    height, width = b.shape[-2:]
    b, h = b / np.linalg.norm(b), h / np.linalg.norm(h)
    fourier, inverse = np.fft.fft2, lambda z: np.fft.ifft2(z).real
    H = np.stack([transfer(psf, grid) for psf in h])
    sensor = np.zeros(grid)
    sensor[:height, :width] = 1
    data = np.zeros((b.shape[0], *grid))
    data[:, :height, :width] = b
    # The spectrum of forward differences from the spectrum of their impulse response.
    down, along = np.zeros(grid), np.zeros(grid)
    down[0, 0] -= 1
    down[-1, 0] += 1
    along[0, 0] -= 1
    along[0, -1] += 1
    D = np.stack([np.fft.fft2(down), np.fft.fft2(along)])
    v = np.zeros_like(data)
    xi, rho, eta = np.zeros_like(v), np.zeros_like(v), np.zeros((2, *v.shape))
    difference = lambda z: np.stack([inverse(d * fourier(z)) for d in D])  # noqa: E731
    for _ in range(iterations):
        g = difference(v) + eta / mu2
        # g is (2 differences, C, H, W); the length is of one difference, of both, or of those of all colours.
        axes = {"anisotropic": (), "isotropic": 0, "colour": (0, 1)}[variation]
        length = np.sqrt((g**2).sum(axes, keepdims=True)) if axes != () else abs(g)
        u = g * np.maximum(length - tau / mu2, 0) / np.where(length > 0, length, 1)
        x = (xi + mu1 * inverse(H * fourier(v)) + data) / (sensor + mu1)
        w = np.maximum(rho / mu3 + v, 0)
        right = fourier(mu3 * w - rho) + (D.conj()[:, None] * fourier(mu2 * u - eta)).sum(0)
        right = right + H.conj() * fourier(mu1 * x - xi)
        v = inverse(right / (mu1 * abs(H) ** 2 + mu2 * (abs(D) ** 2).sum(0) + mu3))
        xi = xi + mu1 * (inverse(H * fourier(v)) - x)
        eta = eta + mu2 * (difference(v) - u)
        rho = rho + mu3 * (v - w)
    return v


def objective(v, b, h, *, tau, variation):
    """``1/2 |crop(h * v) - b|^2 + tau |Psi v|_1`` of a scene (C, rows, columns) on a periodic grid."""
    height, width = b.shape[-2:]
    seen = [np.fft.ifft2(np.fft.fft2(scene) * transfer(psf, scene.shape)).real for scene, psf in zip(v, h, strict=True)]
    down, along = np.roll(v, -1, -2) - v, np.roll(v, -1, -1) - v
    length = {
        "anisotropic": abs(down) + abs(along),
        "isotropic": np.hypot(down, along),
        "colour": np.sqrt((down**2 + along**2).sum(0)),
    }[variation]
    return 0.5 * ((np.stack(seen)[:, :height, :width] - b) ** 2).sum() + tau * length.sum()


def matrix(psf, sensor):
    """``crop(h * v)`` as a matrix, for every scene point that reaches the sensor at all.

    The scene is ``sensor + psf - 1`` points long, with its centre before the sensor's.
    """
    scene = tuple(o + p - 1 for o, p in zip(sensor, psf.shape, strict=True))
    columns = []
    for k in range(scene[0] * scene[1]):
        point = np.zeros(scene)
        point.flat[k] = 1
        # Scene and sensor aligned so that all of "valid" convolution is the sensor.
        columns.append(convolve2d(point, psf, mode="valid").ravel())
    return np.stack(columns, axis=1)
