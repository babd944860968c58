"""Contact sheets: where a picture is, in which colours, under which title."""

import pytest
import torch

from mwdn.errors import ShapeError
from mwdn.io.contact_sheets import contact_sheet, to_display

GAP, HEAD = 6, 26


def plain(*colour, size=(20, 30)):
    return torch.tensor(colour)[None, :, None, None].expand(1, len(colour), *size).contiguous()


def test_all_but_the_brightest_pixels_fit():
    ramp = torch.linspace(0, 5, 10_000).reshape(1, 1, 100, 100)
    shown = to_display(torch.cat([ramp, 100 * ramp]))
    torch.testing.assert_close(shown[0], shown[1])
    assert (shown[0] == 1).sum().item() == pytest.approx(30, abs=1)
    assert shown[0, 0, 50, 0].item() == pytest.approx(ramp[0, 0, 50, 0].item() / (5 * 0.997), rel=1e-3)


def test_one_hot_pixel_does_not_darken_the_rest():
    picture = torch.full((1, 1, 40, 40), 0.5)
    picture[..., 3, 3] = 1000
    assert (to_display(picture) == 1).all()


def test_darkness_and_negative_numbers_are_black():
    assert (to_display(torch.zeros(1, 3, 4, 4)) == 0).all()
    assert (to_display(-torch.rand(1, 3, 4, 4)) == 0).all()
    assert to_display(torch.full((1, 1, 1, 1), 3.0)).item() == 1


def test_a_picture_without_pixels_is_refused():
    with pytest.raises(ShapeError, match=r"\(1, 3, 0, 4\)"):
        to_display(torch.zeros(1, 3, 0, 4))


@pytest.mark.parametrize("height", [10, 20, 50])
def test_size(height):
    rows = [[plain(1.0), plain(1.0, 1.0, 1.0, size=(20, 20))] for _ in range(3)]
    sheet = contact_sheet(rows, ["a", "b"], height=height)
    assert sheet.shape == (1, 3, HEAD + 3 * (height + GAP), round(1.5 * height) + height + 2 * GAP)
    assert sheet.min() >= 0
    assert sheet.max() <= 1


def test_places_and_colours():
    """Grey becomes three equal channels; two rows, the second shorter; white between and beyond."""
    red, grey = plain(0.8, 0.2, 0.4), plain(0.3)
    grey[..., :15] = 0  # its left half is black
    sheet = contact_sheet([[red, grey], [plain(0.0, 0.1, 0.2, size=(20, 20)), grey]], ["", ""], height=20)[0]
    first, second = sheet[:, HEAD : HEAD + 20], sheet[:, HEAD + 26 : HEAD + 46]
    torch.testing.assert_close(first[:, :, :30], (red[0] / 0.8))
    assert (first[:, :, 30:36] == 1).all()
    assert (first[:, :, 36:51] == 0).all()
    assert (first[:, :, 51:] == 1).all()
    torch.testing.assert_close(second[:, :, :20], plain(0.0, 0.5, 1.0, size=(20, 20))[0])
    assert (second[:, :, 26:41] == 0).all()
    assert (second[:, :, 41:] == 1).all()
    assert (sheet[:, HEAD + 20 : HEAD + 26] == 1).all()


def test_upright_when_shrunk_and_enlarged():
    picture = plain(0.0, size=(40, 40))
    picture[..., :20, :20] = 1
    for height in (20, 80):
        cell = contact_sheet([[picture]], [""], height=height)[0, 0, HEAD:, :-GAP]
        quarter = height // 4
        assert cell[quarter, quarter] > 0.99
        assert max(cell[3 * quarter, quarter], cell[quarter, 3 * quarter], cell[3 * quarter, 3 * quarter]) < 0.01


def test_titles_are_drawn_above_their_columns():
    rows = [[plain(0.5, size=(100, 100)), plain(0.5, size=(100, 100))]]

    def ink(titles):
        head = contact_sheet(rows, titles, height=100)[0, :, :HEAD]
        assert (head == head[:1]).all()
        return (head[0] < 0.5).any(0)

    both, right = ink(["scene", "admm"]), ink(["", "admm"])
    assert both[:106].any()
    assert both[106:].any()
    assert not right[:106].any()
    assert (right[106:] == both[106:]).all()


def test_each_row_has_as_many_pictures_as_there_are_titles():
    with pytest.raises(ValueError, match="zip"):
        contact_sheet([[plain(1.0)]], ["a", "b"])


def test_a_long_title_stays_above_its_column():
    """It ran into the title of the next one."""
    sheet = contact_sheet(
        [[plain(1.0, size=(100, 100))] * 2], ["a title of thirty-nine letters, in all", ""], height=100
    )
    assert sheet[..., :HEAD, :100].min() < 0.5
    assert sheet[..., :HEAD, 100 + GAP :].min() == 1
