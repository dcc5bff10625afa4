import pytest
import torch
from torch import Tensor

from nerfro.errors import NerfroError
from nerfro.evaluation.error_maps import squared_error_map
from nerfro.evaluation.image_grid import GAP, LINE_HEIGHT, Crop, ImageRow, image_grid, most_different_crop, triptych
from nerfro.files.drawing import magma
from nerfro.files.images import round_to_8bit

HEIGHT, WIDTH, ZOOM = 24, 32, 4


def picture(seed: int) -> Tensor:
    return torch.rand(HEIGHT, WIDTH, 3, generator=torch.Generator().manual_seed(seed))


def enlarged(pixels: Tensor, factor: int = ZOOM) -> Tensor:
    return round_to_8bit(pixels).repeat_interleave(factor, 0).repeat_interleave(factor, 1)


def cell(grid: Tensor, column: int, top: int) -> Tensor:
    left = column * (ZOOM * WIDTH + GAP)
    return grid[top : top + ZOOM * HEIGHT, left : left + ZOOM * WIDTH]


def test_grid_shows_pictures_and_errors_pixel_by_pixel() -> None:
    reference, first, second = (picture(seed) for seed in range(3))
    row = ImageRow(reference, [first, second])
    grid = image_grid([row], ["reference", "a", "b"], width=ZOOM * WIDTH, error_limit=0.3)
    below = LINE_HEIGHT + ZOOM * HEIGHT + GAP
    for column, shown in enumerate((reference, first, second)):
        torch.testing.assert_close(cell(grid, column, LINE_HEIGHT), enlarged(shown))
    for column, shown in enumerate((first, second), start=1):
        error = magma(squared_error_map(shown, reference), 0.3)
        torch.testing.assert_close(cell(grid, column, below), enlarged(error))


def test_scale_of_the_errors_is_drawn_with_them() -> None:
    reference = picture(0)
    grid = image_grid([ImageRow(reference, [reference])], ["reference", "a"], ZOOM * WIDTH, error_limit=0.05)
    scale = cell(grid, 0, LINE_HEIGHT + ZOOM * HEIGHT + GAP).reshape(-1, 3)
    ends = round_to_8bit(magma(torch.tensor([[0.0, 0.05]]), 0.05))[0]
    for colour in ends:
        assert (scale - colour).abs().sum(-1).min() < 1e-6


def test_pictures_are_reduced_by_averaging() -> None:
    reference = picture(0)
    grid = image_grid([ImageRow(reference, [reference])], ["reference", "a"], WIDTH // 2)
    average = reference.reshape(HEIGHT // 2, 2, WIDTH // 2, 2, 3).mean((1, 3))
    shown = grid[LINE_HEIGHT : LINE_HEIGHT + HEIGHT // 2, : WIDTH // 2]
    assert (shown - average).abs().max() < 1.5 / 255


def test_insets_show_the_crop_enlarged_inside_a_frame() -> None:
    reference, prediction = picture(0), picture(1)
    crop = Crop(top=3, left=20, size=8)
    row = ImageRow(reference, [prediction], crops=[crop])
    grid = image_grid([row], ["reference", "a"], width=ZOOM * WIDTH)
    side, frame = ZOOM * WIDTH, 3
    top, left = LINE_HEIGHT + ZOOM * HEIGHT + GAP, side + GAP
    inset = grid[top : top + side, left : left + side]
    expected = enlarged(prediction[3:11, 20:28], side // 8)
    torch.testing.assert_close(inset[frame:-frame, frame:-frame], expected[frame:-frame, frame:-frame])
    marked = cell(grid, 1, LINE_HEIGHT)[ZOOM * 3, ZOOM * 20]
    assert torch.equal(marked, inset[0, 0])  # the frames of crop and inset have one colour
    assert marked[0] > marked[1]
    assert marked[0] > marked[2]


def test_methods_without_a_picture_are_shown_as_missing() -> None:
    reference = picture(0)
    row = ImageRow(reference, [None, reference], captions=["", "30 dB"], crops=[Crop(0, 0, 8)])
    grid = image_grid([row], ["reference", "a", "b"], width=ZOOM * WIDTH)
    missing = cell(grid, 1, LINE_HEIGHT)
    assert torch.equal(missing[0], missing[0, :1].expand_as(missing[0]))  # one flat grey: no picture and no frame
    assert 0.5 < missing[0].mean() < 1
    assert missing.min() < 0.2  # with something written on it


def test_text_is_written_where_it_was_given() -> None:
    reference = picture(0)

    def draw(title: str, caption: str) -> Tensor:
        return image_grid([ImageRow(reference, [reference], captions=[caption])], ["", title], ZOOM * WIDTH)

    blank, columns = draw("", ""), slice(ZOOM * WIDTH + GAP, None)
    title = draw("mip-NeRF", "") != blank
    assert title[:LINE_HEIGHT, columns].any()
    assert not title[LINE_HEIGHT:].any()
    caption = draw("", "25.46 dB") != blank
    below = LINE_HEIGHT + ZOOM * HEIGHT + GAP
    assert caption[below : below + LINE_HEIGHT, columns].any()
    assert not caption[:below].any()


def test_automatic_crop_finds_where_methods_differ() -> None:
    reference = picture(0)
    alike, different = reference + 0.05, reference + 0.05
    different[10:16, 4:10] += 0.5
    alike[0:6, 20:26] += 3.0  # a large error that all methods share tells nothing about them
    different[0:6, 20:26] += 3.0
    assert most_different_crop(reference, [alike, different], 6) == Crop(top=10, left=4, size=6)
    assert most_different_crop(reference, [different], 6) == Crop(top=0, left=20, size=6)


def test_triptych_holds_prediction_reference_and_error() -> None:
    prediction, target = picture(0), picture(1)
    parts = triptych(prediction, target, 0.3).split(WIDTH, dim=1)
    error = magma(squared_error_map(prediction, target), 0.3)
    for part, expected in zip(parts, (prediction, target, error), strict=True):
        torch.testing.assert_close(part, expected)


@pytest.mark.usefixtures("unchecked")
def test_grids_that_do_not_fit_are_refused() -> None:
    reference = picture(0)
    with pytest.raises(NerfroError, match="at least one row"):
        image_grid([], ["reference"])
    with pytest.raises(NerfroError, match="3 titles for a reference and 1 predictions"):
        image_grid([ImageRow(reference, [reference])], ["reference", "a", "b"])
    with pytest.raises(NerfroError, match="2 captions for 1 predictions"):
        image_grid([ImageRow(reference, [reference], captions=["a", "b"])], ["reference", "a"])
    with pytest.raises(NerfroError, match=r"\[12, 32, 3\] is shown beside a reference \[24, 32, 3\]"):
        image_grid([ImageRow(reference, [reference[:12]])], ["reference", "a"])
    with pytest.raises(NerfroError, match="exceeds an image of 24 x 32"):
        image_grid([ImageRow(reference, [reference], crops=[Crop(20, 0, 8)])], ["reference", "a"])
    with pytest.raises(NerfroError, match="crop of 25 pixels"):
        most_different_crop(reference, [reference], 25)
