import pytest
import torch
from scipy.ndimage import binary_dilation

from nerfro.errors import NerfroError
from nerfro.evaluation.regions import crop_rectangle, mean_over, object_pixels


def test_half_covered_pixels_belong_to_the_object() -> None:
    coverage = torch.tensor([[0.0, 0.49, 0.5, 1.0]])
    assert object_pixels(coverage).tolist() == [[False, False, True, True]]


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("dilation", [1, 3, 35])
def test_crop_is_the_bounding_rectangle_of_the_dilated_mask(seed: int, dilation: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    inside = torch.rand(60, 90, generator=generator) > 0.999
    inside[30, 40] = True
    dilated = torch.from_numpy(binary_dilation(inside.numpy(), torch.ones(dilation, dilation).numpy()))
    rows, columns = dilated.any(1).nonzero(), dilated.any(0).nonzero()
    expected = slice(int(rows.min()), int(rows.max()) + 1), slice(int(columns.min()), int(columns.max()) + 1)
    assert crop_rectangle(inside, dilation) == expected
    assert torch.equal(dilated[expected].sum(), dilated.sum())


def test_authors_dilation_is_seventeen_pixels_to_each_side() -> None:
    inside = torch.zeros(100, 100, dtype=torch.bool)
    inside[40:50, 60:95] = True
    assert crop_rectangle(inside) == (slice(23, 67), slice(43, 100))


def test_mean_over_a_mask_leaves_the_rest_out() -> None:
    values, inside = torch.tensor([[1.0, 2.0], [3.0, torch.nan]]), torch.tensor([[True, False], [True, False]])
    assert mean_over(values, inside).item() == 2
    assert mean_over(values, torch.zeros(2, 2, dtype=torch.bool)).isnan()


def test_impossible_crops_are_refused() -> None:
    with pytest.raises(NerfroError, match="mask is empty"):
        crop_rectangle(torch.zeros(4, 4, dtype=torch.bool))
    with pytest.raises(NerfroError, match="dilation=4 has no centre"):
        crop_rectangle(torch.ones(4, 4, dtype=torch.bool), 4)
