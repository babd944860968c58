"""Mask files: exact round trips, geometry of GDSII and STL."""

import json
from collections import Counter

import numpy as np
import pytest
import tifffile
import torch

from mwdn.errors import ImageError, ParameterError
from mwdn.optics import Mask
from mwdn.optics.mask_files import BASE_UM, read_mask, write_gds, write_mask, write_stl


@pytest.fixture
def levels(generator):
    """9 x 12 samples of 8 levels of 145 nm."""
    return Mask("phase", torch.randint(0, 8, (9, 12), generator=generator) * 0.145, 2.0, 1.46, 0.145)


def test_levels_come_back_exactly_with_all_numbers(levels, tmp_path):
    write_mask(tmp_path / "mask.tif", levels)
    back = read_mask(tmp_path / "mask.tif")
    torch.testing.assert_close(back.values, levels.values, rtol=0, atol=1e-7)
    for name in ("kind", "pitch_um", "index", "step_um"):
        assert getattr(back, name) == getattr(levels, name)


def test_tiff_says_its_scale_to_any_reader(levels, tmp_path):
    write_mask(tmp_path / "mask.tif", levels)
    with tifffile.TiffFile(tmp_path / "mask.tif") as file:
        page = file.pages[0]
        numbers = page.asarray()
        about = json.loads(page.tags["ImageDescription"].value)
        per_cm = page.tags["XResolution"].value
    assert numbers.dtype == np.uint16
    np.testing.assert_allclose(numbers * about["scale"], levels.values.numpy(), atol=1e-6)
    assert about["unit"] == "um"
    assert per_cm[0] / per_cm[1] == pytest.approx(5000)  # 2 um


def test_surfaces_come_back_to_half_a_step(generator, tmp_path):
    surface = Mask("phase", 20 * torch.rand(8, 5, generator=generator), 1.5, 1.5)
    write_mask(tmp_path / "mask.tif", surface)
    assert (read_mask(tmp_path / "mask.tif").values - surface.values).abs().max() <= 20 / 65535 / 2 + 1e-6
    opening = Mask("amplitude", (torch.rand(8, 5, generator=generator) > 0.5).float(), 1.5)
    write_mask(tmp_path / "mask.tif", opening)
    assert torch.equal(read_mask(tmp_path / "mask.tif").values, opening.values)


def test_foreign_files_are_refused(tmp_path):
    with pytest.raises(ImageError, match=r"none\.tif` does not exist"):
        read_mask(tmp_path / "none.tif")
    tifffile.imwrite(tmp_path / "other.tif", np.zeros((4, 4), np.uint16))
    (tmp_path / "text.tif").write_text("no TIFF")
    for name in ("other.tif", "text.tif"):
        with pytest.raises(ImageError, match="`mwdn design`"):
            read_mask(tmp_path / name)
    with pytest.raises(ImageError, match="cannot be written"):
        write_mask(tmp_path / "text.tif" / "mask.tif", Mask("amplitude", torch.ones(2, 2), 1.0))
    with pytest.raises(ParameterError, match="`values`"):
        write_mask(tmp_path / "mask.tif", Mask("phase", -torch.ones(2, 2), 1.0, 1.5))


def test_gds_layers_are_the_bits_of_the_levels(levels, tmp_path):
    gdstk = pytest.importorskip("gdstk")
    write_gds(tmp_path / "mask.gds", levels)
    cell = gdstk.read_gds(tmp_path / "mask.gds").cells[0]
    number = (levels.values / 0.145).round().long()
    drawn = torch.zeros_like(number)
    for polygon in cell.polygons:
        (left, low), (right, high) = polygon.bounding_box()
        assert polygon.area() == pytest.approx((right - left) * (high - low))
        rows = slice(round(9 // 2 + 0.5 - high / 2), round(9 // 2 + 0.5 - low / 2))
        columns = slice(round(left / 2 + 12 // 2 + 0.5), round(right / 2 + 12 // 2 + 0.5))
        assert (drawn[rows, columns] & 2**polygon.layer == 0).all()  # no square twice
        drawn[rows, columns] += 2**polygon.layer
    assert torch.equal(drawn, number)


def test_gds_joins_equal_rows(tmp_path):
    gdstk = pytest.importorskip("gdstk")
    values = torch.zeros(20, 20)
    values[3:13, 5:9] = 1
    write_gds(tmp_path / "mask.gds", Mask("amplitude", values, 3.0))
    polygons = gdstk.read_gds(tmp_path / "mask.gds").cells[0].polygons
    assert len(polygons) == 1
    assert polygons[0].area() == pytest.approx(10 * 4 * 9.0)
    (left, low), (right, high) = polygons[0].bounding_box()
    assert ((left + right) / 2, (low + high) / 2) == pytest.approx(((6.5 - 10) * 3, -(7.5 - 10) * 3))


def read_stl(path):
    data = path.read_bytes()
    count = int(np.frombuffer(data, "<u4", 1, 80)[0])
    assert len(data) == 84 + 50 * count
    facets = np.frombuffer(data, [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("_", "<u2")], count, 84)
    return facets["normal"], facets["corners"]


def test_stl_is_a_closed_body_of_the_right_volume(generator, tmp_path):
    mask = Mask("phase", 5 * torch.rand(6, 9, generator=generator), 2.0, 1.5)
    write_stl(tmp_path / "mask.stl", mask)
    normals, corners = read_stl(tmp_path / "mask.stl")
    # Closed: the triangles traverse each edge once in each direction.
    edges = Counter()
    for triangle in corners:
        points = [tuple(point) for point in triangle.tolist()]
        for edge in zip(points, points[1:] + points[:1], strict=True):
            edges[edge] += 1
    assert set(edges.values()) == {1}
    assert all((end, start) in edges for start, end in edges)
    # Oriented outwards: the divergence theorem gives the volume with a positive sign.
    wide = corners.astype(np.float64)
    volume = np.einsum("ni,ni->n", wide[:, 0], np.cross(wide[:, 1], wide[:, 2])).sum() / 6
    h = mask.values.double().numpy() + BASE_UM
    cells = (h[:-1, :-1] + h[1:, 1:]) / 3 + (h[1:, :-1] + h[:-1, 1:]) / 6  # two triangles with a shared diagonal
    sides = [2.0 * np.array([1.5, *[1.0] * (count - 3), 1.5]) for count in h.shape]  # the outermost are at the edges
    assert volume == pytest.approx((cells * np.outer(*sides)).sum(), rel=1e-5)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-5)
    assert (normals[: 2 * 5 * 8, 2] > 0).all()


@pytest.mark.parametrize("every", [1, 3, 4, 50])
def test_stl_and_gds_have_the_masks_size_and_origin(tmp_path, every):
    gdstk = pytest.importorskip("gdstk")
    mask = Mask("phase", torch.ones(40, 50), 2.0, 1.5, step_um=1.0)
    write_stl(tmp_path / "a.stl", mask, every=every)
    write_gds(tmp_path / "a.gds", mask)
    (left, low), (right, high) = gdstk.read_gds(tmp_path / "a.gds").top_level()[0].bounding_box()
    assert (right - left, high - low) == pytest.approx((100, 80))
    corners = read_stl(tmp_path / "a.stl")[1].reshape(-1, 3)
    np.testing.assert_allclose(corners.min(0), [left, low, 0])
    np.testing.assert_allclose(corners.max(0), [right, high, 101])


def test_stl_refuses_what_it_cannot_show(levels, tmp_path):
    with pytest.raises(ParameterError, match="STL"):
        write_stl(tmp_path / "a.stl", Mask("amplitude", torch.ones(4, 4), 1.0))
    with pytest.raises(ParameterError, match="`--stl-every 3`"):
        write_stl(tmp_path / "a.stl", Mask("phase", torch.zeros(1).expand(5000, 5000), 1.0, 1.5))
    with pytest.raises(ParameterError, match=r"`every` \(0\) must be at least 1"):
        write_stl(tmp_path / "a.stl", levels, every=0)
    write_stl(tmp_path / "a.stl", levels, every=2)
    assert len(read_stl(tmp_path / "a.stl")[1]) == 2 * 4 * 6 + 3 * 2 * (4 + 6)
