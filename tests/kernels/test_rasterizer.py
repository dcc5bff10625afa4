"""Images of Gaussians and their gradients agree with the plain formulas, and with finite differences."""

import torch

from nerfro.kernels.rasterizer import rasterize

HEIGHT, WIDTH = 21, 17


def random_splats(number: int, opacity: float, seed: int = 0) -> torch.Tensor:
    """Gaussians of 1 to 4 pixels, some of which reach beyond the image."""
    generator = torch.Generator().manual_seed(seed)
    uniform = torch.rand(number, 9, generator=generator, dtype=torch.float64)
    edges = torch.randn(number, 2, 2, generator=generator, dtype=torch.float64) + 2 * torch.eye(2)
    inverse = torch.linalg.inv(edges @ edges.mT + 0.3 * torch.eye(2))
    means = uniform[:, :2] * torch.tensor([WIDTH + 8.0, HEIGHT + 8.0]) - 4
    entries = torch.stack([inverse[:, 0, 0], inverse[:, 0, 1], inverse[:, 1, 1]], -1)
    return torch.cat([means, entries, opacity * (0.1 + 0.9 * uniform[:, 5:6]), uniform[:, 6:]], -1)


def reference(splats: torch.Tensor) -> torch.Tensor:
    """All Gaussians at all pixels at once."""
    rows, columns = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    offsets = torch.stack([columns, rows], -1).view(-1, 1, 2) - splats[:, :2]
    xx, xy, yy = splats[:, 2:5].unbind(-1)
    inverse = torch.stack([xx, xy, xy, yy], -1).view(-1, 2, 2)
    power = torch.einsum("pni,nij,pnj->pn", offsets, inverse, offsets)
    alpha = splats[:, 5] * torch.exp(-0.5 * power)
    alpha = torch.where(alpha < 1 / 255, 0.0, alpha.clamp(max=0.99))
    transmittance = torch.cumprod(torch.cat([torch.ones_like(alpha[:, :1]), 1 - alpha], 1), 1)[:, :-1]
    seen = torch.where(transmittance < 1e-4, 0.0, transmittance * alpha)
    return (seen @ splats[:, 6:]).view(HEIGHT, WIDTH, 3)


def test_images_and_gradients_equal_the_sum_over_all_gaussians() -> None:
    for opacity in (0.5, 1.0):
        splats = random_splats(150, opacity).requires_grad_()
        weights = torch.randn(HEIGHT, WIDTH, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
        ours, plain = rasterize(splats, HEIGHT, WIDTH), reference(splats)
        torch.testing.assert_close(ours, plain)
        gradients = [torch.autograd.grad((image * weights).sum(), splats)[0] for image in (ours, plain)]
        torch.testing.assert_close(*gradients)
        single = rasterize(splats.detach().float(), HEIGHT, WIDTH)
        torch.testing.assert_close(single, plain.detach().float(), atol=2e-5, rtol=1e-4)


def test_gradients_equal_finite_differences() -> None:
    splats = random_splats(12, 0.9, seed=3).requires_grad_()
    assert torch.autograd.gradcheck(lambda values: rasterize(values, HEIGHT, WIDTH), splats, eps=1e-7, atol=1e-5)


def test_gaussians_that_are_invisible_or_outside_change_nothing() -> None:
    visible = random_splats(20, 0.9)
    hidden = random_splats(2, 0.9)
    hidden[0, 5] = 0.001  # opacity
    hidden[1, :2] = torch.tensor([-500.0, 1e6])
    both = rasterize(torch.cat([hidden, visible]), HEIGHT, WIDTH)
    assert (both == rasterize(visible, HEIGHT, WIDTH)).all()
    assert (rasterize(visible[:0], HEIGHT, WIDTH) == 0).all()
