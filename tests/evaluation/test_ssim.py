import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter
from skimage.metrics import structural_similarity

from nerfro.errors import NerfroError
from nerfro.evaluation.ssim import MS_SSIM_MIN_SIZE, ms_ssim, ssim, ssim_map
from tests.evaluation.test_metrics import pictures

EXPONENTS = np.array([0.0448, 0.2856, 0.3001, 0.2363, 0.1333])  # Wang et al. 2003, table 1


def similarity(prediction: np.ndarray, target: np.ndarray) -> tuple[float, np.ndarray]:
    return structural_similarity(
        prediction,
        target,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1.0,
        channel_axis=-1,
        full=True,
    )


def multiscale(prediction: np.ndarray, target: np.ndarray, inside: np.ndarray) -> float:
    """MS-SSIM of sizes that halve evenly, from scikit-image's maps: contrast is what luminance leaves of them."""
    products = np.ones(3)
    for scale, exponent in enumerate(EXPONENTS):
        if scale > 0:
            shape = (prediction.shape[0] // 2, 2, prediction.shape[1] // 2, 2)
            prediction, target = (image.reshape(*shape, 3).mean((1, 3)) for image in (prediction, target))
            inside = inside.reshape(shape).mean((1, 3))
        means = [gaussian_filter(image, (1.5, 1.5, 0), truncate=3.5) for image in (prediction, target)]
        luminance = (2 * means[0] * means[1] + 1e-4) / (means[0] ** 2 + means[1] ** 2 + 1e-4)
        full = similarity(prediction, target)[1]
        values = full if scale == 4 else full / luminance
        counted = inside[5:-5, 5:-5] >= 0.5
        products *= np.array([values[5:-5, 5:-5, channel][counted].mean() for channel in range(3)]) ** exponent
    return float(products.mean())


@pytest.mark.parametrize("seed", range(3))
def test_ssim_is_that_of_scikit_image_over_whole_windows(seed: int) -> None:
    prediction, target = pictures(seed=seed)
    mean, full = similarity(prediction.double().numpy(), target.double().numpy())
    assert ssim(prediction, target).item() == pytest.approx(mean, abs=1e-6)
    assert np.abs(ssim_map(prediction, target).numpy() - full[5:-5, 5:-5]).max() < 1e-6


def test_ssim_on_a_mask_is_the_mean_of_the_map_there() -> None:
    prediction, target = pictures()
    inside = torch.zeros(37, 45, dtype=torch.bool)
    inside[0:20, 3:30] = True  # reaches over the border, where there is no whole window
    full = similarity(prediction.double().numpy(), target.double().numpy())[1]
    assert ssim(prediction, target, inside).item() == pytest.approx(full[5:20, 5:30].mean(), abs=1e-6)
    border = torch.zeros(37, 45, dtype=torch.bool)
    border[:5] = True
    assert ssim(prediction, target, border).isnan()


@pytest.mark.parametrize("masked", [False, True])
def test_ms_ssim_is_that_of_scikit_images_maps(masked: bool) -> None:
    prediction, target = pictures(height=176, width=208)
    inside = torch.ones(176, 208, dtype=torch.bool)
    if masked:
        inside[:, :41] = False
        inside[150:] = False
    expected = multiscale(prediction.double().numpy(), target.double().numpy(), inside.double().numpy())
    assert 0.1 < expected < 0.95
    assert ms_ssim(prediction, target, inside).item() == pytest.approx(expected, abs=1e-6)
    if not masked:
        assert ms_ssim(prediction, target).item() == pytest.approx(expected, abs=1e-6)


def test_ms_ssim_is_that_of_pytorch_msssim() -> None:
    theirs = pytest.importorskip("pytorch_msssim")
    prediction, target = pictures(height=192, width=176)
    batches = [image.double().permute(2, 0, 1)[None] for image in (prediction, target)]
    expected = theirs.ms_ssim(*batches, data_range=1.0)
    # Its window is computed in single precision.
    assert ms_ssim(prediction, target).item() == pytest.approx(expected.item(), abs=2e-5)


def test_ms_ssim_of_equal_pictures_is_one_and_opposite_ones_have_none() -> None:
    _, target = pictures(height=200, width=190)
    assert ms_ssim(target, target).item() == pytest.approx(1)
    assert ms_ssim(1 - target, target).item() == 0


def test_smallest_pictures_are_those_that_hold_a_window_on_every_scale() -> None:
    assert MS_SSIM_MIN_SIZE == 161
    assert torch.isfinite(ms_ssim(*pictures(height=161, width=170)))
    with pytest.raises(NerfroError, match=r"at least 161 x 161 pixels for its five scales, got \[160, 200\]"):
        ms_ssim(*pictures(height=160, width=200))
    with pytest.raises(NerfroError, match="at least 11 x 11"):
        ssim(torch.zeros(10, 40, 3), torch.zeros(10, 40, 3))
